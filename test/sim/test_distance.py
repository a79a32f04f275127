"""Elastic edges where they are hard: rigid, slack, coincident, over-constrained."""

import numpy as np
import pytest

from support.scenes import GRAVITY, hang, run, simulate
from xpbd_ros.sim.commands import Release
from xpbd_ros.sim.measure import largest_strain, momentum


@pytest.mark.parametrize('compliance', [0.0, 1e-3])
def test_coincident_particles_separate_and_keep_momentum(compliance):
    """H5; the gradient is undefined there."""
    after = []
    for _ in range(2):
        simulation = simulate((5, 1), effects={'stretch': {'compliance': compliance}},
                              gravity=(0, 0, 0), substeps=4)
        simulation.state.x[:, simulation.slot] = 0.5
        frame = run(simulation, 120)
        assert np.isfinite(frame.x).all()
        assert np.linalg.norm(np.diff(frame.x, axis=0), axis=1).min() > 0.01
        np.testing.assert_allclose(momentum(simulation.state), 0.0, atol=1e-12)
        after.append(simulation.hash())
    assert after[0] == after[1]


def test_rigid_edges_hold_a_cloth_together():
    """H1: α = 0, the case of position based dynamics."""
    simulation = simulate((8, 8), effects={'stretch': {'compliance': 0.0}}, substeps=20,
                          pins={'a': {'cloth': 'c', 'at': 'corner_00'}},
                          scene_effects={'damping': {'rate': 0.0}})
    for _ in range(120):
        frame = simulation.step()
        assert np.isfinite(frame.x).all()
        assert largest_strain(simulation) < 0.1
    energy = 0.5 * (simulation.state.mass[simulation.slot] * (frame.v**2).sum(1)).sum()
    assert energy < 1.0 * GRAVITY * 2.0**0.5    # no more than the fall gives


@pytest.mark.parametrize('stretch', [{'compliance': 1e14}, {'compliance': 1e300},
                                     {'warp': 1e-300, 'weft': 1e-300}])
def test_edges_without_stiffness_are_as_absent(stretch):
    """H2; the least that a scene may say: its inverse must not become infinite on the way."""
    with np.errstate(over='ignore'):
        simulation = simulate((3, 3), effects={'stretch': stretch}, substeps=4, iterations=3)
    simulation.state.x[2, simulation.slot[4]] += 0.5
    start = simulation.frame().x
    frame = run(simulation, 30)
    n, h = 120, simulation.frame_dt / 4
    fallen = start - [0.0, 0.0, 0.5 * GRAVITY * h**2 * n * (n + 1)]
    np.testing.assert_allclose(frame.x, fallen, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('compliance', [0.0, 1e-3])
def test_a_strip_pulled_to_twice_its_length_comes_to_rest(compliance):
    """H11: rigid edges have no solution then, and their strain is not even; but nothing hums."""
    simulation = simulate(
        (6, 1), effects={'stretch': {'compliance': compliance}}, gravity=(0, 0, 0), substeps=4,
        iterations=10, scene_effects={'damping': {'rate': 10.0}},
        pins={'a': {'cloth': 'c', 'at': 'corner_00'},
              'b': {'cloth': 'c', 'at': 'corner_01', 'target': [2.0, 0.0, 0.0]}})
    frame = run(simulation, 300)
    np.testing.assert_allclose(frame.v, 0.0, atol=1e-9)
    edges = np.diff(frame.x[:, 0])
    assert edges.min() >= 0.2 - 1e-12
    if compliance > 0.0:
        np.testing.assert_allclose(edges, 0.4, rtol=1e-9)


def test_a_cloth_torn_at_and_let_go_takes_its_shape_again():
    """H12: pulled to three times its length at 5 m/s."""
    simulation = simulate(
        (6, 6), effects={'stretch': {'compliance': 1e-3}}, gravity=(0, 0, 0), substeps=10,
        pins={'a': {'cloth': 'c', 'at': 'edge_x0'},
              'b': {'cloth': 'c', 'at': 'edge_x1', 'target': [3.0, 0.5, 0.0]}},
        scene_effects={'damping': {'rate': 5.0}})
    run(simulation, 40)
    assert largest_strain(simulation) > 1.9
    for frame in (run(simulation, 1, [Release('a'), Release('b')]), run(simulation, 119)):
        assert np.isfinite(frame.x).all()
    assert largest_strain(simulation) < 0.01
    assert np.abs(frame.v).max() < 0.01


def test_substeps_from_1_to_1000_give_less_and_less_error():
    """H19: under-resolved is soft, never unstable."""
    length = []
    for substeps in (1, 10, 100, 1000):
        simulation = hang(9, damping=4.0, effects={'stretch': {'compliance': 1e-5}},
                          substeps=substeps)
        frame = run(simulation, 180 if substeps < 1000 else 60)
        assert np.isfinite(frame.x).all()
        length.append(-frame.x[-1, 2])
    assert length[0] > length[1] > length[2] > 1.0
    assert length[2] == pytest.approx(length[3], abs=2e-3)
