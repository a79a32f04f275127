"""Leapfrog: second order, as good as its steps are small, and guarded where they are not."""

from math import ceil

import numpy as np
import pytest

from support.scenes import GRAVITY, run, run_until_still, simulate
from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.scene.stability import stability_limit
from xpbd_ros.sim.measure import elastic_energy, kinetic_energy, potential_energy
from xpbd_ros.sim.particles.explicit_updates import (
    displacement_before,
    half_kick,
    newmark,
    stay,
)
from xpbd_ros.sim.stepping import explicit_guard

PINS = {'a': {'cloth': 'c', 'at': 'corner_00'}, 'b': {'cloth': 'c', 'at': 'corner_01'}}
EFFECTS = {'stretch': {'warp': 60.0, 'weft': 40.0}, 'shear': {'stiffness': 5.0},
           'bend': {'stiffness': 1e-3}}
AT_REST = {'pin': {}, 'damping': {'rate': 0.0}, 'force': {'per_mass': [0.0, 0.0, 0.0]}}
"""effects that do nothing at these values: one step for nearly all tests here"""
SOFT_PINS = {name: {**pin, 'compliance': 0.01} for name, pin in PINS.items()}
STIFF = {**EFFECTS, 'stretch': {'warp': 6000.0, 'weft': 4000.0}}
LOOSE = {'stretch': {'compliance': 1e3}, 'shear': {'stiffness': 1e-3}, 'bend': {'stiffness': 1e-9}}


def sheet(substeps, method='explicit', integrator=None, *, grid=(6, 5), **options):
    """Return a small cloth that swings from two corners."""
    return simulate(grid, density=0.2, method=method, substeps=substeps, **{
        'integrator': integrator or 'leapfrog', 'effects': EFFECTS, 'pins': PINS,
        'scene_effects': AT_REST, **options})


@pytest.mark.parametrize('compliance', [0.0, 0.01, slow(0.1)])
def test_error_falls_at_second_order(compliance):
    """Also with springs at the pins."""
    pins = {name: {**pin, 'compliance': compliance} for name, pin in PINS.items()}
    frames = {substeps: run(sheet(substeps, pins=pins), 30).x for substeps in (32, 64, 128, 256)}
    gaps = [np.abs(frames[n] - frames[2 * n]).max() for n in (32, 64, 128)]
    assert gaps[0] > 1e-6
    for coarse, fine in zip(gaps[:-1], gaps[1:]):
        assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize('compliance', [0.0, *(10.0**-k for k in range(-1, 10))])
def test_springs_at_pins_are_stable_with_the_substeps_of_free_cloth(compliance):
    """However stiff, and where they are between second order and backward Euler."""
    pins = {name: {**pin, 'compliance': compliance} for name, pin in PINS.items()}
    simulation = sheet(1, pins=pins, scene_effects={**AT_REST, 'damping': {'rate': 1.0}})
    least = ceil(simulation.frame_dt * stability_limit(simulation.effects, simulation.state))
    simulation = sheet(least, pins=pins, scene_effects={**AT_REST, 'damping': {'rate': 1.0}})
    run(simulation, 200)
    assert simulation.stats()['explicit_redone'] == 0


@pytest.mark.slow
@pytest.mark.parametrize(('substeps', 'most'), [(256, 2e-4), (1024, 1.5e-3)])
def test_float32_keeps_small_changes_of_velocity(substeps, most):
    """Differences of places have lost it: 0.03 m and 0.4 m off."""
    double, single = (run(sheet(substeps, effects=STIFF, precision=precision), 30).x
                      for precision in ('float64', 'float32'))
    assert np.abs(single - double).max() < most


def test_float32_keeps_what_springs_at_pins_move_by_less_than_the_last_bit():
    """Positions alone lose it: 45 mm off."""
    pins = {name: {**pin, 'compliance': 0.1} for name, pin in PINS.items()}
    double, single = (run(sheet(1024, pins=pins, precision=precision), 30).x
                      for precision in ('float64', 'float32'))
    assert np.abs(single - double).max() < 1e-3


def test_velocity_is_of_the_frame_not_half_a_substep_older():
    errors = [np.abs(run(sheet(n), 30).v - run(sheet(512), 30).v).max() for n in (32, 64)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)


def test_free_fall_is_exact_at_any_number_of_substeps():
    """½ g t², from the first frame on; backward Euler has n (n + 1) for n²."""
    for substeps in (1, 7):
        frame = run(sheet(substeps, effects=LOOSE, pins={}), 30)
        np.testing.assert_allclose(frame.x[:, 2], -0.5 * GRAVITY * 0.25, rtol=1e-12)
        np.testing.assert_allclose(frame.v[:, 2], -0.5 * GRAVITY, rtol=1e-12)


def test_at_rest_the_forces_balance_the_weight_exactly():
    """Σ ∇E = m g at every free particle, whatever the substeps."""
    simulation = sheet(24, scene_effects={
        'damping': {'rate': 10.0}, 'force': {'per_mass': [0.0, 2.0, 0.0]}})
    run_until_still(simulation, speed=1e-9)
    assert simulation.stats()['explicit_redone'] == 0
    total = sum(simulation.frame().pins[name].force for name in 'ab')
    np.testing.assert_allclose(total, [0.0, 0.2 * 2.0, -0.2 * GRAVITY], atol=1e-7)


@pytest.mark.parametrize('more', [
    {'scene_effects': {'force': {'per_mass': [0.0, 2.0, 0.0]}}},
    slow({'pins': SOFT_PINS, 'scene_effects': {'force': {'per_mass': [0.0, 2.0, 0.0]}}}),
    slow({'pins': None, 'colliders': {'table': {'plane': {}, 'position': [
        0.0, 0.0, -0.005]}}, 'scene_effects': {
            'contact': {'thickness': 0.005}, 'friction': {},
            'self_collision': {'thickness': 0.003}}})])
def test_what_is_at_rest_shows_no_velocity_whatever_holds_it(more):
    """Springs and forces, which no projection is of, or a push in every substep."""
    simulation = sheet(24, **{**more, 'scene_effects': {
        'damping': {'rate': 10.0}, **more['scene_effects']}})
    run_until_still(simulation, speed=1e-9)
    assert simulation.stats()['explicit_redone'] == 0


def test_a_constant_force_is_as_exact_as_gravity():
    simulation = sheet(3, effects=LOOSE, pins={}, scene_effects={
        **AT_REST, 'force': {'per_mass': [0.0, 0.0, 2.0]}})
    frame, a = run(simulation, 30), 2.0 - GRAVITY
    np.testing.assert_allclose(frame.x[:, 2], 0.5 * a * 0.25, rtol=1e-12)
    np.testing.assert_allclose(frame.v[:, 2], 0.5 * a, rtol=1e-12)


@pytest.mark.slow
def test_it_agrees_with_lines_as_both_get_finer():
    truth = run(sheet(512), 30).x
    line = run(sheet(64, 'line', 'bdf2'), 30).x
    assert np.abs(run(sheet(64), 30).x - truth).max() < np.abs(line - truth).max() < 1e-2


def test_energy_stays_within_a_thousandth_for_ten_seconds():
    """V27; a symplectic method has no drift."""
    simulation = sheet(64)

    def energy():
        return (kinetic_energy(simulation.state) + potential_energy(simulation.state)
                + elastic_energy(simulation))
    start, most = energy(), 0.0
    for _ in range(600):
        simulation.step()
        most = max(most, kinetic_energy(simulation.state))
        assert energy() - start <= 1e-3 * most
    assert simulation.stats()['explicit_redone'] < 6    # where the cloth snaps


@pytest.mark.parametrize('effect, mesh', [('bend', False), slow('bend', True), ('hinge', True),
                                          slow('hinge', False)])
def test_the_energy_of_a_rolled_sheet_is_not_taken_for_instability(effect, mesh):
    """It unrolls at rest, without weight: all of its energy is that of bending."""
    simulation = simulate((6, 5), mesh=mesh, density=0.2, gravity=(0.0, 0.0, 0.0),
                          method='explicit', integrator='leapfrog', substeps=100,
                          scene_effects=None if mesh else AT_REST, effects={
                              'stretch': {'warp': 200.0, 'weft': 200.0},
                              effect: {'stiffness': 0.05},
                              **({} if mesh else {'shear': {'stiffness': 5.0}})})
    x = simulation.state.x
    x[2], x[0] = 0.3 * (1.0 - np.cos(x[0] / 0.3)), 0.3 * np.sin(x[0] / 0.3)
    built = simulation.effects[effect]
    start = elastic_energy(simulation)
    assert built.stored_energy(simulation.state) == pytest.approx(
        built.constraints.energy(x), rel=1e-12) and built.stored_energy(
            simulation.state) > 0.8 * start
    run(simulation, 12)
    assert simulation.stats()['explicit_redone'] == 0
    assert elastic_energy(simulation) + kinetic_energy(simulation.state) == pytest.approx(
        start, rel=5e-3)


@pytest.mark.parametrize(('angle', 'more'), [(90.0, 1.6), slow(10.0, 1.2)], ids=str)
def test_the_bound_is_close_above_the_highest_frequency(angle, more):
    """Also where warp and weft pull along nearly one direction, as below a corner that holds."""
    simulation = sheet(64, gravity=(0, 0, 0), effects={**EFFECTS, 'shear': {'stiffness': 0.5}})
    state, slot = simulation.state, simulation.slot
    free = slot[state.inv_mass[slot] > 0.0]
    bound = stability_limit(simulation.effects, state)
    state.x[0] += np.cos(np.radians(angle)) * state.x[1]
    state.x[1] *= np.sin(np.radians(angle))

    def force(x):
        found = np.zeros_like(x)
        for built in simulation.effects.values():
            if built.constraints is not None:
                c, step = built.constraints, 1e-6
                for i in free:
                    for k in range(3):
                        there, back = x.copy(), x.copy()
                        there[k, i] += step
                        back[k, i] -= step
                        found[k, i] -= (c.energy(there) - c.energy(back)) / (2.0 * step)
        return found[:, free].ravel()

    stiffness = []
    for k in range(3):
        for i in free:
            there, back = state.x.copy(), state.x.copy()
            there[k, i] += 1e-4
            back[k, i] -= 1e-4
            stiffness.append((force(back) - force(there)) / 2e-4)
    mass = np.tile(state.mass[free], 3)
    highest = np.linalg.eigvals(np.array(stiffness) / mass).real.max()
    assert 0.5 * np.sqrt(highest) <= bound * (1.0 + 1e-3)
    assert bound < more * 0.5 * np.sqrt(highest)


@pytest.mark.slow
def test_the_swing_is_stable_and_exact_at_its_own_substeps():
    """As the sheet comes to hang from its corners, warp and weft pull along one direction."""
    keys = {'solver.method': 'explicit', 'cloths.sheet.grid.resolution': [31, 31],
            'solver.budget_ms': 100.0}
    asked = compile_scene(load_scene('swing', keys))
    finer = compile_scene(load_scene('swing', {
        **keys, 'solver.substeps': 2 * asked.solver.substeps}))
    apart = run(asked, 30).x - run(finer, 30).x
    assert asked.stats()['explicit_redone'] == 0
    assert np.sqrt((apart**2).sum(1).mean()) < 2e-5


def test_unstable_frames_fall_back_to_lines_and_are_counted():
    """Far too few substeps: each frame is the one that lines make, bit for bit."""
    guarded = sheet(2, effects=STIFF)
    assert guarded.solver.rough_substeps >= 1
    plain = sheet(guarded.solver.rough_substeps, 'line', 'backward_euler', effects=STIFF)
    for _ in range(40):
        frame, expected = guarded.step(), plain.step()
        assert np.isfinite(frame.x).all()
    redone = guarded.stats()['explicit_redone']
    assert redone > 30
    if redone == 40:
        np.testing.assert_array_equal(frame.x, expected.x)
        np.testing.assert_array_equal(frame.pins['a'].force, expected.pins['a'].force)


def test_without_its_guard_it_explodes(monkeypatch):
    monkeypatch.setattr('xpbd_ros.sim.stepping.explicit_guard.is_stable', lambda *_, **__: True)
    monkeypatch.setattr('xpbd_ros.sim.stepping.rollback.REACH', np.inf)
    wild = sheet(2, effects=STIFF)
    with np.errstate(all='ignore'):
        assert not np.abs(run(wild, 40).x).max() < 1e3


@pytest.mark.parametrize('force', [{'per_mass': [0.5, -1.0, 2.0]}, {
    'total': [0.0, 0.0, 0.02], 'cloth': 'c', 'at': 'corner_00'}])
def test_the_work_of_a_force_is_not_taken_for_instability(force):
    """From rest, without gravity or pins."""
    simulation = sheet(None, grid=(4, 3), size=(0.3, 0.25), gravity=(0.0, 0.0, 0.0), pins={},
                       scene_effects={**AT_REST, 'force': force})
    frame = run(simulation, 30)
    assert simulation.stats()['explicit_redone'] == 0
    assert simulation.stats()['frames_taken_back'] == 0
    if 'per_mass' in force:
        start = simulation.natural(simulation._start)
        np.testing.assert_allclose(frame.x - start, np.tile(0.125 * np.array(force['per_mass']),
                                                            (12, 1)), rtol=1e-9)


def test_the_work_of_pins_that_give_way_is_not_taken_for_instability():
    """They lift a sheet from rest, as rigid ones do."""
    pins = {name: {**pin, 'target': [0.0, 0.0, 1.0]} for name, pin in SOFT_PINS.items()}
    simulation = sheet(128, gravity=(0.0, 0.0, 0.0), pins=pins)
    run(simulation, 30)
    assert simulation.stats()['explicit_redone'] == 0


@pytest.mark.parametrize('after', [(0.3, 1.0, 0.0), (0.0, 10.0, 0.0),
                                   (np.nan, 1.0, 0.0), (0.0, np.nan, 0.0), (0.0, np.inf, 0.0)])
def test_what_cannot_come_of_the_frame_before_is_not_calm(after):
    kept = {'mass': 0.1, 'load': 0.1 * GRAVITY, 'acceleration': GRAVITY, 'dt': 1.0 / 60.0}
    assert explicit_guard.is_stable((0.0, 1.0, 0.0), (0.2, 1.0, 0.0), **kept)
    assert not explicit_guard.is_stable((0.0, 1.0, 0.0), after, **kept)


@pytest.mark.parametrize('more', [
    {'before': (0.0, 0.0, 2.0)}, {'after': 2.0}, {'work': 2.0}, {'noise': 2.0},
    {'load': 4.0, 'acceleration': 2.0}, {'before': (0.0, 2.0, 0.0)}], ids=str)
def test_energy_is_at_most_doubled_by_what_is_accounted_for(more):
    """2 J: of pins before or after, of their work, of rounding, of a force, or of before."""
    kept = {'mass': 1.0, 'load': 0.0, 'acceleration': 0.0, 'dt': 0.5, **more}
    before, pinned = kept.pop('before', (0.0, 0.0, 0.0)), kept.pop('after', 0.0)
    for energy, stable in ((3.9, True), (4.1, False)):
        assert explicit_guard.is_stable(before, (0.0, energy, pinned), **kept) == stable


def test_what_is_looked_at_is_strain_and_the_energy_of_free_particles_and_of_edges():
    simulation = sheet(64)
    state, random = simulation.state, np.random.default_rng(2)
    state.x[:, simulation.slot] += random.normal(0.0, 0.01, (3, len(simulation.slot)))
    state.v[:, simulation.slot] = random.normal(0.0, 1.0, (3, len(simulation.slot)))
    _, energy, pinned = simulation._guard._look()
    each = 0.5 * state.mass * (state.v**2).sum(0)
    held = (state.inv_mass == 0.0) & (state.mass > 0.0)
    assert held.sum() == 2
    assert pinned == pytest.approx(each[held].sum(), rel=1e-12)
    assert energy == pytest.approx(each[~held].sum() + elastic_energy(simulation), rel=1e-12)
    for size in (0.9, 1.2):
        state.x[:] = size * simulation._start
        assert simulation._guard._look()[0] == pytest.approx(abs(size - 1.0), rel=1e-12)


@pytest.mark.parametrize(('stiffness', 'redone'), [(0.01, 0), (1.0, 1)])
def test_soft_diagonals_may_be_compressed_and_stiff_ones_not(stiffness, redone):
    """A sheet sheared to 25°, warp and weft at rest: short diagonals lose 0.69 of their length."""
    simulation = sheet(128, gravity=(0, 0, 0), pins={}, effects={
        'stretch': {'warp': 1.0, 'weft': 1.0}, 'shear': {'stiffness': stiffness},
        'bend': {'stiffness': 1e-9}})
    x = simulation.state.x
    x[0] += np.cos(np.radians(25.0)) * x[1]
    x[1] *= np.sin(np.radians(25.0))
    simulation.step()
    assert simulation.stats()['explicit_redone'] == redone


@pytest.mark.slow
def test_a_gripper_that_starts_to_move_is_calm():
    simulation = compile_scene(load_scene('swing', {
        'solver.method': 'explicit', 'cloths.sheet.grid.resolution': [9, 9],
        'pins.left.motion': [[0.0, 0.0, 1.0, 1.5], [0.2, 0.0, 1.2, 1.5], [0.5, 0.0, 1.2, 1.5]]}))
    run(simulation, 40)
    assert simulation.stats()['explicit_redone'] <= 1    # its first, at most


def test_it_takes_as_many_substeps_as_it_needs_or_refuses():
    simulation = sheet(None, effects=STIFF)
    limit = stability_limit(simulation.effects, simulation.state) / 60.0
    assert simulation.solver.substeps == ceil(limit)
    fewer = sheet(ceil(limit) - 1, effects=STIFF).solver.reason
    assert fewer.endswith(f'as given; {ceil(limit)} would be stable in every orientation')
    assert sheet(ceil(limit), effects=STIFF).solver.reason.endswith('as given')
    assert sheet(ceil(limit), effects=STIFF).notes == ()
    note, = sheet(12, effects=STIFF).notes
    assert note == ('solver.substeps: explicit may be unstable with 12, and computes unstable '
                    f'frames again with line; give at least {ceil(limit)}, or take line')
    for change, text in (({'effects': {'stretch': {'compliance': 0.0}}}, 'rigid'),
                         ({'effects': {'stretch': {'compliance': 1e-12}}}, 'to be stable')):
        with pytest.raises(InputError, match=text):
            simulate((6, 5), method='explicit', integrator='leapfrog', substeps=None, **change)
    with pytest.raises(InputError, match='must be 1 with method explicit'):
        sheet(64, iterations=2)
    for method, integrator in (('explicit', 'bdf2'), ('line', 'leapfrog')):
        with pytest.raises(InputError, match='goes with'):
            sheet(4, method, integrator)


@pytest.mark.parametrize('also', ['hinge', *(pytest.param(
    name, marks=pytest.mark.slow) for name in ('bend', 'cross_bend'))])
@pytest.mark.parametrize('method, integrator', [
    slow('explicit', 'leapfrog'), ('gauss_seidel', 'backward_euler')])
def test_an_effect_elsewhere_changes_nothing_here(method, integrator, also, tmp_path):
    """A sheet of two triangles, and a loose one without a hinge."""
    (tmp_path / 'two.obj').write_text(''.join(f'v {v}\n' for v in (
        '0 0 0', '1 0 0', '1 1 0', '0 1 0', '3 0 0', '4 0 0', '3 1 0'))
        + 'f 1 2 3\nf 1 3 4\nf 5 6 7\n')
    found = []
    for effects in ({}, {also: {'stiffness': 1e-3}}):
        scene = simulate(mesh=str(tmp_path / 'two.obj'), gravity=(0.0, 0.0, 0.0), method=method,
                         integrator=integrator, substeps=50,
                         effects={'stretch': {'warp': 50.0, 'weft': 50.0}, **effects})
        scene.state.x[:, scene.slot] *= 1.02
        scene.state.x_prev[:] = scene.state.x
        found.append(run(scene, 1).x[4:])
    np.testing.assert_allclose(found[1], found[0], atol=1e-12)


def test_what_half_a_kick_leaves_is_known_before_it():
    """``displacement_before`` has the velocity half a substep earlier, unless ``stay`` kept it."""
    simulation, h = sheet(8), 2e-3
    state, rng = simulation.state, np.random.default_rng(2)
    state.v[:], state.apart.move[:] = rng.normal(size=(2, *state.v.shape))
    state.gravity[:] = 1e4, -2e4, 3e4
    stay(state, simulation.slot[7], h)
    before, expected = state.v.copy(), np.array([
        [displacement_before(state, i, k, h) for i in simulation.slot] for k in range(3)])
    half_kick(state, h, -0.5)
    np.testing.assert_allclose(h * state.v[:, simulation.slot], expected, rtol=1e-12)
    same = (state.v == before)[:, simulation.slot].all(0)
    assert np.flatnonzero(same).tolist() == sorted([7, *np.flatnonzero(
        state.inv_mass[simulation.slot] == 0.0)])


@pytest.mark.parametrize('square, gamma, beta', [
    (0.5, 0.0, 0.25), (1.0, 0.0, 0.25), (1.5, 0.5, 0.625), (2.0, 1.0, 1.0), (9.0, 1.0, 1.0),
    (np.inf, 1.0, 1.0)])
def test_springs_act_in_the_mean_where_they_are_resolved_and_late_where_not(square, gamma, beta):
    assert newmark(1.0, 1.0 / square) == pytest.approx((gamma, beta), rel=1e-12)
