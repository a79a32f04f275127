"""Membrane: exact on affine fields, indifferent to rotation, and as narrow as Poisson says."""

import numpy as np
import pytest
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from support.meshes import disc, obj_text
from support.scenes import EXAMPLES, run, simulate
from support.tiers import slow
from xpbd_ros.effects.membrane import inverse_rest_edges, Parameters
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.scene.stability import stability_limit
from xpbd_ros.sim.geometry.mesh_repair import surface_mesh
from xpbd_ros.sim.particles.state import places

WARP, WEFT, SHEAR, POISSON = 90.0, 40.0, 15.0, 0.35
CLOTH = {'warp': WARP, 'weft': WEFT, 'shear': SHEAR, 'poisson': POISSON}


def irregular():
    """Return vertices and triangles of a unit square cut at random."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    inside = np.random.default_rng(2).uniform(0.02, 0.98, (60, 2))
    flat = np.concatenate([corners, inside])
    triangles = Delaunay(flat).simplices
    a, b, c = (flat[triangles[:, k]] for k in range(3))
    u, v = b - a, c - a
    turned = u[:, 0] * v[:, 1] < u[:, 1] * v[:, 0]
    triangles[turned] = triangles[turned][:, ::-1]
    return np.pad(flat, ((0, 0), (0, 1))), triangles


def from_mesh(folder, vertices, triangles, effects, **keys):
    (folder / 'sheet.obj').write_text(obj_text(vertices, triangles))
    return compile_scene(scene_from_mapping(
        {'gravity': [0, 0, 0], 'cloths': {'c': {
            'mesh': {'file': 'sheet.obj', **keys}, 'density': 0.2, 'effects': effects}}},
        where='mesh.yaml', name='mesh', folder=folder))


def sheet(kind, folder, effects=None):
    """Return a sheet of 1 m², by name of its mesh."""
    effects = effects or {'membrane': CLOTH}
    if kind == 'irregular':
        return from_mesh(folder, *irregular(), effects)
    return simulate({'grid': (7, 6), 'oblong': (4, 9)}[kind], effects=effects, gravity=(0, 0, 0))


def plane_stress(warp=WARP, weft=WEFT, shear=SHEAR, poisson=POISSON):
    """Return S of the textbook (Jones 1975), from ν12 / Y1 = ν21 / Y2."""
    other = poisson * weft / warp
    s = 1.0 - poisson * other
    return np.array([[warp / s, other * warp / s, 0], [other * warp / s, weft / s, 0],
                     [0, 0, shear]])


@pytest.mark.parametrize('kind', ['grid', 'oblong', 'irregular'])
def test_an_affine_field_stores_what_the_continuum_does(kind, tmp_path):
    """V13: A εᵀ S ε / 2, to rounding, however the sheet is cut, turned and moved."""
    simulation = sheet(kind, tmp_path)
    triangles, slot = simulation.effects['membrane'].constraints, simulation.slot
    flat = places(simulation.state.x, slot)
    random = np.random.default_rng(1)
    for _ in range(5):
        f = np.eye(3) + random.normal(0.0, 0.2, (3, 3))
        x = simulation.state.x.copy()
        x[:, slot] = Rotation.random(random_state=random.integers(99)).apply(
            flat @ f.T + [3.0, -1.0, 2.0]).T
        green = 0.5 * ((f.T @ f)[:2, :2] - np.eye(2))
        strain = np.array([green[0, 0], green[1, 1], 2.0 * green[0, 1]])
        assert triangles.energy(x) == pytest.approx(
            0.5 * strain @ plane_stress() @ strain, rel=1e-12)


@pytest.mark.parametrize('kind', ['grid', slow('irregular')])
def test_a_rigid_motion_strains_nothing(kind, tmp_path):
    simulation = sheet(kind, tmp_path)
    slot, x = simulation.slot, simulation.state.x.copy()
    turned = Rotation.from_rotvec([1.0, -2.0, 0.5]).apply(places(x, slot)) + [0.5, 0.2, -0.1]
    x[:, slot] = turned.T
    triangles = simulation.effects['membrane'].constraints
    assert np.abs(triangles.residual(x)).max() < 1e-13
    simulation.state.x[:] = x
    np.testing.assert_allclose(run(simulation, 3).x, turned, atol=1e-12)


def test_one_modulus_is_a_sheet_alike_in_all_directions(tmp_path):
    """The energy does not care which way the strain points."""
    simulation = sheet('irregular', tmp_path, {'membrane': {'young': 50.0, 'poisson': -0.3}})
    triangles, slot = simulation.effects['membrane'].constraints, simulation.slot
    flat, energies = places(simulation.state.x, slot), []
    for degrees in (0.0, 33.0, 90.0):
        turn = Rotation.from_euler('z', degrees, degrees=True).as_matrix()
        x = simulation.state.x.copy()
        x[:, slot] = (flat @ (turn @ np.diag([1.2, 0.9, 1.0]) @ turn.T).T).T
        energies.append(triangles.energy(x))
    np.testing.assert_allclose(energies, energies[0], rtol=1e-12)
    e1, e2 = 0.5 * (1.2**2 - 1.0), 0.5 * (0.9**2 - 1.0)
    assert energies[0] == pytest.approx(
        0.5 * 50.0 / (1.0 - 0.09) * (e1**2 + e2**2 - 0.6 * e1 * e2), rel=1e-12)


def test_a_sheet_pulled_along_warp_narrows_by_poissons_ratio():
    """
    Uniaxial: E22 = -ν E11 in the middle; a side 2 m away is held by (1 + s) Y E11 per metre.

    Held ends do not get narrower, which is why the strip is long, and gives way a little less.
    """
    stretch = 0.1
    simulation = simulate(
        (25, 7), (4.0, 1.0), effects={'membrane': CLOTH}, gravity=(0, 0, 0), substeps=20,
        density=0.5, scene_effects={'damping': {'rate': 4.0}}, pins={
            'a': {'cloth': 'c', 'at': 'edge_x0'},
            'b': {'cloth': 'c', 'at': 'edge_x1', 'motion': [
                [0.0, 4.0, 0.5, 0.0], [1.0, 4.0 * (1.0 + stretch), 0.5, 0.0]]}})
    frame = run(simulation, 600)
    assert np.abs(frame.v).max() < 1e-6
    x = frame.x.reshape(7, 25, 3)
    along = 0.5 * ((np.linalg.norm(x[3, 13] - x[3, 11]) * 3.0)**2 - 1.0)
    across = 0.5 * (np.linalg.norm(x[4, 12] - x[2, 12])**2 * 9.0 - 1.0)
    assert across / along == pytest.approx(-POISSON, rel=0.01)
    assert 0.5 * ((1.0 + stretch)**2 - 1.0) == pytest.approx(along, rel=0.02)
    force = frame.pins['b'].force
    assert abs(force[0]) == pytest.approx((1.0 + stretch) * WARP * along, rel=0.02)
    np.testing.assert_allclose(frame.pins['a'].force + force, 0.0, atol=1e-3)


@pytest.mark.parametrize('stiffness', [1.0, 1e6, 1e12])
@pytest.mark.parametrize('squeezed', [0.3, 1e-2, 1e-6, 0.0])
@pytest.mark.parametrize('precision', ['float64', slow('float32')])
def test_a_triangle_squeezed_flat_does_not_fly_apart(precision, squeezed, stiffness):
    """A full step of Green's strain would make it 1 / (2 σ) long."""
    simulation = simulate((4, 3), effects={'membrane': {
        name: stiffness * value if name != 'poisson' else value
        for name, value in EXAMPLES['membrane'].items()}}, gravity=(0, 0, 0), rate=1000.0,
        precision=precision)
    simulation.state.x[0] *= squeezed
    for _ in range(3):
        x = simulation.step().x
        assert np.isfinite(x).all()
        assert np.abs(x).max() < 2.0


def test_a_sheet_of_no_stiffness_is_as_absent():
    simulation = simulate((3, 3), gravity=(0, 0, 0), iterations=2, effects={
        'membrane': {'young': 1e-300, 'poisson': 0.3}})
    simulation.state.x[2, simulation.slot[4]] += 0.5
    start = simulation.frame().x
    np.testing.assert_allclose(run(simulation, 3).x, start, atol=1e-14)


def test_strips_and_points_have_no_triangles():
    for grid in ((1, 1), (1, 5), (5, 1)):
        simulation = simulate(grid, effects={'membrane': CLOTH}, gravity=(0, 0, 0))
        assert len(simulation.effects['membrane'].constraints.particles) == 0
        run(simulation, 2)


def test_the_warp_of_a_mesh_is_laid_into_each_triangle():
    vertices, triangles = disc(2)
    tilt = Rotation.from_rotvec([0.0, 0.6, 0.0])
    mesh = surface_mesh(tilt.apply(vertices), triangles, (0.0, 1.0, 0.0))
    inverse, area = inverse_rest_edges(mesh)
    corners = mesh.positions[mesh.triangles]
    edges = corners[:, 1:] - corners[:, :1]
    frame = np.einsum('tek,tea->tka', edges, inverse)    # of the rest shape itself
    np.testing.assert_allclose(frame[:, :, 0], np.tile([0.0, 1.0, 0.0], (len(area), 1)),
                               atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(frame[:, :, 1], axis=1), 1.0, rtol=1e-13)
    upright, _ = inverse_rest_edges(surface_mesh(vertices, triangles, (0.0, 0.0, 1.0)))
    assert np.isfinite(upright).all()


@pytest.mark.parametrize('keys, text', [
    ({'warp': 9.0, 'weft': 100.0, 'shear': 1.0, 'poisson': 0.31},
     'membrane: poisson: must be between -0.3 and 0.3 = sqrt(warp / weft) (got 0.31): beyond, the '
     'sheet would gain energy by being stretched'),
    ({'young': 9.0, 'poisson': 1.0}, 'membrane: poisson: must be between -1 and 1 (got 1)'),
    ({'young': 9.0, 'poisson': -1.0}, 'membrane: poisson: must be between -1 and 1 (got -1)'),
    ({'warp': 9.0, 'weft': 100.0}, 'membrane: needs either warp, weft and shear (N/m), or young'),
    ({'young': 9.0, 'shear': 100.0}, 'membrane: needs either warp, weft and shear (N/m), or'),
    ({}, 'membrane: needs either'),
])
def test_moduli_without_sense_are_refused_with_the_reason(keys, text):
    with pytest.raises(InputError) as error:
        simulate(effects={'membrane': keys})
    assert str(error.value).startswith('small.yaml: cloths.c.effects.') and text in str(
        error.value)


def test_a_knit_may_get_narrower_than_it_gets_longer():
    assert Parameters(warp=400.0, weft=40.0, shear=20.0, poisson=2.0).moduli == (400, 40, 20)


def test_an_explicit_step_knows_its_limit():
    """No less than the highest frequency of the sheet over 2, and not thrice as much."""
    simulation = simulate((5, 4), effects={'membrane': CLOTH}, gravity=(0, 0, 0))
    triangles, state = simulation.effects['membrane'].constraints, simulation.state
    jacobian = triangles.jacobian(state.x)
    stiffness = np.zeros((state.x.shape[1], 3, state.x.shape[1], 3))
    for t, particles in enumerate(triangles.particles):
        block = np.einsum('cik,cd,djl->ikjl', jacobian[t], np.linalg.inv(triangles.block[t]),
                          jacobian[t])
        for a, i in enumerate(particles):
            for b, j in enumerate(particles):
                stiffness[i, :, j] += block[a, :, b]
    stiffness = stiffness[simulation.slot][:, :, simulation.slot]
    mass = np.sqrt(np.repeat(state.mass[simulation.slot], 3))
    matrix = stiffness.reshape(len(mass), -1) / np.outer(mass, mass)
    highest = 0.5 * np.sqrt(np.linalg.eigvalsh(matrix)[-1])
    bound = stability_limit(simulation.effects, state)
    assert highest <= bound < 1.6 * highest
