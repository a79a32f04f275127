"""Jacobi: all at once, by a part that the constraint graph makes safe."""

import numpy as np
import pytest

from support.scenes import DOWN, run, run_stage, run_until_still, simulate
from xpbd_ros.sim.measure import momentum
from xpbd_ros.sim.particles.state import Substep
from xpbd_ros.sim.stepping import stages

PINS = {'a': {'cloth': 'c', 'at': 'corner_00'}, 'b': {'cloth': 'c', 'at': 'corner_01'}}
EFFECTS = {'stretch': {'warp': 60.0, 'weft': 40.0}, 'shear': {'stiffness': 5.0},
           'bend': {'stiffness': 1e-3}}


def sheet(method, iterations, **options):
    """Return a small cloth that hangs from two corners."""
    return simulate((6, 5), **{'effects': EFFECTS, 'pins': PINS, 'density': 0.2, 'substeps': 4,
                               'method': method, 'iterations': iterations,
                               'scene_effects': {'damping': {'rate': 8.0}}, **options})


def test_relaxation_is_one_over_the_largest_constraint_count():
    simulation = sheet('jacobi', 1)
    count = np.zeros(simulation.state.x.shape[1])
    for built in simulation.effects.values():
        for these in built.by_part:
            for particles in these.particles:
                count[particles] += 1
    assert simulation.state.apart.per_relaxation[0] == count.max() > 12


@pytest.mark.slow
def test_many_iterations_come_to_what_gauss_seidel_comes_to():
    a, b = (run_until_still(sheet(method, 1000, substeps=8), speed=1e-9)
            for method in ('jacobi', 'gauss_seidel'))
    np.testing.assert_allclose(a.x, b.x, atol=1e-4)
    np.testing.assert_allclose(a.pins['a'].force, b.pins['a'].force, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize('substeps, worst', [(16, 0.1), (64, 0.01)])
def test_short_substeps_make_it_as_stiff_as_asked(substeps, worst):
    """The sag with one iteration: its relative error falls as that of other methods."""
    hung = {'size': (0.5, 0.4), 'density': 0.3, 'pose': {'orientation': DOWN},
            'pins': {'a': {'cloth': 'c', 'at': 'edge_0x'}}, 'substeps': substeps,
            'effects': {'stretch': {'warp': 300.0, 'weft': 300.0}, 'shear': {'stiffness': 5.0}}}
    sags = []
    for method in ('gauss_seidel', 'jacobi'):
        simulation = sheet(method, 1, **hung)
        start = simulation.frame().x[:, 2].min()
        sags.append(start - run(simulation, 200).x[:, 2].min())
    assert sags[1] == pytest.approx(sags[0], rel=worst)


def test_the_order_of_the_effects_makes_no_difference():
    """Positions are read as they were before the pass."""
    simulation = sheet('jacobi', 1, pins=None, scene_effects=None)
    state, found = simulation.state, []
    state.x[:, simulation.slot] += np.random.default_rng(1).normal(0, 0.03, (3, 30))
    state.mobility[:] = state.inv_mass * 0.004**2
    before = state.x.copy()
    for parts in (simulation._tuple, simulation._tuple[::-1]):
        state.apart.move[:] = 0.0
        for part in parts:
            for stage in (stages.prepare, stages.project):
                run_stage(stage, part, state, Substep(0.004, 0.0, 1.0))
        found.append(state.apart.move.copy())
    np.testing.assert_array_equal(state.x, before)
    assert np.abs(found[0]).max() > 1e-6
    np.testing.assert_allclose(*found, rtol=0.0, atol=1e-15)


def test_momentum_stays():
    simulation = sheet('jacobi', 3, size=(1.25, 1.0), pins={}, gravity=(0, 0, 0),
                       scene_effects={'damping': {'rate': 0.0}}, effects={
                           'stretch': {'warp': 60.0, 'weft': 40.0}, 'shear': {'stiffness': 5.0}})
    simulation.state.x[:, simulation.slot] += np.random.default_rng(1).normal(0, 0.03, (3, 30))
    run(simulation, 20)
    assert np.abs(simulation.state.v).max() > 0.1
    np.testing.assert_allclose(momentum(simulation.state), 0.0, atol=1e-13)


@pytest.mark.parametrize('relaxed', [True, False])
def test_unrelaxed_it_diverges(relaxed):
    simulation = sheet('jacobi', 30, size=(1.25, 1.0), effects={
        'stretch': {'compliance': 0.0}, 'shear': {'stiffness': 1e5}})
    if not relaxed:
        simulation.state.apart.per_relaxation[0] = 1.0
    with np.errstate(all='ignore'):
        frame = run(simulation, 60)
    assert np.abs(frame.x).max() < 3.0, 'frames that are not finite are taken back'
    assert (simulation.stats()['frames_taken_back'] == 0) == relaxed
