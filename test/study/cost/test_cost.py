"""The cost of effects: measured in the running scene, and nothing for what is not there."""

from dataclasses import replace
import json
from pathlib import Path

import numpy as np
import pytest

from support.shipped_scenes import NAMES
from xpbd_ros.cli.main import main
from xpbd_ros.effects import EFFECTS
from xpbd_ros.effects.contact import BuiltContact
from xpbd_ros.effects.self_collision import BuiltSelfCollision
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.cost_table import SHIPPED, table_text
from xpbd_ros.scene.load import load_scene, scene_from_text
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stepping.methods import METHODS
from xpbd_ros.study.cost import calibrate, cost, measure
from xpbd_ros.study.cost.clock import add_lap, lap_ns, new_clock, start
from xpbd_ros.study.cost.limits import limits

PLAIN = """
cloths:
  sheet:
    grid: {size: [0.6, 0.4], resolution: [9, 9]}
    density: 0.2
    effects: {stretch: {warp: 300.0, weft: 300.0}}
solver: {method: gauss_seidel, integrator: backward_euler}
"""
"""one effect: little to compile with the clock, which no cache keeps"""
SMALL = {'cloths.sheet.grid.resolution': [9, 9], 'solver.substeps': 4}


@pytest.fixture(scope='module')
def found():
    return cost(load_scene('swing', {**SMALL, 'solver.method': 'gauss_seidel'}), 6, rounds=2)


def test_every_effect_has_a_row_in_projection_order(found):
    assert [row.name for row in found.effects] == list(EFFECTS)
    assert {row.name for row in found.effects if row.present} == {'pin', 'shear', 'stretch'}
    assert (found.particles, found.frames, found.substeps) == (81, 6, 4)


def test_an_absent_effect_has_no_code_data_or_time(found):
    for row in found.effects:
        if not row.present:
            assert (row.constraints, row.kernels, row.bytes) == (0, 0, 0)
            assert (row.us_per_substep, row.share) == (0.0, 0.0)


def test_constraints_kernels_and_bytes_are_counted(found):
    rows = {row.name: row for row in found.effects}
    assert rows['stretch'].constraints == 2 * 9 * 8
    assert rows['shear'].constraints == 2 * 8 * 8
    for name in ('shear', 'stretch'):
        assert rows[name].kernels >= 3
        assert rows[name].bytes >= 24 * rows[name].constraints
        assert rows[name].us_per_substep > 0.0
        assert rows[name].ns_per_constraint == pytest.approx(
            1e3 * rows[name].us_per_substep / rows[name].constraints)


def test_memory_and_capacity_follow_from_the_limits(found):
    rows = {row.name: row for row in found.effects}
    for name in ('shear', 'stretch'):    # every particle of the 81, there and back
        assert rows[name].traffic == rows[name].bytes + 81 * 7 * 8
        assert rows[name].least_ns(50.0) == pytest.approx(
            rows[name].traffic / 50.0 / rows[name].constraints)
        assert rows[name].flops_in_time(30.0) == pytest.approx(
            30.0 * rows[name].ns_per_constraint)
    assert rows['wind'].least_ns(50.0) is rows['wind'].flops_in_time(30.0) is None


def test_the_rows_add_up_to_the_whole(found):
    """By definition of the last one: it says what the clock cannot tell apart."""
    rows = found.effects + found.others
    assert sum(row.share for row in rows) == pytest.approx(1.0)
    assert [row.name for row in found.others] == ['integration', 'python', 'rest']
    assert found.frame_ms > 0.0


def test_a_shared_array_counts_once():
    a = np.zeros(10)
    seen = set()
    assert measure.array_bytes((a, (a, np.zeros(3, np.float32), None)), seen) == 92
    assert measure.array_bytes((a,), seen) == 0


DRAPE = {'cloths.cover.grid.resolution': [6, 5], 'solver.substeps': 3,
         'cloths.cover.pose.position': [-0.5, -0.5, 0.33]}


@pytest.mark.slow    # the quick tests above have one method on one scene
@pytest.mark.parametrize('name, keys, method', [
    ('swing', SMALL, 'line'), ('drape', DRAPE, 'line'),
    ('swing', SMALL, 'gauss_seidel_symmetric'), ('swing', SMALL, 'gauss_seidel'),
    ('swing', SMALL, 'jacobi'), ('swing', {**SMALL, 'solver.substeps': 40}, 'explicit'),
    ('drape', {**DRAPE, 'solver.substeps': 40}, 'explicit')])
def test_the_clock_changes_no_bit(name, keys, method):
    """With every kind of stage and method; ``cost`` itself would fail where the runs part."""
    assert cost(load_scene(name, {**keys, 'solver.method': method}), 5, rounds=1).frames == 5


@pytest.mark.slow
@pytest.mark.parametrize('name', NAMES)
def test_what_a_shipped_scene_does_not_name_is_listed_as_absent(name):
    scene = load_scene(name)
    found = cost(scene, 1, rounds=1).effects
    assert [row.name for row in found] == list(EFFECTS)
    assert {row.name for row in found if row.present} == set(compile_scene(scene).effects)
    assert not any(row.kernels or row.bytes or row.constraints for row in found if not row.present)
    assert all(row.kernels and row.bytes for row in found if row.present)


def test_a_run_that_differs_is_not_believed(monkeypatch):
    monkeypatch.setattr(Simulation, 'hash', lambda self: id(self))
    with pytest.raises(AssertionError, match='computes something else'):
        cost(scene_from_text(PLAIN, where='plain.yaml', name='plain'), 1, rounds=1)


def test_a_lap_is_the_time_since_the_last():
    clock = new_clock(2)
    start(clock)
    add_lap(clock, 1)    # compiles
    clock.book[:] = 7
    start(clock)
    add_lap(clock, 1)
    assert clock.book[0].tolist() == [0, 0]
    assert clock.book[1, 1] == 1
    assert 0 < clock.book[1, 0] < 1_000_000_000
    assert 1.0 < lap_ns(1000) < 100_000.0


def test_the_limits_of_the_machine_are_plausible():
    most = limits()
    assert 0.1 < most['memory_gb_s'] < 2 * most['cache_gb_s']
    assert 0.1 < most['fma_gflop_s'] < 1000.0


def test_the_verb_prints_what_it_writes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path('plain.yaml').write_text(PLAIN)
    assert main(['cost', 'plain.yaml', '--duration', '0.05', '--json', 'c.json',
                 '--picture', 'c.png', '--set', 'solver.substeps=4']) == 0
    said, error = capsys.readouterr()
    assert error == ''
    numbers = json.loads((tmp_path / 'c.json').read_text())
    assert {'effects', 'frame_ms', 'particles', 'machine', 'limits'} <= set(numbers)
    assert {'name', 'present', 'constraints', 'us_per_substep', 'share',
            'bytes', 'least_ns', 'flops_in_time'} <= set(numbers['effects'][0])
    assert numbers['pictures'] == [str(tmp_path / 'c.png')]
    assert (tmp_path / 'c.png').stat().st_size > 5000
    for row in numbers['effects']:
        line = next(line for line in said.splitlines() if line.split()[:1] == [row['name']])
        assert ('absent' in line) == (not row['present'])
    assert len({line.index('absent') for line in said.splitlines() if 'absent' in line}) == 1
    assert numbers['machine']['name'] in said


def made_up(entries, seed=3):
    """Return runs of drawn sizes whose times are those of some entries of ``line``."""
    draw = np.random.default_rng(seed)
    counts = [{entry: float(draw.integers(100, 10_000)) for entry in entries} for _ in range(20)]
    return [calibrate.Run(f'made_{k}', 'line', 10, 100, each,
                          sum(entries[entry] * n for entry, n in each.items()))
            for k, each in enumerate(counts)]


def times_shipped(**factors):
    """Return some shipped entries of ``line``, multiplied."""
    return {('line', entry): factor * SHIPPED.methods['line'][entry]
            for entry, factor in factors.items()}


def test_a_fit_predicts_the_times_that_it_was_made_of():
    """Of a machine where edges cost twice as much as slots do, relative to the shipped table."""
    runs = made_up({**times_shipped(slot=0.4, edge=0.8, hinge=0.5, membrane=0.5),
                    ('effects', 'contact'): 0.5 * BuiltContact.ns_per_particle})
    table = calibrate.fitted(runs)
    for run in runs:
        assert run.predicted_ns(table) == pytest.approx(run.measured_ns, rel=0.08)
        assert run.predicted_ns(SHIPPED) > 1.5 * run.measured_ns
    shipped, found = (each.methods['line'] for each in (SHIPPED, table))
    assert found['edge'] / shipped['edge'] > 1.1 * found['slot'] / shipped['slot']


def test_what_no_run_has_scales_by_the_factor_of_the_machine():
    table = calibrate.fitted(made_up(times_shipped(slot=0.5, edge=0.5)))
    assert table.methods['jacobi']['hinge'] == pytest.approx(
        0.5 * SHIPPED.methods['jacobi']['hinge'], rel=0.01)
    assert table.effects['self_collision'] == pytest.approx(
        0.5 * BuiltSelfCollision.ns_per_particle, rel=0.01)


def test_a_run_that_was_interrupted_hardly_moves_the_fit():
    runs = made_up(times_shipped(slot=0.5, edge=0.5))
    runs[4] = replace(runs[4], measured_ns=20.0 * runs[4].measured_ns)
    table = calibrate.fitted(runs)
    assert table.methods['line']['slot'] == pytest.approx(
        0.5 * SHIPPED.methods['line']['slot'], rel=0.1)


@pytest.mark.parametrize('paying, expected', [
    ((41, 58, 82), 0.5 * 41**2), ((20, 82), 0.5 * 82**2), ((20, 41), 82**2)])
def test_two_threads_pay_from_where_all_larger_sheets_gain(paying, expected, monkeypatch):
    """One round of three may be disturbed, and a smaller sheet gain by chance."""
    rounds = []

    def gain(what, side, frames):
        rounds.append(side)
        return 1.3 if (side in paying) == (len(rounds) % 3 > 0) else 0.9
    monkeypatch.setattr(calibrate, 'free_cores', lambda: 2)
    monkeypatch.setattr(calibrate, 'gain_of_two_threads', gain)
    assert calibrate.particles_per_thread('contact', 60) == expected
    monkeypatch.setattr(calibrate, 'free_cores', lambda: 1)
    assert calibrate.particles_per_thread('contact', 60) == SHIPPED.for_thread('contact')
    assert calibrate.particles_per_thread('grid', 60) == SHIPPED.particles_per_thread['grid']


@pytest.mark.slow
def test_a_calibrated_table_is_one_that_auto_takes(tmp_path):
    table = calibrate.calibrate(count=10, frames=10)
    assert set(table.methods) == set(METHODS)
    for entries in table.methods.values():
        assert all(value > 0.0 for value in entries.values())
    assert table.effects['drag'] > 0.0
    (tmp_path / 'table.yaml').write_text(table_text(table, 'this CPU'))
    simulation = compile_scene(load_scene('drape', {
        'solver.cost_table': str(tmp_path / 'table.yaml')}))
    assert simulation.solver.substeps >= 4


def test_what_a_run_is_predicted_to_take_is_what_auto_reckons_with():
    run = calibrate.measure(load_scene('sheet'), 'line', 2)
    simulation = compile_scene(load_scene('sheet', {'solver.method': 'line'}))
    assert run.predicted_ns(SHIPPED) == pytest.approx(run.substeps * SHIPPED.substep_ns(
        'line', 1, simulation.effects, simulation.state,
        simulation.frame_dt / run.substeps))
    assert run.substeps == simulation.solver.substeps
    assert run.measured_ns > 0.0


@pytest.mark.parametrize('arguments, why', [
    ([], 'needs a scene, or --calibrate'),
    (['swing', '--calibrate', 'table.yaml'], 'does not go with scene'),
    (['--calibrate', 'table.yaml', '--set', 'solver.substeps=3'], 'does not go with --set'),
    (['--calibrate', 'there.yaml'], 'there.yaml')])
def test_arguments_that_do_not_go_together_are_refused(arguments, why, tmp_path, monkeypatch,
                                                       capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'there.yaml').write_text('')
    assert main(['cost', *arguments]) == 2
    assert why in capsys.readouterr().err
