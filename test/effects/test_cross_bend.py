"""Cross bend: what it stores beside a hinge, at 90° and at small folds."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.scenes import simulate

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


def test_a_flat_sheet_and_no_sheet_store_nothing():
    simulation = simulate((6, 5), effects={'cross_bend': {'stiffness': B}})
    assert simulation.effects['cross_bend'].constraints.energy(simulation.state.x) < 1e-25
    for grid in ((1, 1), (1, 5), (5, 1)):
        simulation = simulate(grid, effects={'cross_bend': {'stiffness': B}})
        assert len(simulation.effects['cross_bend'].constraints.particles) == 0
