"""Momentum, energy and strain, from their definitions."""

import numpy as np
import pytest

from support.meshes import ball, file_of
from support.scenes import hang, run_until_still, simulate
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
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


def moved(simulation, seed: int = 4) -> np.ndarray:
    """Return positions of its first cloth, each off by some centimetres, shape (particles, 3)."""
    x = simulation.frame().x[simulation.cloths[0].particles]
    return x + np.random.default_rng(seed).normal(0.0, 0.03, x.shape)


@pytest.mark.parametrize('grid', [(4, 3), (1, 4), (4, 1), (1, 1)])
def test_a_particle_of_a_grid_has_the_largest_strain_of_its_edges(grid):
    simulation = simulate(grid, (0.3, 0.4))
    cloth, x = simulation.cloths[0], moved(simulation)
    columns, rows = grid
    expected = np.zeros((rows, columns))
    for row in range(rows):
        for column in range(columns):
            for r, c, rest in [(row, column + d, cloth.mesh.spacing[0]) for d in (-1, 1)] + [
                    (row + d, column, cloth.mesh.spacing[1]) for d in (-1, 1)]:
                if 0 <= r < rows and 0 <= c < columns:
                    apart = np.linalg.norm(x[row * columns + column] - x[r * columns + c])
                    expected[row, column] = max(expected[row, column], abs(apart / rest - 1.0))
    assert measure.strains(cloth, x) == pytest.approx(expected.ravel(), abs=1e-14)


def test_a_particle_of_a_mesh_has_the_largest_strain_of_its_edges():
    simulation = simulate(mesh=True)
    cloth, x = simulation.cloths[0], moved(simulation)
    expected = np.zeros(len(x))
    for a, b in cloth.mesh.edges.tolist():
        rest = np.linalg.norm(cloth.mesh.positions[a] - cloth.mesh.positions[b])
        strain = abs(np.linalg.norm(x[a] - x[b]) / rest - 1.0)
        expected[a], expected[b] = max(expected[a], strain), max(expected[b], strain)
    assert measure.strains(cloth, x) == pytest.approx(expected, rel=1e-12)
    simulation.state.x[:, simulation.slot] = x.T
    assert measure.strains(cloth, x).max() == measure.largest_strain(simulation)


def test_normals_of_a_ball_point_outward():
    vertices, triangles = ball(2)
    simulation = simulate(mesh=file_of(vertices, triangles))
    found = measure.normals(simulation.cloths[0], vertices)
    outward = vertices / np.linalg.norm(vertices, axis=1)[:, None]
    assert (found * outward).sum(1) == pytest.approx(1.0, abs=1e-3)
    flat = simulate((3, 2))
    assert (measure.normals(flat.cloths[0], flat.frame().x) == [0.0, 0.0, 1.0]).all()
    assert (measure.normals(flat.cloths[0], flat.frame().x * 0.0) == 0.0).all(), 'no area'
    row = simulate((3, 1))
    assert (measure.normals(row.cloths[0], row.frame().x) == 0.0).all(), 'no triangles'


def test_normals_are_sums_by_area(simulation):
    """The mean of the surrounding triangles' normals is weighted by area."""
    x, mesh = simulation.frame().x, simulation.cloths[0].mesh
    expected = np.zeros_like(x)
    for triangle in mesh.triangles:
        a, b, c = x[triangle]
        expected[triangle] += 0.5 * np.cross(b - a, c - a)
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    assert measure.normals(simulation.cloths[0], x) == pytest.approx(expected, abs=1e-12)


def test_the_tension_of_a_hanging_strip_is_the_weight_below():
    simulation = hang(4, effects={'stretch': {'compliance': 1e-4}})
    run_until_still(simulation)
    assert measure.has_tensions(simulation)
    weight = 9.80665 * simulation.state.mass[simulation.slot]
    below = np.cumsum(weight[::-1])[::-1][1:]    # at each edge
    found = measure.tensions(simulation)
    assert found[1:] == pytest.approx(below, rel=1e-9), 'the edge above pulls most'
    assert found[0] == found[1]
    assert not measure.has_tensions(simulate((2, 1)))


def test_particles_that_touch_are_those_on_the_floor():
    """A sheet that stands on its lower edge touches with that edge alone."""
    simulation = compile_scene(scene_from_mapping({
        'cloths': {'sheet': {'grid': {'size': [0.3, 0.2], 'resolution': [4, 3]}, 'density': 0.2,
                             'pose': {'position': [0.0, 0.0, 0.002],
                                      'orientation': [0.5**0.5, 0.0, 0.0, 0.5**0.5]},
                             'effects': {'stretch': {'warp': 300.0, 'weft': 300.0}}}},
        'colliders': {'floor': {'plane': {}}}, 'effects': {
            'pin': {}, 'damping': {'rate': 0.0}, 'contact': {'thickness': 0.002}, 'friction': {}},
        'solver': {'method': 'gauss_seidel', 'integrator': 'backward_euler', 'substeps': 8},
    }, where='here', name='here'))
    simulation.step()
    assert measure.touching(simulation).tolist() == 4 * [True] + 8 * [False]
    assert not measure.touching(simulate((2, 1))).any()


def test_the_contact_forces_of_a_sheet_on_a_slope_are_its_weight():
    """With the friction that holds it."""
    gravity = np.array([2.0, -1.0, -9.5])
    simulation = compile_scene(scene_from_mapping({
        'gravity': gravity.tolist(),
        'cloths': {'sheet': {'grid': {'size': [0.3, 0.2], 'resolution': [4, 3]}, 'density': 0.2,
                             'pose': {'position': [0.0, 0.0, 0.002]},
                             'effects': {'stretch': {'warp': 300.0, 'weft': 300.0}}}},
        'colliders': {'floor': {'plane': {}}}, 'effects': {
            'pin': {}, 'damping': {'rate': 0.0}, 'contact': {'thickness': 0.002}, 'friction': {}},
        'solver': {'method': 'gauss_seidel', 'integrator': 'backward_euler', 'substeps': 8},
    }, where='here', name='here'))
    assert not measure.contact_forces(simulation).any()
    for _ in range(10):
        frame = simulation.step()
    mass = simulation.state.mass[simulation.slot]
    assert measure.contact_forces(simulation) == pytest.approx(
        np.linalg.norm(gravity) * mass, rel=1e-3)
    assert frame.colliders['floor'].force == pytest.approx(mass.sum() * gravity, rel=1e-3)
    assert not measure.contact_forces(simulate((2, 1))).any()
