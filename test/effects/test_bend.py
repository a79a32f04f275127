"""Bending: the energy on a cylinder is that of a plate, in every direction."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sim.small import run, simulate

B = 3e-4


def bending(grid, size=(1.0, 1.0)):
    """Return a sheet's hinges and its rest shape, by slot."""
    simulation = simulate(grid, size, effects={'bend': {'stiffness': B}})
    return simulation.effects['bend'].constraints, simulation.state.x.copy()


def on_a_cylinder(x, curvature, degrees):
    """Roll a flat sheet onto a cylinder; the direction that curves is at an angle to warp."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    along, across = c * x[0] + s * x[1], c * x[1] - s * x[0]
    u = np.sin(curvature * along) / curvature
    return np.stack([c * u - s * across, s * u + c * across,
                     2.0 * np.sin(0.5 * curvature * along)**2 / curvature])


@pytest.mark.parametrize('degrees', [0.0, 22.5, 45.0, 67.5, 90.0, 135.0])
@pytest.mark.parametrize('n', [6, 21])
def test_the_energy_on_a_cylinder_is_that_of_a_plate_in_every_direction(degrees, n):
    """
    ½ B κ² per area, ν = 0: 1.0 in NUMERICS 2.5, its diagonals having half the weight.

    With κxx = κ cos², κyy = κ sin², κxy = κ sin cos it is ½ B (κxx² + κyy² + 2 κxy²); the hinges
    across warp and weft edges lie on n - 2 inner lines of n - 1 cells.
    """
    hinges, x = bending((n, n))
    curvature = 1e-3
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    inner = (n - 2) / (n - 1)
    expected = 0.5 * B * curvature**2 * ((c**4 + s**4) * inner + 2.0 * c**2 * s**2)
    assert hinges.energy(on_a_cylinder(x, curvature, degrees)) == pytest.approx(
        expected, rel=1e-5)
    assert c**4 + s**4 + 2.0 * c**2 * s**2 == pytest.approx(1.0)


@pytest.mark.parametrize('degrees', [0.0, 90.0])
def test_oblong_cells_bend_about_their_sides_as_square_ones_do(degrees):
    hinges, x = bending((5, 11), (1.0, 0.6))
    inner = 3 / 4 if degrees == 0.0 else 9 / 10
    assert hinges.energy(on_a_cylinder(x, 1e-3, degrees)) == pytest.approx(
        0.5 * B * 1e-6 * 0.6 * inner, rel=1e-5)


@pytest.mark.parametrize('angle', [0.1, 1.0, 3.0, np.pi, 3.5, 6.0])
def test_a_fold_stores_energy_without_a_wrap(angle):
    """Half of B (2 |e| sin(θ/2))² / (A0 + A1), the diagonal's weight; H7."""
    hinges, x = bending((2, 2))
    (i, j, k, opposite), = hinges.particles
    x = x.T
    axis = (x[j] - x[i]) / np.linalg.norm(x[j] - x[i])
    y = x.copy()
    y[opposite] = x[i] + Rotation.from_rotvec(angle * axis).apply(x[opposite] - x[i])
    expected = 0.5 * 0.5 * B * (2.0 * 2.0**0.5 * np.sin(0.5 * angle))**2 / 1.0
    assert hinges.energy(y.T) == pytest.approx(expected, rel=1e-12, abs=1e-18)


def test_a_flat_sheet_stores_nothing_however_it_is_stretched_turned_or_moved():
    hinges, x = bending((5, 4), (1.0, 0.7))
    x = x.T
    deformed = (Rotation.random(random_state=1).apply(x @ np.diag([1.3, 0.6, 1.0]) + [
        0.3, 0.1, 0.0] * x[:, [1]]) + [5.0, -2.0, 1.0]).T
    assert hinges.energy(deformed) < 1e-25
    assert np.abs(hinges.residual(deformed)).max() < 1e-13


def test_hinges_without_stiffness_are_as_absent():
    """H2; 1 / 1e-320 is infinite, and infinity times no force is not a number."""
    simulation = simulate((3, 3), effects={'bend': {'stiffness': 1e-320}}, gravity=(0, 0, 0),
                          iterations=2)
    simulation.state.x[2, simulation.slot[4]] += 0.5
    start = simulation.frame().x
    np.testing.assert_allclose(run(simulation, 3).x, start, atol=1e-14)


def test_strips_and_points_have_no_hinges():
    for grid in ((1, 1), (1, 5), (5, 1)):
        assert len(bending(grid)[0].particles) == 0
