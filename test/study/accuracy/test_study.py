"""What accuracy costs: errors that fall at their order, and a study that goes on."""

import csv
from dataclasses import replace
import json
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from support.meshes import disc, obj_text
from support.scenes import DOWN
from xpbd_ros.cli.accuracy import lines
from xpbd_ros.cli.main import main
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping, settings_overrides
from xpbd_ros.sim.commands import ReleaseAll, SetKey
from xpbd_ros.sim.stepping.methods import METHODS
from xpbd_ros.study.accuracy import study
from xpbd_ros.study.accuracy.baselines import Baseline, refusal
from xpbd_ros.study.accuracy.choose import recommend, Row, SHAPE
from xpbd_ros.study.accuracy.errors import errors
from xpbd_ros.study.accuracy.job import Job
from xpbd_ros.study.accuracy.measure import remarks, without_solver
from xpbd_ros.study.accuracy.picture import draw
from xpbd_ros.study.accuracy.report import facts, settings_text, write_csv, write_page
from xpbd_ros.study.accuracy.results_store import FILE
from xpbd_ros.study.accuracy.solver_setting import BASELINES, ladder, Setting, with_solver
from xpbd_ros.study.accuracy.trajectory import play, Trajectory
from xpbd_ros.study.accuracy.truth import extrapolated, independent, own_rungs, Truth

FRAMES = 24
SHEET = {'duration': 0.4, 'cloths': {'sheet': {
    'grid': {'size': [0.6, 0.4], 'resolution': [5, 4]}, 'density': 0.2,
    'effects': {'stretch': {'warp': 300.0, 'weft': 300.0}}}},
    'pins': {'left': {'cloth': 'sheet', 'at': 'corner_00'}}}


def sheet(**keys):
    return scene_from_mapping({**SHEET, **keys}, where='sheet.yaml', name='sheet')


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('study') / 'sheet'


@pytest.fixture(scope='module')
def found(folder):
    """Return a study with one method and everything beside it."""
    return study(sheet(), FRAMES, folder, methods=('line',), baselines=True)


def errors_of(found, method, integrator, precision='float64', iterations=1) -> dict[int, float]:
    return {row.setting.substeps: row.error('position') for row in found.rows
            if row.setting == Setting(method, integrator, row.setting.substeps, iterations,
                                      precision)}


@pytest.mark.parametrize('integrator, order', [('backward_euler', 1.0), ('bdf2', 2.0)])
def test_errors_fall_at_their_order(found, integrator, order):
    errors = errors_of(found, 'line', integrator)
    steps = sorted(errors)[-3:]
    slope = -np.polyfit(np.log(steps), np.log([errors[n] for n in steps]), 1)[0]
    assert slope == pytest.approx(order, abs=0.3)


def test_the_truth_is_independent_and_our_own_limit_agrees(found):
    truth = found.truth
    assert truth.kind == 'independent'
    assert truth.frames[-1] == truth.horizon == FRAMES, 'a hanging sheet is no chaos'
    assert (truth.uncertainty < 1e-6).all()
    assert (truth.apart < 1e-4).all()
    assert truth.apart[-1] < min(errors_of(found, 'line', 'bdf2').values())


@pytest.mark.parametrize('effects, why, scene', [
    ({'membrane': {'young': 50.0}, 'hinge': {'stiffness': 1e-3}, 'area': {'stiffness': 5.0}},
     None, {}),
    ({'stretch': {'warp': 50.0, 'weft': 50.0}, 'rayleigh': {'time': 1e-3}},
     'effects.rayleigh: has no energy, being dissipation', {}),
    ({'stretch': {'warp': 50.0, 'weft': 50.0}},
     'effects.contact: has no energy, being an inequality',
     {'effects': {'contact': {'thickness': 0.01}}}),
    ({'stretch': {'compliance': 0.0}}, 'has no rigid constraints', {}),
])
def test_effects_with_an_energy_are_compared_with_the_reference(effects, why, scene):
    """Baselines know fewer effects, and say which they do without."""
    chosen = scene_from_mapping({
        'cloths': {'c': {'grid': {'size': [0.2, 0.2], 'resolution': [3, 3]}, 'density': 0.2,
                         'effects': effects}},
        'pins': {'a': {'cloth': 'c', 'at': 'corner_00', 'compliance': 0.01}}, **scene},
        where='x', name='x')
    found = independent(chosen)
    assert found is None if why is None else why in found
    assert 'baselines' in refusal(chosen) or why in refusal(chosen)


def test_every_setting_has_an_error_and_a_time_or_a_reason(found):
    for row in found.rows:
        if row.errors.finite:
            assert row.timing.ms_p50 > 0.0
            assert row.timing.bytes > 20 * 7 * 8
            assert row.timing.frames == FRAMES
            assert row.errors.max_m[-1] >= row.errors.rms_m[-1] > 0.0
        else:
            assert row.errors.note
    assert sum(row.scene for row in found.rows) == 1
    kinds = {(row.setting.integrator, row.setting.precision) for row in found.rows
             if row.setting.method == 'line'}
    assert kinds == {('backward_euler', 'float64'), ('bdf2', 'float64'), ('ndf2', 'float64'),
                     ('ndf2', 'float32')}


def test_baselines_are_there_and_never_on_the_front(found):
    by_method = {method: [row for row in found.rows if row.setting.method == method]
                 for method in BASELINES}
    assert all(by_method.values())
    assert by_method['mass_spring'][-1].errors.rms_m[-1] < 1e-2
    assert not any(row.pareto for rows in by_method.values() for row in rows)


def test_a_run_that_is_not_finite_is_listed_with_its_reason(found, folder):
    setting = Setting('mass_spring', 'symplectic_euler', 1)
    errors = Job(sheet(), 900, {}, folder).errors(setting)
    assert re.fullmatch('not finite after [0-9.]+ s', errors.note)
    assert not errors.finite
    listed = lines(replace(found, rows=[*found.rows, Row(setting, errors)]), None, 1.0)
    assert f'  left out: mass_spring symplectic_euler 1×1: {errors.note}' in listed


def test_a_run_with_redone_frames_says_too_that_it_is_not_finite():
    track = Trajectory({}, *np.zeros((3, 4)), np.zeros((4, 1)), {}, ended=3, redone=2)
    truth = SimpleNamespace(frames=(), most_kinetic=1.0)
    assert errors(track, truth, None, 0.1).note == (
        'not finite after 0.2 s; 2 of 3 frames computed with line')


def test_only_xpbd_converges_not_decayed_multipliers_or_pbd(found):
    decayed = errors_of(found, 'decayed_multiplier', 'backward_euler')
    ours = errors_of(found, 'line', 'backward_euler')
    assert decayed[max(decayed)] > 10.0 * ours[max(ours)]
    pbd, textbook = ([row.error('position') for row in found.rows if row.setting.method == method]
                     for method in ('pbd', 'textbook_xpbd'))
    assert abs(textbook[-1] / textbook[-2] - 1.0) < 0.01, 'converged within the step'
    assert pbd[-1] != pytest.approx(textbook[-1], rel=0.01)


def test_with_inputs_the_truth_is_our_own_limit(found, tmp_path):
    """A pin lets go: the independent solver takes no inputs, and baselines neither."""
    let_go = study(sheet(), FRAMES, tmp_path / 's', methods=('line',), baselines=True,
                   commands={8: [ReleaseAll()]})
    assert let_go.truth.kind == 'own limit'
    assert {one.method: one.reason for one in let_go.refused} == dict.fromkeys(
        BASELINES, 'take no inputs')
    assert let_go.truth.x[-1][:, 2].max() < found.truth.x[-1][:, 2].max() - 0.1, 'it fell'
    errors = errors_of(let_go, 'line', 'bdf2')
    assert errors[2] < 2e-3
    assert errors[8] < 0.2 * errors[2], 'faster than of first order, down to that of the limit'


def test_an_unloaded_cloth_is_judged_by_its_shape(found, tmp_path):
    assert found.by == 'position'
    assert found.truth.loaded == 1.0
    later = sheet(gravity=[0.0, 0.0, 0.0], pins={'left': {
        **SHEET['pins']['left'], 'motion': [[0.0, 0, 0, 0], [0.2, 0, 0, 0], [0.4, 0, 0, 0.2]]}})
    lifted = study(later, FRAMES, tmp_path / 's', methods=('line',), times=[6])
    assert lifted.truth.loaded == 0.0
    assert lifted.by == 'shape'
    assert lifted.what == 'heights of the particles, mean from 0.3 s on'


def test_a_study_goes_on_where_it_was_interrupted(found, folder, tmp_path, monkeypatch):
    def interrupted(items, what):
        for k, item in enumerate(items):
            if what == 'settings' and k == 5:
                raise KeyboardInterrupt
            yield item

    with pytest.raises(KeyboardInterrupt):
        study(sheet(), FRAMES, tmp_path / 's', methods=('line',), progress=interrupted)
    file = tmp_path / 's' / FILE
    before = file.read_text()
    assert before.count('\n') == 6
    file.write_text(before + '{"setting": "line bd')    # and the disk was full
    ran = []
    monkeypatch.setattr(Job, 'errors', lambda self, setting, run=Job.errors: (
        ran.append(setting.key), run(self, setting))[1])
    monkeypatch.setattr('xpbd_ros.study.accuracy.measure.find_truth', None)
    again = study(sheet(), FRAMES, tmp_path / 's', methods=('line',))
    done = {json.loads(line)['setting'] for line in before.splitlines()[1:]}
    assert len(done) == 5
    assert not done & set(ran)
    assert done | set(ran) == {row.setting.key for row in again.rows}
    whole = {row.setting.key: row.errors for row in found.rows}
    assert all(row.errors == whole[row.setting.key] for row in again.rows), 'the same to the bit'


def test_a_study_of_something_else_is_refused(found, folder, tmp_path):
    for scene, frames, what in ((sheet(gravity=[0, 0, -1.0]), FRAMES, 'scene'),
                                (sheet(), FRAMES - 1, 'duration')):
        with pytest.raises(InputError, match=f'holds a study with another {what}; name another'):
            study(scene, frames, folder, methods=('line',))
    (tmp_path / 'mine').mkdir()
    with pytest.raises(InputError, match='mine: exists already, and holds no study'):
        study(sheet(), FRAMES, tmp_path / 'mine')


def test_a_study_of_another_mesh_is_refused(tmp_path):
    def interrupted(items, what):
        raise RuntimeError

    mesh = tmp_path / 'disc.obj'
    mesh.write_text(obj_text(*disc(1)))
    scene = scene_from_mapping({'cloths': {'c': {'mesh': {'file': str(mesh)}, 'density': 0.2}}},
                               where='disc.yaml', name='disc')
    for _ in range(2):
        with pytest.raises(RuntimeError):
            study(scene, 2, tmp_path / 's', progress=interrupted)
    mesh.write_text(obj_text(*disc(2)))
    with pytest.raises(InputError, match='holds a study with another scene; name another'):
        study(scene, 2, tmp_path / 's', progress=interrupted)


def test_the_report_holds_all_and_needs_no_other_file(found, tmp_path):
    chosen = recommend(found.rows, found.by, budget=50.0, floor=found.floor)
    picture = draw(found, tmp_path / 'a.png', chosen=chosen, budget=50.0)
    said = facts(found, chosen, 50.0, None, None)
    settings = settings_text(found, chosen)
    page = write_page(found, tmp_path / 'a.html', picture, said, chosen, settings).read_text()
    assert page.count('<img') == 1
    assert re.findall('src="(.{22})', page) == ['data:image/png;base64,']
    assert 'href=' not in page
    for row in found.rows:
        assert f'{row.setting.method} {row.setting.integrator} {row.setting.substeps}×' in page
    assert found.machine['name'] in page
    with write_csv(found, tmp_path / 'a.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(found.rows)
    for line, row in zip(rows, found.rows):
        assert line['method'] == row.setting.method
        if row.errors.finite:
            assert float(line['rms_error_m']) == row.errors.rms_m[-1]
    (tmp_path / 'settings.yaml').write_text(settings)
    again = compile_scene(scene_from_mapping(
        SHEET, where='x', name='x', overrides=settings_overrides(str(tmp_path / 'settings.yaml'))))
    assert again.solver.substeps == chosen.setting.substeps
    assert (again.solver.method, again.solver.integrator) == (chosen.setting.method,
                                                              chosen.setting.integrator)


@pytest.mark.parametrize('p95', [1.9, 2.1])
def test_a_rerun_beyond_the_budget_is_said(found, p95):
    row = next(row for row in found.rows if row.timing)
    said = dict(facts(found, row, 2.0, None, (row.errors, replace(row.timing, ms_p95=p95))))
    assert said['rerun'].endswith(f'{p95} ms p95' + ', over the budget' * (p95 > 2.0))


@pytest.mark.parametrize('factor', [0.5, 2.0])
def test_an_error_below_the_uncertainty_of_the_truth_is_noted(found, factor):
    said = facts(found, None, None, factor * found.floor, None)
    assert (('note', f'the uncertainty of the truth is {found.floor:.2g} m; smaller errors '
             'cannot be verified') in said) == (factor < 1.0)


@pytest.mark.parametrize('share', [0.99, 0.4])
def test_a_busy_machine_is_said(found, share):
    rows = [replace(row, timing=replace(row.timing, cpu_share=share)) for row in found.rows
            if row.timing]
    said = facts(replace(found, rows=rows), rows[0], 50.0, None, None)
    assert (('note', 'the machine was busy: timed runs had 40 % of a core, and their times may be '
             'too long') in said) == (share == 0.4)


def test_what_a_scene_cannot_have_is_listed_with_the_reason():
    rigid = sheet(cloths={'sheet': {**SHEET['cloths']['sheet'],
                                    'effects': {'stretch': {'compliance': 0.0}}}})
    settings, refused = ladder(rigid, METHODS)
    assert [one.method for one in refused] == ['explicit']
    assert refused[0].reason.startswith('solver.method: explicit cannot do rigid constraints')
    assert {one.method for one in settings} == set(METHODS) - {'explicit'}
    assert len({one.key for one in settings}) == len(settings)


@pytest.mark.parametrize('keys', [
    {'cloths.sheet.effects.stretch': {'compliance': 0.0}},
    {'cloths.sheet.density': 1e-6, 'frame_rate': 5.0}])
def test_no_setting_has_more_substeps_than_a_scene_may(keys):
    scene = scene_from_mapping(SHEET, where='sheet.yaml', name='sheet', overrides=keys)
    settings = [one for one in ladder(scene)[0] if not one.is_baseline]
    for setting in (*own_rungs(scene), *settings):
        compile_scene(with_solver(scene, setting.block()))
    assert max(setting.substeps for setting in settings) > 1000


def test_a_target_for_the_error_is_no_part_of_a_setting(found):
    """It would change the substeps that a study varies; settings leave it its room."""
    chosen = recommend(found.rows, found.by, budget=50.0)
    scene = sheet(solver={'substeps': 4, 'error_target': 1e-3, 'max_substeps': 8})
    settings, refused = ladder(scene, ('line',))
    assert max(one.substeps for one in settings) > 8
    assert not refused
    text = settings_text(replace(found, scene=scene), chosen)
    again = scene_from_mapping(scene.raw, where='x', name='x', overrides={
        f'solver.{key}': value for key, value in yaml.safe_load(text)['solver'].items()})
    assert compile_scene(again).solver.substeps == chosen.setting.substeps > 8


def test_a_limit_is_extrapolated_at_the_observed_order():
    truth, error = np.array([[1.0, 2.0, 3.0]]), np.array([[0.3, -0.1, 0.2]])
    for order in (1.0, 2.0):
        got, uncertainty = extrapolated([truth + error * 2.0**(-order * k) for k in range(4)])
        np.testing.assert_allclose(got, truth, atol=1e-12)
        assert uncertainty == pytest.approx(np.linalg.norm(error) * 2.0**(-3.0 * order))
    runs = [truth, truth + error, truth - error]
    got, uncertainty = extrapolated(runs)
    assert (got == runs[-1]).all()
    assert uncertainty == pytest.approx(4.0 * np.linalg.norm(error)), 'they do not agree at all'


def test_inputs_that_set_the_solver_are_left_out():
    pin, substeps = SetKey('gravity', [0, 0, 0]), SetKey('solver.substeps', 3)
    assert without_solver({1: [pin, substeps], 2: [substeps]}) == {1: [pin]}


@pytest.mark.parametrize('growth, text', [(1e-2, 'with any solver'), (1e-8, 'would be longer')])
def test_it_says_why_trajectories_part(growth, text):
    nothing = np.zeros(0)
    truth = Truth('own limit', '', 1.0, 10, nothing, nothing, nothing, nothing, nothing, 1.0,
                  nothing, 0.0, 0.0, nothing, np.full(31, growth), 1.0)
    (said,) = remarks(sheet(), truth, 30, 0.1)
    assert said.startswith('trajectories are predictable for 1 s: ')
    assert text in said
    truth.horizon = 30
    assert remarks(sheet(), truth, 30, 0.1) == []


def test_a_textbook_solver_hangs_as_far_as_ours():
    """Converged: a chain of its own weight; decayed multipliers are 20 times too soft."""
    scene = scene_from_mapping({
        'cloths': {'c': {'grid': {'size': [1.0, 1.0], 'resolution': [5, 1]}, 'density': 1.0,
                         'pose': {'orientation': DOWN},
                         'effects': {'stretch': {'warp': 1e4, 'weft': 1e4}}}},
        'pins': {'top': {'cloth': 'c', 'at': 'corner_00'}},
        'effects': {'damping': {'rate': 10.0}},
        'solver': {'method': 'line', 'substeps': 8}}, where='x', name='x')
    exact = 0.5 * 9.80665 / 1e4
    sag = {}
    for method, substeps, iterations in (('textbook_xpbd', 1, 400), ('pbd', 1, 400),
                                         ('decayed_multiplier', 100, 1), ('mass_spring', 100, 1)):
        simulation = Baseline(compile_scene(scene), Setting(method, '', substeps, iterations))
        track = play(simulation, 300)
        sag[method] = -track.heights[-1].min() - 1.0
        assert track.kinetic[-1] < 1e-6
    assert sag['textbook_xpbd'] == pytest.approx(exact, rel=1e-3)
    assert sag['mass_spring'] == pytest.approx(exact, rel=1e-2)
    assert sag['decayed_multiplier'] == pytest.approx(20.0 * exact, rel=0.05)
    assert sag['pbd'] < 0.1 * exact, 'stiffer than asked, by its iterations'


@pytest.mark.slow
def test_swing_is_compared_as_far_as_it_can_be(tmp_path):
    """A sheet that buckles: to half a second; of the rest only means are known."""
    scene = load_scene('swing', {'cloths.sheet.grid.resolution': [15, 15]})
    found = study(scene, 120, tmp_path / 's', methods=('line',), processes=2)
    assert 0.2 < found.truth.horizon * found.frame_dt < 1.5
    assert 'with any solver' in found.notes[0]
    assert all(math.isfinite(row.error(SHAPE)) for row in found.rows if row.errors.finite)


BAD = {
    'budget': (['--budget', '-1'], '--budget: must be > 0 ms (got -1)'),
    'budget nan': (['--budget', 'nan'], '--budget: must be > 0 ms (got nan)'),
    'error': (['--max-error', '0'], '--max-error: must be > 0 m (got 0)'),
    'times': (['--times', '0.1,9'], "--times: must be from a frame (0.0167 s) to the duration, "
              "2 s (got '9')"),
    'times text': (['--times', 'soon'], "(got 'soon')"),
    'method': (['--methods', 'lines'], "--methods lines: unknown method; did you mean 'line'?"),
    'jobs': (['--jobs', '0'], '--jobs: must be >= 1 (got 0)'),
    'output': (['-o', '.'], '.: exists already, and holds no study'),
    'duration': (['--duration', '-1'], 'duration: must be > 0 s'),
}


@pytest.mark.parametrize('words, said', BAD.values(), ids=BAD.keys())
def test_bad_input_is_one_line(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(['accuracy', 'swing', *words]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.count('\n') == 1
    assert said in err
    assert list(tmp_path.iterdir()) == []
