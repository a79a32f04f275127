"""Stretch and shear: the moduli of the sheet, whatever its cells."""

from itertools import product

import numpy as np
import pytest

from support.meshes import box, file_of
from support.scenes import GRAVITY, hang, run, run_stage, run_until_still, simulate
from support.tiers import quick_only, slow
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.constraints.line_solver import TINY
from xpbd_ros.sim.geometry.mesh import edge_areas, edges
from xpbd_ros.sim.measure import largest_strain
from xpbd_ros.sim.particles.state import Substep
from xpbd_ros.sim.stepping import stages

WARP, WEFT, G = 70.0, 40.0, 15.0
CELLS = pytest.mark.parametrize('grid, size', [((5, 5), (0.8, 0.8)), ((4, 7), (0.9, 0.6)),
                                               ((2, 2), (0.3, 0.5)), ((9, 3), (0.4, 0.9))])


def energy(grid, size, strain, *, stretch=True, shear=True):
    """Return the energy per area over ½, of an affine strain (exx, eyy, γ), to second order."""
    simulation = simulate(grid, size, effects={'stretch': {'warp': WARP, 'weft': WEFT},
                                               'shear': {'stiffness': G}})
    (exx, eyy, gamma), x = strain, simulation.state.x
    step, total = 1e-5, 0.0
    for sign in (step, -step):    # what is odd in the strain cancels
        deformed = x + sign * np.array([[exx, 0.5 * gamma, 0.0], [0.5 * gamma, eyy, 0.0],
                                        [0.0, 0.0, 0.0]]) @ x
        if stretch:
            total += simulation.effects['stretch'].constraints.energy(deformed)
        if shear:
            total += simulation.effects['shear'].constraints.energy(deformed)
    return total / step**2 / (size[0] * size[1])


@CELLS
def test_stretch_alone_has_the_moduli_asked_for_and_no_more(grid, size):
    """On oblong cells too, because the rim has half: C11 = warp, C22 = weft, C12 = C66 = 0."""
    for strain, expected in (((1, 0, 0), WARP), ((0, 1, 0), WEFT), ((1, 1, 0), WARP + WEFT),
                             ((1, -1, 0), WARP + WEFT)):
        assert energy(grid, size, strain, shear=False) == pytest.approx(expected, rel=1e-6)
    assert energy(grid, size, (0, 0, 1), shear=False) < 1e-6


def test_a_sheet_of_square_cells_with_shear_has_lattice_moduli():
    """doc/numerics.md 5.2: C11 = warp + shear, C22 = weft + shear, C12 = C66 = shear."""
    grid, size = (5, 4), (0.8, 0.6)
    c11, c22 = (energy(grid, size, strain) for strain in ((1, 0, 0), (0, 1, 0)))
    assert c11 == pytest.approx(WARP + G, rel=1e-6)
    assert c22 == pytest.approx(WEFT + G, rel=1e-6)
    assert energy(grid, size, (1, 1, 0)) == pytest.approx(c11 + c22 + 2.0 * G, rel=1e-6)
    assert energy(grid, size, (0, 0, 1)) == pytest.approx(G, rel=1e-6)


@CELLS
def test_shear_has_its_modulus_on_oblong_cells_too(grid, size):
    """C66 = shear; C11 = C22 = C12 = 0, but on square cells, where they are shear too."""
    added = 1.0 if size[0] / (grid[0] - 1) == pytest.approx(size[1] / (grid[1] - 1)) else 0.0
    for strain, expected in (((0, 0, 1), 1.0), ((1, 0, 0), added), ((0, 1, 0), added),
                             ((1, 1, 0), 4.0 * added), ((1, -1, 0), 0.0)):
        assert energy(grid, size, strain, stretch=False) == pytest.approx(
            expected * G, rel=1e-6, abs=1e-6)


def test_the_rim_has_half_the_stiffness():
    simulation = simulate((4, 3), (0.3, 0.2), effects={'stretch': {'warp': WARP, 'weft': WEFT}})
    edges = simulation.effects['stretch'].constraints
    x = simulation.state.x.T[edges.particles]
    across = np.where(x[:, 0, 1] == x[:, 1, 1], 1, 0)
    middle = x.mean(1)[np.arange(len(x)), across]
    rim = np.isclose(middle, 0.0) | np.isclose(middle, np.array([0.3, 0.2])[across])
    stiffness = 1.0 / edges.compliance
    for side, modulus in ((1, WARP), (0, WEFT)):
        np.testing.assert_allclose(stiffness[(across == side) & ~rim], modulus, rtol=1e-12)
        np.testing.assert_allclose(stiffness[(across == side) & rim], 0.5 * modulus, rtol=1e-12)
    assert len(x) == 3 * 3 + 4 * 2


def test_a_compliance_is_that_of_every_edge():
    simulation = simulate((4, 3), effects={'stretch': {'compliance': 0.02}}, scale=0.5)
    np.testing.assert_array_equal(simulation.effects['stretch'].constraints.compliance, 0.01)


@pytest.mark.parametrize('stretch, text', [
    ({}, 'needs either warp and weft (N/m) or compliance (m/N), and has none'),
    ({'warp': 1, 'weft': 1, 'compliance': 0},
     'needs either warp and weft (N/m) or compliance (m/N), not both'),
    ({'weft': 1, 'compliance': 0},
     'needs either warp and weft (N/m) or compliance (m/N), not both'),
    ({'warp': 1}, 'needs warp and weft (N/m), and only one of them is given')])
def test_both_forms_and_neither_are_refused(stretch, text):
    with pytest.raises(InputError) as error:
        simulate(effects={'stretch': stretch})
    assert str(error.value) == f'small.yaml: cloths.c.effects.stretch: {text}'


@pytest.mark.parametrize('method, integrator', [
    ('gauss_seidel', 'backward_euler'), slow('gauss_seidel_symmetric', 'bdf2'),
    slow('line', 'bdf2')])
def test_each_cloth_of_a_scene_moves_as_it_would_alone(method, integrator):
    """Whatever their stiffness and resolution, and though one of them does not stretch."""
    cloths = {
        'a': {'grid': {'size': [0.5, 0.4], 'resolution': [4, 3]}, 'density': 0.2,
              'effects': {'stretch': {'warp': 30, 'weft': 20}, 'shear': {'stiffness': 3},
                          'bend': {'stiffness': 1e-3}}},
        'b': {'grid': {'size': [0.3, 0.3], 'resolution': [2, 5]}, 'density': 0.1,
              'effects': {'bend': {'stiffness': 1e-4}, 'shear': {'stiffness': 1}}},
        'd': {'grid': {'size': [0.3, 0.3], 'resolution': [5, 2]}, 'density': 0.3,
              'effects': {'stretch': {'compliance': 0.0}, 'shear': {'stiffness': 9},
                          'bend': {'stiffness': 1e-2}}}}

    def build(chosen):
        return compile_scene(scene_from_mapping({
            'cloths': {name: cloths[name] for name in chosen},
            'solver': {'substeps': 5, 'method': method, 'integrator': integrator},
            'pins': {name: {'cloth': name, 'at': 'corner_01'} for name in chosen},
            'effects': {'damping': {'rate': 0.2}}}, where='x', name='x'))

    together = build('abd')
    frame = run(together, 40)
    for cloth in together.cloths:
        alone = build(cloth.name)
        np.testing.assert_array_equal(frame.x[cloth.particles], run(alone, 40).x)
        np.testing.assert_array_equal(frame.pins[cloth.name].force,
                                      alone.frame().pins[cloth.name].force)


def solve_densely(lines, number, edges, alpha, state, force):
    """
    Solve lines one after another: (J M Jᵀ + α) Δf = -(C + α f), x += M Jᵀ Δf, f += Δf.

    On the left α is at least TINY times the mobilities, as the line solve documents.
    ``lines`` are rows of slots, ``number`` says which edge joins two of them.
    """
    for line in lines:
        chosen = [number[ends] for ends in zip(line[:-1].tolist(), line[1:].tolist())]
        count, m = len(chosen), np.repeat(state.mobility[line], 3)
        if not count:
            continue
        d = np.diff(state.x.T[line], axis=0)
        length = np.linalg.norm(d, axis=1)
        jacobian = np.zeros((count, len(line), 3))
        jacobian[np.arange(count), np.arange(count)] = -d / length[:, None]
        jacobian[np.arange(count), np.arange(count) + 1] = d / length[:, None]
        jacobian = jacobian.reshape(count, -1)
        right = -(length - edges.rest_length[chosen] + alpha[chosen] * force[chosen])
        ends = state.mobility[line[:-1]] + state.mobility[line[1:]]
        system = jacobian * m @ jacobian.T + np.diag(
            np.maximum(alpha[chosen], TINY * ends))
        idle = np.diag(system) == 0.0    # rigid, between two pins
        system[idle, idle], right[idle] = 1.0, 0.0
        change = np.linalg.solve(system, right)
        force[chosen] += change
        state.x[:, line] += (m * (change @ jacobian)).reshape(-1, 3).T


@pytest.mark.parametrize('stretch', [
    {'warp': WARP, 'weft': WEFT}, {'warp': 1e3 * WARP, 'weft': 1e3 * WEFT}, {'compliance': 0.0}])
@pytest.mark.parametrize('pinned', [[], [0], [0, 7, 8, 19]])
@pytest.mark.parametrize('grid', [(5, 7), (9, 4), (17, 3), (3, 17), (8, 8), (1, 20), (20, 1)])
def test_a_line_is_solved_as_a_dense_matrix_is(grid, pinned, stretch):
    """Warp, then weft, twice over, whether or not lines fill whole vectors."""
    simulation = simulate(grid, (0.8, 0.6), effects={'stretch': stretch}, density=0.2,
                          method='line')
    state, data = simulation.state, simulation.effects['stretch'].data
    edges, slots = simulation.effects['stretch'].constraints, simulation.cloths[0].block.slots
    number = {tuple(ends): k for k, ends in enumerate(edges.particles.tolist())}
    state.x[:, simulation.slot] += np.random.default_rng(3).normal(
        0.0, 0.1 * max(simulation.cloths[0].mesh.spacing), (3, len(simulation.slot)))
    state.inv_mass[simulation.slot[pinned]] = 0.0
    state.mobility[:] = state.inv_mass * 0.004**2
    before = state.x.copy()
    expected = state._replace(x=before.copy())
    force = np.zeros(len(edges.particles))
    run_stage(stages.prepare, data, state, Substep(0.004, 0.0, 1.0))
    for _ in range(2):
        run_stage(stages.solve_lines, data, state, Substep(0.004, 0.0, 1.0))
        for lines in (slots, slots.T):
            solve_densely(lines, number, edges, edges.compliance, expected, force)
        moved = np.abs(expected.x - before).max()
        assert moved > 1e-4
        np.testing.assert_allclose(state.x, expected.x, rtol=0.0, atol=1e-11 * moved)
        np.testing.assert_allclose(data.edges.force[edges.index], force, rtol=0.0,
                                   atol=1e-11 * np.abs(force).max())
    np.testing.assert_array_equal(state.x[:, simulation.slot[pinned]],
                                  before[:, simulation.slot[pinned]])


@pytest.mark.parametrize('precision', ['float64', slow('float32')])
@pytest.mark.parametrize('span', [0.5, 1.0, 1.5])
@pytest.mark.parametrize('grid, far', [((9, 1), 'corner_01'), ((1, 9), 'corner_10')])
def test_a_rigid_straight_line_between_two_pins_stays_finite(grid, far, span, precision):
    """Singular: as many edges as can move nothing; slack, just as long, and too long."""
    target = [span, 0.0, 0.0] if grid[0] > 1 else [0.0, span, 0.0]
    simulation = simulate(
        grid, effects={'stretch': {'compliance': 0.0}}, method='line', integrator='bdf2',
        precision=precision, substeps=4, scene_effects={'damping': {'rate': 1.0}},
        pins={'a': {'cloth': 'c', 'at': 'corner_00'},
              'b': {'cloth': 'c', 'at': far, 'target': target}})
    for _ in range(120):
        frame = simulation.step()
        assert np.isfinite(frame.x).all()
        assert np.abs(frame.x).max() < 3.0
    if span > 1.0:    # what cannot be is still and even, and its pins feel it alike
        assert np.abs(frame.v).max() < 1e-3
        np.testing.assert_allclose(frame.x, np.outer(np.linspace(0.0, 1.0, 9), target), atol=1e-6)
        pull = [frame.pins[name].force[0 if grid[0] > 1 else 1] for name in ('a', 'b')]
        assert pull[0] == pytest.approx(-pull[1], rel=1e-3)
        step = 2.0 / 3.0 / 240.0    # H of BDF2; doc/numerics.md 3.3, and damping of 1 1/s
        mobility = step**2 / (1.0 + step) / simulation.state.mass[simulation.slot[1:-1]]
        assert pull[0] == pytest.approx((span - 1.0) / (2.0 * TINY * mobility.sum()), rel=1e-3)
    np.testing.assert_allclose(frame.x[[0, -1]], [[0.0, 0.0, 0.0], target], atol=1e-6)


def test_a_rigid_line_too_short_for_its_pins_may_begin_with_pinned_neighbours():
    simulation = simulate(
        (9, 1), effects={'stretch': {'compliance': 0.0}}, method='line', integrator='bdf2',
        substeps=4, scene_effects={'damping': {'rate': 1.0}},
        pins={'a': {'cloth': 'c', 'at': [0, 1]},
              'b': {'cloth': 'c', 'at': 'corner_01', 'target': [1.5, 0.0, 0.0]}})
    x = run(simulation, 60).x
    np.testing.assert_allclose(x[1:, 0], np.linspace(0.125, 1.5, 8), atol=1e-6)
    np.testing.assert_allclose(x[:, 1:], 0.0, atol=1e-6)


@pytest.mark.parametrize('axis, grid', [(0, (2, 1)), (1, (1, 2))])
@pytest.mark.parametrize('stage, share', [(stages.project, 1.0), (stages.project_back, 1.0),
                                          (stages.solve_lines, 1.0 / (1.0 + TINY))])
def test_particles_that_coincide_part_and_keep_their_momentum(stage, share, grid, axis):
    simulation = simulate(grid, effects={'stretch': {'compliance': 0.0}}, method='line')
    state, data = simulation.state, simulation.effects['stretch'].data
    state.x[:] = 0.0
    state.mobility[:] = state.inv_mass * 0.01**2
    run_stage(stages.prepare, data, state, Substep(0.01, 0.0, 1.0))
    run_stage(stage, data, state, Substep(0.01, 0.0, 1.0))
    x = simulation.natural(state.x)
    assert np.linalg.norm(x[1] - x[0]) == pytest.approx(share, rel=1e-14)
    np.testing.assert_allclose(x.sum(0), 0.0, atol=1e-15)


@pytest.mark.parametrize('method, integrator', quick_only(
    product(('gauss_seidel', 'gauss_seidel_symmetric', 'line'), ('backward_euler', 'bdf2')),
    ('gauss_seidel', 'backward_euler'), ('line', 'bdf2')))
@pytest.mark.parametrize('substeps, iterations', [(1, 1), (5, 20)])
@pytest.mark.parametrize('compliance', [1e-2, 1e-6])
def test_a_hanging_mass_stretches_m_g_alpha(compliance, substeps, iterations, method, integrator):
    """Whatever the method, the integrator and the setting."""
    simulation = hang(effects={'stretch': {'compliance': compliance}}, density=0.3,
                      substeps=substeps, iterations=iterations, method=method,
                      integrator=integrator)
    frame = run_until_still(simulation, speed=1e-12)
    stretched = -frame.x[1, 2] - 1.0
    weight = simulation.state.mass[simulation.slot[1]] * GRAVITY
    assert stretched == pytest.approx(weight * compliance, rel=1e-9, abs=1e-14)


def test_a_mesh_of_equilateral_triangles_has_the_given_modulus():
    """Van Gelder's lattice: Y = k, ν = 1/3, where all triangles are equilateral."""
    a = 0.1
    rows, columns = 7, 9
    vertices = np.array([[a * (c + 0.5 * (j % 2)), a * j * 0.75**0.5, 0.0]
                         for j in range(rows) for c in range(columns)])
    triangles = []
    for j in range(rows - 1):
        for c in range(columns - 1):
            p, q = j * columns + c, (j + 1) * columns + c
            triangles += ([(p, p + 1, q), (p + 1, q + 1, q)] if j % 2 == 0
                          else [(p, p + 1, q + 1), (p, q + 1, q)])
    triangles = np.array(triangles)
    ends = edges(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))
    area = edge_areas(triangles, ends, vertices)
    assert area.sum() == pytest.approx(3.0 * len(triangles) * a * a * 3.0**0.5 / 4.0)
    strain = np.array([[2e-4, 1e-4], [1e-4, -3e-4]])
    d = vertices[ends[:, 1], :2] - vertices[ends[:, 0], :2]
    stretched = np.einsum('ki,ij,kj->k', d, strain, d) / a
    energy = (0.5 * 40.0 * area / a**2 * stretched**2).sum()
    young, poisson = 40.0, 1.0 / 3.0
    factor = young / (1.0 - poisson**2)
    xx, yy, xy = strain[0, 0], strain[1, 1], strain[0, 1]
    density = 0.5 * factor * (xx**2 + yy**2 + 2.0 * poisson * xx * yy
                              + 2.0 * (1.0 - poisson) * xy**2)
    assert energy == pytest.approx(density * len(triangles) * a * a * 3.0**0.5 / 4.0, rel=1e-9)


def test_edges_of_a_mesh_have_the_stiffness_of_their_direction():
    """k = (warp cos² + weft sin²) Σ A / l²."""
    simulation = simulate(mesh=True, effects={'stretch': {'warp': 500.0, 'weft': 20.0}})
    mesh, built = simulation.cloths[0].mesh, simulation.effects['stretch'].constraints
    number = np.full(simulation.state.x.shape[1], -1)
    number[simulation.slot] = np.arange(len(simulation.slot))
    ends = number[built.particles]
    d = mesh.positions[ends[:, 1]] - mesh.positions[ends[:, 0]]
    square = (d**2).sum(1)
    np.testing.assert_allclose(built.rest_length**2, square, rtol=1e-12)
    area = edge_areas(mesh.triangles, ends, mesh.positions)
    cosine = d[:, 0]**2 / square
    np.testing.assert_allclose(1.0 / built.compliance,
                               (500.0 * cosine + 20.0 * (1.0 - cosine)) * area / square,
                               rtol=1e-9)


def test_a_body_has_no_stiffness_by_width():
    """Its inner edges belong to no triangle, so warp and weft would leave them without any."""
    body = file_of(*box())
    with pytest.raises(InputError) as error:
        simulate(mesh=body, effects={'stretch': {'warp': 10.0, 'weft': 10.0}})
    assert str(error.value).endswith(
        'cloths.c.effects.stretch: warp and weft (N/m) are of a surface, and 43 edges are inside '
        'a body; give compliance (m/N), or the effect volume')
    simulate(mesh=body, effects={'stretch': {'compliance': 0.01}})


@pytest.mark.parametrize('method', [
    pytest.param('gauss_seidel', marks=pytest.mark.smoke), slow('explicit'), slow('line'),
    slow('jacobi')])
def test_a_disc_of_triangles_hangs_with_its_weight(method):
    integrator = 'leapfrog' if method == 'explicit' else 'backward_euler'
    simulation = simulate(mesh=True, density=0.4, effects={
        'stretch': {'warp': 300.0, 'weft': 300.0}, 'bend': {'stiffness': 1e-3}},
        pins={'a': {'cloth': 'c', 'at': [0]}}, scene_effects={'damping': {'rate': 12.0}},
        substeps=60, iterations=1 if method == 'explicit' else 2, method=method,
        integrator=integrator)
    frame = run(simulation, 300)
    weight = simulation.state.mass.sum() * GRAVITY
    np.testing.assert_allclose(frame.pins['a'].force, [0.0, 0.0, -weight], atol=0.02 * weight)
    assert frame.x[:, 2].min() < -0.2
    assert largest_strain(simulation) < 0.2
