"""Every hard case passes at every setting where it applies, and can fail."""

from dataclasses import replace

import numpy as np
import pytest

from xpbd_ros.study.edges import Edges
from xpbd_ros.study.stress import all_hard, FAMILIES
from xpbd_ros.study.stress.case import Setting
from xpbd_ros.study.stress.run import columns, draw, is_quick, NODE_CASES, stress
from xpbd_ros.study.stress.scenes import sheet
from xpbd_ros.study.stress.trajectory import Trajectory
from xpbd_ros.study.stress.trial import Trial

EVERY = all_hard()
QUICK = ('H3', 'H6', 'H13', 'H16', 'H18', 'H31')


@pytest.mark.slow
@pytest.mark.parametrize('case', EVERY, ids=lambda one: one.id)
def test_case(case):
    outcomes = [attempt.outcome() for attempt in case.attempts()]
    assert not [(each.setting, each.why) for each in outcomes if not each.good]


@pytest.mark.slow    # the textbook solver beside it compiles for long
@pytest.mark.parametrize('case', [one for one in EVERY if one.id in QUICK],
                         ids=lambda one: one.id)
def test_case_at_the_default_setting(case):
    tried = [attempt for attempt in case.attempts() if is_quick(case, attempt)]
    assert tried
    for attempt in tried:
        outcome = attempt.outcome()
        assert outcome.good, (outcome.setting, outcome.why)


def test_every_number_of_the_list_has_a_case():
    assert {one.id for one in EVERY} | set(NODE_CASES) == {f'H{n}' for n in range(1, 36)}
    for family in FAMILIES:
        assert any(one.family == family for one in EVERY), family


@pytest.mark.slow
def test_the_textbook_solver_fails_what_it_must():
    """A pin sent 10 m away takes the cloth with it at any speed; ours follows at 5 m/s."""
    case = next(one for one in EVERY if one.id == 'H13')
    attempt = next(each for each in case.attempts() if each.setting == Setting())
    outcome = attempt.outcome()
    assert outcome.good
    assert outcome.textbook is False
    assert 'pins_at_max_speed' in outcome.reported


def track(strain, energy, *, dt=0.1) -> Trajectory:
    """Return two particles on one edge with these strains."""
    found = Trajectory(dt, Edges(np.array([[0, 1]]), np.ones(1)), np.ones(2, bool),
                       np.zeros((0, 3), np.int64), (np.zeros((0, 4), np.int64), np.zeros(0)))
    for e in strain:
        found.x.append(np.array([[0.0, 0.0, 0.0], [1.0 + e, 0.0, 0.0]]))
        found.v.append(np.zeros((2, 3)))
    found.energy = list(energy)
    return found


@pytest.mark.parametrize(('criterion', 'strain', 'fault'), [
    ({'strain': 0.4}, (0.0, 0.5, 0.0), 'strain 0.5'),
    ({'energy': 0.1}, (0.0, 0.0, 0.0), 'energy rise 1'),
    ({'recovery_strain': 0.01}, (0.0, 0.5, 0.02), 'at the end'),
    ({}, (0.0, np.nan, 0.0), 'not finite'),
    ({'check': lambda track: 'wrong'}, (0.0, 0.0, 0.0), 'wrong'),
])
def test_a_run_is_judged_by_what_its_case_names(criterion, strain, fault):
    run = track(strain, (0.0, 1.0, 0.0))
    trial = Trial(Setting(), {}, **criterion)
    assert any(fault in text for text in trial.judge(run, 0.0)[0])
    fine = Trial(Setting(), {}, strain=0.6, energy=1.1, recovery_strain=0.03)
    assert fine.judge(track((0.0, 0.5, 0.02), (0.0, 1.0, 0.0)), 0.0) == ([], pytest.approx(0.1)) \
        or fine.judge(track((0.0, 0.5, 0.02), (0.0, 1.0, 0.0)), 0.0)[0] == []


def test_recovery_counts_from_the_end_of_the_cause_and_lasts():
    run = track((0.0, 0.5, 0.1, 0.5, 0.1, 0.1), (0.0,) * 6)
    assert run.recovery_time(0.1, 0.2) == pytest.approx(0.3)
    assert run.recovery_time(0.1, 0.05) is None
    assert run.recovery_time(0.1, 0.2, within=0.2) is None


def test_a_map_is_drawn(tmp_path):
    results = stress('H3')
    assert columns(results) == ['no setting']
    assert draw(results, tmp_path / 'map.png').stat().st_size > 5000


def test_a_scene_cannot_ask_for_what_the_cases_spoil():
    attempt = next(each for case in EVERY for each in case.attempts()
                   if getattr(each, 'make_unsafe', None))
    assert 'relaxation' not in str(replace(attempt, scene=sheet()).scene)
