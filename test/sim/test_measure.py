"""Momentum, energy and strain, from their definitions."""

import numpy as np
import pytest

from support.scenes import simulate
from xpbd_ros.sim import measure


@pytest.fixture
def simulation():
    """Return a cloth in any state."""
    simulation = simulate((4, 3), (0.3, 0.4), gravity=(0.1, 0.2, -9.0))
    rng = np.random.default_rng(2)
    simulation.state.x[:, simulation.slot] = rng.normal(size=(3, 12))
    simulation.state.v[:, simulation.slot] = rng.normal(size=(3, 12))
    return simulation


def test_the_sums_are_those_of_the_definitions(simulation):
    state, frame = simulation.state, simulation.frame()
    p, l, kinetic, potential = np.zeros(3), np.zeros(3), 0.0, 0.0
    for m, x, v in zip(state.mass[simulation.slot], frame.x, frame.v):
        p += m * v
        l += m * np.cross(x, v)
        kinetic += 0.5 * m * v @ v
        potential -= m * x @ [0.1, 0.2, -9.0]
    np.testing.assert_allclose(measure.momentum(state), p, rtol=1e-13)
    np.testing.assert_allclose(measure.angular_momentum(state), l, rtol=1e-13)
    assert measure.kinetic_energy(state) == pytest.approx(kinetic, rel=1e-13)
    assert measure.potential_energy(state) == pytest.approx(potential, rel=1e-13)


def test_the_elastic_energy_is_that_of_all_effects_together():
    simulation = simulate((2, 1), (1.0, 1.0), effects={'stretch': {'compliance': 0.01}})
    simulation.state.x[0, simulation.slot[1]] = 1.2
    assert measure.elastic_energy(simulation) == pytest.approx(0.5 * 0.2**2 / 0.01, rel=1e-12)
    simulation = simulate((3, 3), effects={'stretch': {'compliance': 0.01},
                                           'shear': {'stiffness': 3.0},
                                           'bend': {'stiffness': 0.1}})
    simulation.state.x[2, simulation.slot[4]] += 0.1
    each = [built.constraints.energy(simulation.state.x)
            for built in simulation.effects.values()]
    assert min(each) > 0.0
    assert measure.elastic_energy(simulation) == pytest.approx(sum(each), rel=1e-14)


def test_the_largest_strain_is_that_of_the_worst_grid_edge():
    simulation = simulate((4, 3), (0.3, 0.4))
    assert measure.largest_strain(simulation) < 1e-14
    # a neighbour along weft is 0.2 m away, along warp 0.1 m
    simulation.state.x[2, simulation.slot[5]] += 0.2
    assert measure.largest_strain(simulation) == pytest.approx(5**0.5 - 1.0, rel=1e-12)


@pytest.mark.parametrize('grid', [(1, 1), (1, 4), (4, 1)])
def test_a_cloth_without_a_direction_has_no_strain_there(grid):
    assert measure.largest_strain(simulate(grid)) < 1e-14
