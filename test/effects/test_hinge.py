"""Hinges: a plate's energy, curved rest shapes, and folds beyond half a turn."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.meshes import disc, obj_text
from support.scenes import run, run_stage, simulate
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.commands import SetState
from xpbd_ros.sim.measure import kinetic_energy
from xpbd_ros.sim.particles.state import places, Substep
from xpbd_ros.sim.stepping import stages

B = 3e-4


def from_mesh(folder, vertices, triangles):
    (folder / 'shell.obj').write_text(obj_text(vertices, triangles))
    return compile_scene(scene_from_mapping(
        {'gravity': [0, 0, 0], 'solver': {'method': 'line'}, 'cloths': {'c': {
            'mesh': {'file': 'shell.obj'}, 'density': 0.2,
            'effects': {'hinge': {'stiffness': B}}}}},
        where='mesh.yaml', name='mesh', folder=folder))


def project(simulation, h=0.01):
    state, data = simulation.state, simulation.effects['hinge'].data
    state.mobility[:] = state.inv_mass * h**2
    for stage in (stages.prepare, stages.project):
        run_stage(stage, data, state, Substep(h, 0.0, 1.0))


def on_a_cylinder(x, curvature, degrees):
    """Roll a flat sheet onto a cylinder; the direction that curves is at an angle to warp."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    along, across = c * x[0] + s * x[1], c * x[1] - s * x[0]
    u = np.sin(curvature * along) / curvature
    return np.stack([c * u - s * across, s * u + c * across,
                     2.0 * np.sin(0.5 * curvature * along)**2 / curvature])


@pytest.mark.parametrize('degrees', [0.0, 22.5, 45.0, 90.0, 135.0])
@pytest.mark.parametrize('rigidities', [{'stiffness': B}, {'warp': B, 'weft': 4.0 * B}])
def test_energy_on_a_cylinder_is_a_plates_in_every_direction(degrees, rigidities):
    """V12: (B1 κxx² + B2 κyy² + 4 D66 κxy²) / 2 per area, D66 = sqrt(B1 B2) / 2."""
    n, curvature = 11, 1e-3
    simulation = simulate((n, n), effects={'hinge': rigidities})
    energy = simulation.effects['hinge'].constraints.energy(
        on_a_cylinder(simulation.state.x, curvature, degrees))
    c2, s2, inner = np.cos(np.radians(degrees))**2, np.sin(np.radians(degrees))**2, (n - 2) / (
        n - 1)
    second = 4.0 if 'weft' in rigidities else 1.0
    expected = 0.5 * B * curvature**2 * (
        inner * (c2**2 + second * s2**2) + 2.0 * np.sqrt(second) * c2 * s2)
    assert energy == pytest.approx(expected, rel=1e-5)


def test_no_particle_of_a_grid_is_softer_than_its_neighbours():
    """Hinges of one triangulation would bend about every other particle only."""
    simulation = simulate((9, 9), effects={'hinge': {'stiffness': B}})
    energies = []
    for j, c in ((4, 4), (4, 3), (3, 4)):
        x = simulation.state.x.copy()
        x[2, simulation.cloths[0].block.slots[j, c]] += 1e-4
        energies.append(simulation.effects['hinge'].constraints.energy(x))
    np.testing.assert_allclose(energies, energies[0], rtol=1e-6)


def test_a_shell_keeps_its_curved_rest_shape(tmp_path):
    vertices, triangles = disc(4)
    curved = on_a_cylinder(vertices.T, 2.0, 30.0).T
    simulation = from_mesh(tmp_path, curved, triangles)
    hinges = simulation.effects['hinge'].constraints
    assert np.abs(hinges.rest_angle).max() > 0.2
    assert hinges.energy(simulation.state.x) < 1e-25
    np.testing.assert_allclose(run(simulation, 5).x, curved, atol=1e-12)
    flat = simulation.state.x.copy()
    flat[:, simulation.slot] = vertices.T
    assert hinges.energy(flat) == pytest.approx(
        0.5 * B * 4.0 * simulation.cloths[0].mesh.area.sum(), rel=0.15)


@pytest.fixture
def fold(tmp_path):
    """Return a function that folds two triangles by an angle, and the simulation."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0.3, 0.8, 0], [0.6, -0.7, 0]], float)
    simulation = from_mesh(tmp_path, vertices, [[0, 1, 2], [1, 0, 3]])

    def to(angle):
        folded = vertices.copy()
        folded[3] = Rotation.from_rotvec([angle, 0, 0]).apply(vertices[3])
        simulation.state.x[:, simulation.slot] = folded.T
    return simulation, to


def test_the_angle_goes_on_beyond_half_a_turn_without_a_kick(fold):
    """H7: where atan2 jumps, the push goes on as it was; two whole turns, there and back."""
    simulation, to = fold
    data, slot = simulation.effects['hinge'].data, simulation.slot
    sign, pushes = None, []
    angles = np.concatenate([np.linspace(0.0, 4.0 * np.pi, 400),
                             np.linspace(4.0 * np.pi, 0.0, 400)])
    for angle in angles:
        to(angle)
        before = places(simulation.state.x, slot)
        project(simulation)
        (seen,) = data.angle[simulation.effects['hinge'].constraints.index]
        sign = np.sign(seen) if sign is None and abs(seen) > 1e-9 else sign
        assert seen == pytest.approx((sign or 1.0) * angle, abs=1e-12)
        moved = places(simulation.state.x, slot) - before
        pushes.append(np.linalg.norm(moved[3]))
        simulation.state.x[:, slot] = before.T
        assert simulation.effects['hinge'].constraints.residual(
            simulation.state.x)[0] == pytest.approx(seen)
    steps = np.abs(np.diff(pushes))
    assert steps.max() < 2.0 * np.median(steps[steps > 0.0])
    project(simulation)
    simulation.effects['hinge'].reset(simulation.state)
    assert (data.angle == data.rest_angle).all()


def test_a_frame_that_is_done_again_forgets_how_far_it_turned(fold):
    simulation, to = fold
    built = simulation.effects['hinge']
    to(3.0)
    project(simulation)
    built.begin(None, None)
    to(4.0)
    project(simulation)
    built.again()
    assert np.abs(built.data.angle).max() == pytest.approx(3.0)


@pytest.mark.parametrize('place', [[0.5, 0, 0], [0, 0, 0], [1, 0, 0], [3, 0, 0], [0.5, 1e-14, 0]])
def test_a_triangle_without_height_is_left_alone(fold, place):
    """H7: the opposite particle lies on the line of the edge."""
    simulation, to = fold
    to(1.0)
    project(simulation)
    to(0.0)    # the edge as it was
    simulation.state.x[:, simulation.slot[3]] = place
    before = simulation.state.x.copy()
    project(simulation)
    np.testing.assert_array_equal(simulation.state.x, before)
    assert np.abs(simulation.effects['hinge'].data.angle).max() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize('height', [1e-10, 1e-6, 1e-3])
def test_a_sliver_triangle_moves_no_more_than_its_height(fold, height):
    simulation, to = fold
    to(2.0)
    slot = simulation.slot[3]
    simulation.state.x[1:, slot] *= height
    before = simulation.state.x.copy()
    project(simulation)
    assert 0.0 < np.abs(simulation.state.x - before).max() < 4.0 * height


def test_hinges_without_stiffness_act_as_absent():
    simulation = simulate((3, 3), effects={'hinge': {'stiffness': 1e-300}}, gravity=(0, 0, 0),
                          iterations=2)
    simulation.state.x[2, simulation.slot[4]] += 0.5
    start = simulation.frame().x
    np.testing.assert_allclose(run(simulation, 3).x, start, atol=1e-14)
    for grid in ((1, 1), (1, 5), (5, 1)):
        simulation = simulate(grid, effects={'hinge': {'stiffness': B}})
        assert len(simulation.effects['hinge'].constraints.particles) == 0


@pytest.mark.parametrize(('keys', 'why'), [
    ({}, 'either stiffness, or warp and weft'),
    ({'stiffness': 1.0, 'weft': 1.0}, 'either stiffness, or warp and weft'),
    ({'warp': 1.0}, r'warp and weft \(N m\), and only one of them is given')])
def test_both_and_neither_are_refused(keys, why):
    with pytest.raises(InputError, match=f'hinge: needs {why}'):
        simulate(effects={'hinge': keys})


@pytest.mark.parametrize('name', ['cross_bend', pytest.param('hinge', marks=pytest.mark.slow)])
def test_a_fold_opens_with_the_energy_that_it_stores(name):
    """Two stiff cells at 90° to one another, let go: flat, all of it is motion."""
    simulation = simulate((3, 2), (0.4, 0.2), gravity=(0, 0, 0), substeps=100, density=0.2,
                          method='gauss_seidel_symmetric', integrator='bdf2', effects={
                              name: {'stiffness': 0.01},
                              'stretch': {'warp': 4000.0, 'weft': 4000.0},
                              'shear': {'stiffness': 2000.0}})
    x = simulation.frame().x
    x[:, 2] = np.maximum(x[:, 0] - 0.2, 0.0)
    x[:, 0] = np.minimum(x[:, 0], 0.2)
    state, bends = simulation.state, simulation.effects[name].constraints
    state.x[:, simulation.slot] = x.T
    stored = bends.energy(state.x)
    assert stored > 1e-3
    moving, left = zip(*((kinetic_energy(state), bends.energy(state.x)) for _ in range(40)
                         if simulation.step()))
    assert max(moving) == pytest.approx(stored, rel=0.05)
    assert min(left) < 0.02 * stored


def test_a_fold_keeps_its_turns_where_another_cloth_is_set():
    grid = {'grid': {'size': [1.0, 0.5], 'resolution': [3, 2]}, 'density': 0.2,
            'effects': {'hinge': {'stiffness': B}}}
    simulation = compile_scene(scene_from_mapping(
        {'cloths': {'a': grid, 'b': {**grid, 'pose': {'position': [0.0, 2.0, 0.0]}}}},
        where='two.yaml', name='two'))
    hinges, data = simulation.effects['hinge'].constraints, simulation.effects['hinge'].data
    mine = np.isin(hinges.particles, simulation.cloths[0].slots).all(1)
    data.angle[hinges.index] = 4.0
    x = simulation.frame().x[simulation.cloths[1].particles]
    assert not simulation.apply([SetState('b', tuple(x.ravel().tolist()))])
    assert (data.angle[hinges.index] == np.where(mine, 4.0, 0.0)).all()


def test_a_fold_that_is_set_is_no_turn_of_the_one_before():
    """From 170° up to 170° down is not 20° further."""
    def folded(degrees):
        x = simulate((3, 2), effects={'hinge': {'stiffness': B}}, gravity=(0, 0, 0)).frame().x
        turn = np.radians(degrees)
        beyond = np.maximum(x[:, 0] - 0.5, 0.0)
        x[:, 2] = np.sin(turn) * beyond
        x[:, 0] += (np.cos(turn) - 1.0) * beyond
        return SetState('c', tuple(x.ravel().tolist()))

    found = []
    for commands in [folded(170.0), folded(-170.0)], [folded(-170.0)]:
        simulation = simulate((3, 2), effects={'hinge': {'stiffness': B}}, gravity=(0, 0, 0))
        found.append([simulation.step([command]) for command in commands][-1].x)
    assert np.array_equal(*found)
