"""Cross bend: what it stores beside a hinge, at 90° and at small folds."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.scenes import simulate
from xpbd_ros.effects.cross_bend import crossings
from xpbd_ros.sim.geometry.mesh_repair import surface_mesh

B = 3e-4


@pytest.mark.parametrize('angle, share', [(np.pi / 2, 1.0), (-np.pi / 2, 1.0), (0.1, 0.0045)])
def test_a_fold_stores_the_energy_of_hinges_at_90_degrees(angle, share):
    """A sheet of 5 x 9 folded along its middle row; only what crosses that row changes."""
    energies = {}
    for name in ('hinge', 'cross_bend'):
        simulation = simulate((9, 5), (2.0, 1.0), effects={name: {'stiffness': B}})
        x = simulation.state.x.T.copy()
        middle = np.array([0.0, 0.5, 0.0])
        beyond = x[:, 1] > 0.5
        x[beyond] = middle + Rotation.from_rotvec([angle, 0.0, 0.0]).apply(x[beyond] - middle)
        energies[name] = simulation.effects[name].constraints.energy(x.T)
    assert energies['cross_bend'] == pytest.approx(share * energies['hinge'], rel=0.02)


@pytest.mark.parametrize('rest, fold', [(0.0, 90.0), (0.0, -90.0), (30.0, 90.0), (-30.0, -90.0),
                                        (120.0, -90.0), (-120.0, 90.0)])
def test_a_curved_hinge_stores_it_at_90_degrees_from_rest(rest, fold):
    """Further from flat, or towards it beyond 90°: B |e|² (π/2)² / (A0 + A1) / 2."""
    def folded(degrees):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        return np.array([[0, 0, 0], [1, 0, 0], [0.2, 1.0, 0], [0.6, -0.7 * c, 0.7 * s]])
    (pair,), (length,), (k,) = crossings(surface_mesh(
        folded(rest), np.array([[0, 1, 2], [1, 0, 3]]), (1.0, 0.0, 0.0)))
    apart = np.linalg.norm(np.diff(folded(rest + fold)[pair], axis=0))
    assert 0.5 * k * (apart - length)**2 == pytest.approx(0.5 * (0.5 * np.pi)**2 / 0.85)


def test_a_flat_sheet_and_no_sheet_store_nothing():
    simulation = simulate((6, 5), effects={'cross_bend': {'stiffness': B}})
    assert simulation.effects['cross_bend'].constraints.energy(simulation.state.x) < 1e-25
    for grid in ((1, 1), (1, 5), (5, 1)):
        simulation = simulate(grid, effects={'cross_bend': {'stiffness': B}})
        assert len(simulation.effects['cross_bend'].constraints.particles) == 0
