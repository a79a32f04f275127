"""Triangles that keep their area: what they resist, and what they let go."""

import numpy as np
import pytest

from support.meshes import disc, file_of
from support.scenes import run, simulate
from xpbd_ros.sim.measure import elastic_energy

K = 50.0


def flat(effects, **options):
    """Return a disc without weight, of radius 0.5 m."""
    return simulate(mesh=file_of(*disc(3)), gravity=(0, 0, 0), density=0.2, effects=effects,
                    **{'substeps': 8, **options})


def area(simulation, x):
    """Return the area of the disc as it lies [m²]."""
    a, b, c = (x[simulation.cloths[0].mesh.triangles[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def test_the_energy_goes_with_the_square_of_the_change_of_area():
    simulation = flat({'area': {'stiffness': K}})
    x = simulation.frame().x
    before = area(simulation, x)
    for f in (np.diag([1.2, 1.1, 1.0]), np.diag([0.5, 0.5, 1.0]), np.array(
            [[1.3, 0.2, 0.0], [-0.1, 0.8, 0.0], [0.4, 0.3, 1.0]])):
        simulation.state.x[:, simulation.slot] = (x @ f.T).T
        change = area(simulation, x @ f.T) / before - 1.0
        assert elastic_energy(simulation) == pytest.approx(0.5 * K * before * change**2,
                                                           rel=1e-12)


def test_a_sheet_shears_and_stretches_freely_at_its_area():
    """Only the area counts: det = 1 costs nothing."""
    simulation = flat({'area': {'stiffness': K}})
    x = simulation.frame().x
    moved = x @ np.array([[2.0, 0.3, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 1.0]]).T
    simulation.state.x[:, simulation.slot] = moved.T
    np.testing.assert_allclose(run(simulation, 5).x, moved, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('stiffness', [K, 1e7])
def test_a_squeezed_disc_comes_back_to_its_area(stiffness):
    simulation = flat({'area': {'stiffness': stiffness}, 'stretch': {'warp': 0.1, 'weft': 0.1}},
                      scene_effects={'damping': {'rate': 3.0}}, iterations=2)
    x = simulation.frame().x
    simulation.state.x[:, simulation.slot] = (x * [0.6, 1.0, 1.0]).T
    frame = run(simulation, 180)
    assert area(simulation, frame.x) == pytest.approx(area(simulation, x), rel=0.01)


def test_a_squeezed_disc_of_nothing_else_gets_its_area_back():
    """Each triangle its own; what it is like is left to chance."""
    simulation = flat({'area': {'stiffness': K}}, scene_effects={'damping': {'rate': 10.0}})
    x = simulation.frame().x
    simulation.state.x[:, simulation.slot] = (x * [0.8, 1.0, 1.0]).T
    frame = run(simulation, 120)
    assert area(simulation, frame.x) == pytest.approx(area(simulation, x), rel=1e-3)


def test_triangles_in_line_or_at_a_point_are_left_finite():
    simulation = flat({'area': {'stiffness': K}, 'bend': {'stiffness': 1e-4}})
    simulation.state.x[1:, simulation.slot] = 0.0
    assert np.isfinite(run(simulation, 10).x).all()
    simulation.state.x[:, simulation.slot] = 0.0
    assert np.isfinite(run(simulation, 10).x).all()
