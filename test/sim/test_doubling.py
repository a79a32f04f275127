"""Step doubling: what a frame started from gives it again, and tells how wrong it is."""

from types import SimpleNamespace

import numba
import numpy as np
import pytest

from support.scenes import EXAMPLES, FEW, SETTINGS, simulate, USUAL, with_effects
from support.tiers import quick_only, slow
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.sim.commands import Grasp, Pose, Release, SetKey
from xpbd_ros.sim.measure import largest_strain
from xpbd_ros.sim.particles.state import history_arrays, new_state, with_solver_storage
from xpbd_ros.sim.stepping.error_estimate import estimate, refine, rms
from xpbd_ros.sim.stepping.overwrite import overwrite


def kept(simulation, frames: int):
    """Return the start of the last of some frames."""
    for _ in range(frames - 1):
        simulation.step()
        assert simulation.start is None
    simulation.step(keep=True)
    return simulation.start


def position_error(simulation, state) -> float:
    """Return how far the simulation is from a state, RMS [m]."""
    apart = (simulation.state.x - state.x)[:, simulation.slot]
    return rms(np.sqrt((apart**2).sum(0)))


@pytest.mark.parametrize(('method', 'integrator', 'names'), [
    ('line', 'ndf2', FEW), *quick_only(((*setting, USUAL) for setting in SETTINGS), (
        'gauss_seidel', 'backward_euler', USUAL))],
    ids=lambda value: value if isinstance(value, str) else f'{len(value)} effects')
def test_the_start_of_a_frame_gives_the_same_frame(method, integrator, names):
    simulation = with_effects(method=method, integrator=integrator, substeps=20, names=names)
    start = kept(simulation, 4)
    assert [numba.typeof(a) for a in start.effects] == [
        numba.typeof(a) for a in simulation._tuple]
    for _ in range(2):    # it stays as it is
        again = start.end(1)
        np.testing.assert_array_equal(again.x, simulation.state.x)
        np.testing.assert_array_equal(again.v, simulation.state.v)


@pytest.mark.parametrize(('integrator', 'names'), [('ndf2', FEW), slow('bdf2', USUAL)],
                         ids=lambda value: value if isinstance(value, str) else None)
def test_the_start_of_every_kept_frame_gives_that_frame_in_the_memory_of_the_first(integrator,
                                                                                  names):
    simulation = with_effects(method='line', integrator=integrator, substeps=20, names=names)
    corner, memory = Pose(tuple(simulation.frame().x[-1])), []
    for commands in ([], [Grasp('held', corner, 0.01)], [], [SetKey('gravity', (1.0, 0.0, -9.0))],
                     [Release('held')], []):
        frame = simulation.step(commands, keep=True)
        assert not frame.refused
        np.testing.assert_array_equal(simulation.start.end(1).x, simulation.state.x)
        memory.append(simulation.start.state.x.ctypes.data)
        simulation.step()
    assert memory[0] == memory[1] == memory[2]


def test_a_copy_is_overwritten_only_by_one_of_its_form():
    a, b = np.zeros(3), np.ones(3)
    pair = [(a.copy(), b.copy()), (a.copy(),) * 2]
    for source in ((b, a), (a, a)):
        apart = source[0] is not source[1]
        assert [overwrite(target, source) for target in pair] == [apart, not apart]
    assert not overwrite((a.copy(),), (np.zeros(4),))
    assert not overwrite((a.copy(), 1.0), (b, 2.0))
    assert not overwrite((a.copy(), b.copy()), (a,))


@pytest.mark.slow
def test_all_effects_start_again(all_effects):
    start = kept(all_effects, 3)
    np.testing.assert_array_equal(start.end(1).x, all_effects.state.x)


@pytest.fixture
def all_effects():
    """Return a scene with every effect that a sheet can have."""
    return with_effects(names=tuple(EXAMPLES), substeps=4)


def test_a_history_moves_along_a_cubic_exactly():
    state = with_solver_storage(
        new_state(np.zeros((1, 3)), np.ones(1), (0, 0, 0), np.array([0]), 8),
        integrator='ndf2', apart=None, constraints=[])
    h = 0.3

    def at(t):
        return 1.0 - 2.0 * t + 3.0 * t**2 + 0.5 * t**3, -2.0 + 6.0 * t + 1.5 * t**2
    for factor in (2, 4):
        last_x, last_v, older_x, older_v = history_arrays(state)
        for array, value in zip((state.x, state.v, last_x, last_v), (*at(0.0), *at(-h))):
            array[:] = value
        refine(state, h, factor)
        assert [a[0, 0] for a in (last_x, last_v, older_x, older_v)] == pytest.approx(
            [*at(-h / factor), *at(-2 * h / factor)], rel=1e-14)


@pytest.mark.parametrize('order', [1, 2])
@pytest.mark.parametrize('strain, least, most, frames', [(0.05, 0.78, 1.19, 2),
                                                         (0.2, 0.89, 1.05, 6)])
def test_the_estimate_is_between_those_for_first_and_second_order(strain, least, most, frames,
                                                                  order):
    """The errors are C / N^p; only the slots of particles count, not the padding."""
    rng, slot = np.random.default_rng(order), np.array([0, 2, 3, 6])
    exact, error = rng.normal(size=(2, 3, 8))
    start = SimpleNamespace(substeps=5, end=lambda factor: SimpleNamespace(
        x=exact + error / factor**order))
    found = estimate(start, exact + error, frame=3, slot=slot, strain=strain)
    true = np.linalg.norm(error[:, slot], axis=0)
    assert (found.frame, found.substeps, found.resolved, found.frames) == (3, 5, True, frames)
    assert least < found.rms / rms(true) < most
    assert found.largest / true.max() == pytest.approx(found.rms / rms(true), rel=1e-12)


@pytest.mark.parametrize(('method', 'integrator', 'substeps'), [
    ('line', 'bdf2', 12), ('line', 'bdf2', 24),
    pytest.param('line', 'ndf2', 24, marks=pytest.mark.slow),
    ('gauss_seidel', 'backward_euler', 12), ('gauss_seidel', 'backward_euler', 48),
    pytest.param('line', 'backward_euler', 24, marks=pytest.mark.slow)])
def test_the_estimate_is_within_a_factor_of_three(method, integrator, substeps):
    simulation = swing(method, integrator, substeps)
    seen = 0
    for _ in range(5):
        start = kept(simulation, 8)
        found = estimate(start, simulation.state.x, frame=simulation.index,
                         slot=simulation.slot, strain=largest_strain(simulation))
        true = position_error(simulation, start.end(64))
        assert found.resolved
        assert found.rms / 3.0 < true < 3.0 * found.rms
        assert found.largest > found.rms
        seen += found.frames
    assert seen >= 10


@pytest.mark.parametrize('name', quick_only(['swing', 'drape', 'flag'], 'swing'))
@pytest.mark.parametrize(('method', 'integrator', 'factor'), quick_only([
    ('line', 'bdf2', 0.6), ('line', 'bdf2', 1), ('line', 'ndf2', 1), ('line', 'ndf2', 2),
    ('gauss_seidel', 'backward_euler', 1), ('gauss_seidel', 'backward_euler', 4)],
    ('line', 'ndf2', 1)))
def test_the_estimate_holds_on_shipped_scenes(name, method, integrator, factor):
    """Most frames are resolved, some where substeps are fewer than those of the default."""
    keys = {'solver.method': method, 'solver.integrator': integrator}
    simulation = compile_scene(load_scene(name, keys))
    simulation = compile_scene(load_scene(name, {
        **keys, 'solver.substeps': round(factor * simulation.solver.substeps)}))
    held = 0
    for _ in range(8):
        start = kept(simulation, 11)
        found = estimate(start, simulation.state.x, frame=simulation.index,
                         slot=simulation.slot, strain=largest_strain(simulation))
        true = position_error(simulation, start.end(32))
        assert not found.resolved or found.rms / 3.0 < true < 3.0 * found.rms
        held += found.resolved
    assert held >= (4 if factor >= 1 else 3)


def test_errors_of_frames_add_up_to_about_that_of_the_run():
    def keys(substeps):
        return {'solver.method': 'line', 'solver.integrator': 'ndf2', 'solver.substeps': substeps}
    truth = compile_scene(load_scene('swing', keys(512)))
    for _ in range(32):
        truth.step()
    for substeps in (16, 31):
        simulation, total = compile_scene(load_scene('swing', keys(substeps))), 0.0
        for _ in range(32):
            start = kept(simulation, 1)
            total += estimate(start, simulation.state.x, frame=simulation.index,
                              slot=simulation.slot, strain=largest_strain(simulation)).rms
        true = position_error(simulation, truth.state)
        assert true / 3.0 < total < 3.0 * true


def test_what_is_not_resolved_is_said_to_be():
    simulation = swing('gauss_seidel', 'backward_euler', 2, stiffness=5e4)
    start = kept(simulation, 20)
    found = estimate(start, simulation.state.x, frame=20, slot=simulation.slot,
                     strain=largest_strain(simulation))
    assert not found.resolved
    assert found.frames == 6
    assert position_error(simulation, start.end(64)) > 3.0 * found.rms


def swing(method, integrator, substeps, stiffness=1000.0):
    """Return a sheet that swings from two corners."""
    return simulate((13, 13), effects={'stretch': {'warp': stiffness, 'weft': stiffness},
                                       'shear': {'stiffness': 5.0}},
                    pins={'a': {'cloth': 'c', 'at': 'corner_10'},
                          'b': {'cloth': 'c', 'at': 'corner_11'}}, density=0.2,
                    method=method, integrator=integrator, substeps=substeps)
