"""Paths along the edges of meshes: every edge once, solved exactly, and worth their time."""

from functools import cache

import numpy as np
import pytest

from support.meshes import disc, file_of, irregular
from support.scenes import DOWN, GRAVITY, run, run_stage, run_until_still, simulate
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.constraints.mesh_batches import EMPTY
from xpbd_ros.sim.constraints.mesh_paths import cover, LEAST, MOST, PER_STRAIN
from xpbd_ros.sim.geometry.mesh import edges
from xpbd_ros.sim.measure import largest_strain
from xpbd_ros.sim.particles.state import Substep
from xpbd_ros.sim.stepping import stages

STRETCH = {'stretch': {'warp': 300.0, 'weft': 300.0}}
H = 0.004


@cache
def sheet_file(cells=12):
    """Return an OBJ file of an irregular square of 1 m, and its vertices."""
    vertices, triangles = irregular(cells)
    return file_of(vertices, triangles), vertices


def hung(method, substeps, *, stretch=STRETCH, scene_effects=None, cells=12, **options):
    """Return an irregular square that starts level, held at two corners."""
    file, vertices = sheet_file(cells)
    corners = [int(np.argmin(np.abs(vertices[:, :2] - at).sum(1)))
               for at in ((-0.5, 0.5), (0.5, 0.5))]
    return simulate(mesh=file, effects=stretch, density=0.2, method=method, integrator='bdf2',
                    substeps=substeps, pins={'a': {'cloth': 'c', 'at': corners}},
                    scene_effects=scene_effects, **options)


def rms(a, b):
    """Return the root mean square distance of particles."""
    return np.sqrt(((a - b)**2).sum(1).mean())


def covers():
    """Return edges, rest positions and paths of several meshes."""
    fan = np.concatenate([[[0.0, 0.0, 0.0]], irregular(3)[0][:7]])
    meshes = {'disc': disc(5), 'irregular': irregular(20), 'triangle': (np.eye(3), np.array(
        [[0, 1, 2]])), 'fan': (fan, np.array([[0, k, k + 1] for k in range(1, 7)]))}
    for vertices, triangles in meshes.values():
        ends = edges(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))
        yield ends, vertices, cover(ends, vertices)
    none = np.zeros((0, 2), int)
    yield none, np.eye(3), cover(none, np.eye(3))


def test_every_edge_is_on_one_path_and_lanes_share_no_particle():
    for ends, _, found in covers():
        there = found.order != EMPTY
        np.testing.assert_array_equal(np.sort(found.order[there]), np.arange(len(ends)))
        np.testing.assert_array_equal(np.sort(found.particles, 1), np.sort(ends, 1))
        assert len(found.order) == PACK * found.begin[-1]
        for begin, end in zip(PACK * found.begin[:-1], PACK * found.begin[1:]):
            chosen = found.order[begin:end][there[begin:end]]
            first = ~found.follows[begin:end][there[begin:end]]
            passed = np.concatenate([found.particles[chosen][first, 0],
                                     found.particles[chosen][:, 1]])
            assert len(np.unique(passed)) == len(passed) > 0


def test_paths_go_on_without_sharp_turns():
    for _, x, found in covers():
        after = np.flatnonzero(found.follows)
        one, other = (found.particles[found.order[k]] for k in (after - PACK, after))
        np.testing.assert_array_equal(one[:, 1], other[:, 0])
        turn = ((x[one[:, 1]] - x[one[:, 0]]) * (x[other[:, 1]] - x[other[:, 0]])).sum(1)
        assert (turn > 0.0).all()


def test_paths_of_an_irregular_mesh_are_long_and_fill_the_lanes():
    vertices, triangles = irregular(60)
    ends = edges(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))
    found = cover(ends, vertices)
    paths = (~found.follows & (found.order != EMPTY)).sum()
    assert len(ends) / paths > 8.0
    assert (found.order != EMPTY).mean() > 0.97


def solve_densely(data, listed, state, force):
    """Solve path after path by dense matrices: (J M Jᵀ + α) Δf = -(C + α f), x += M Jᵀ Δf."""
    number = np.full(len(data.paths.follows), -1)
    number[listed.index] = np.arange(len(listed.index))
    packs = np.searchsorted(data.paths.begin, np.arange(len(number)) // PACK, side='right')
    paths, of = [], {}
    for c in sorted(listed.index, key=lambda c: (packs[c], c)):
        if data.paths.follows[c]:
            of[c] = of[c - PACK]
        else:
            of[c] = len(paths)
            paths.append([])
        paths[of[c]].append(number[c])
    for chosen in paths:
        one, other = listed.particles[chosen].T
        d = state.x[:, other] - state.x[:, one]
        length, rows = np.linalg.norm(d, axis=0), np.arange(len(chosen))
        jacobian = np.zeros((len(chosen), 3, state.x.shape[1]))
        jacobian[rows, :, other] += (d / length).T
        jacobian[rows, :, one] -= (d / length).T
        jacobian = jacobian.reshape(len(chosen), -1)
        m, wrong = np.tile(state.mobility, 3), length - listed.rest_length[chosen]
        least = np.clip(PER_STRAIN * wrong / length, LEAST, MOST)
        ends = state.mobility[one] + state.mobility[other]
        system = jacobian * m @ jacobian.T + np.diag(
            np.maximum(listed.compliance[chosen], least * ends))
        right = -(wrong + listed.compliance[chosen] * force[chosen])
        idle = np.diag(system) == 0.0    # rigid, between two pins
        system[idle, idle], right[idle] = 1.0, 0.0
        change = np.linalg.solve(system, right)
        force[chosen] += change
        state.x[:] += (m * (change @ jacobian)).reshape(3, -1)


@pytest.mark.parametrize('stretch', [
    {'warp': 300.0, 'weft': 200.0}, {'warp': 3e6, 'weft': 2e6}, {'compliance': 0.0}])
@pytest.mark.parametrize('pinned', [[], [0, 3, 7, 8, 30]])
@pytest.mark.parametrize('file', [True, sheet_file()[0]], ids=['disc', 'irregular'])
def test_a_path_is_solved_as_a_dense_matrix_is(file, pinned, stretch):
    """Pack after pack, twice; momentum, or the force on pinned particles, to rounding."""
    simulation = simulate(mesh=file, effects={'stretch': stretch}, density=0.2, method='line',
                          pins={'a': {'cloth': 'c', 'at': pinned}} if pinned else None)
    state, built = simulation.state, simulation.effects['stretch']
    data, listed = built.data, built.constraints
    state.x[:, simulation.slot] += np.random.default_rng(3).normal(
        0.0, 0.05 * listed.rest_length.mean(), (3, len(simulation.slot)))
    state.mobility[:] = state.inv_mass * H**2
    before, force = state.x.copy(), np.zeros(len(listed.particles))
    expected = state._replace(x=before.copy())
    run_stage(stages.prepare, data, state, Substep(H, 0.0, 1.0))
    for _ in range(2):
        run_stage(stages.solve_lines, data, state, Substep(H, 0.0, 1.0))
        solve_densely(data, listed, expected, force)
        moved = np.abs(expected.x - before).max()
        assert moved > 1e-4
        np.testing.assert_allclose(state.x, expected.x, rtol=0.0, atol=1e-10 * moved)
        np.testing.assert_allclose(data.edges.force[listed.index], force, rtol=0.0,
                                   atol=1e-10 * np.abs(force).max())
    held = simulation.slot[pinned]
    np.testing.assert_array_equal(state.x[:, held], before[:, held])
    given = (state.mass * (state.x - before)).sum(1) / H**2
    rounding = 1e-14 * (state.mass * np.abs(state.x - before)).sum() / H**2
    if pinned:    # edges between two pinned particles are for another stage
        reaction = state.reaction[:, held].sum(1)
        np.testing.assert_allclose(reaction, -given, rtol=0.0,
                                   atol=1e-12 * np.linalg.norm(given) + rounding)
        assert np.linalg.norm(given) > 1e3 * rounding
    else:
        np.testing.assert_allclose(given, 0.0, atol=rounding)


def test_a_hanging_strip_stretches_m_g_alpha():
    """Every edge by α times its force, and all of them together carry what hangs below."""
    file, vertices = sheet_file(6)
    top = np.flatnonzero(vertices[:, 0] < -0.499)
    simulation = simulate(mesh=file, effects=STRETCH, density=0.2, method='line', substeps=3,
                          iterations=40, pose={'orientation': DOWN}, gravity=(0.0, 0.0, -0.2),
                          pins={'a': {'cloth': 'c', 'at': top.tolist()}},
                          scene_effects={'damping': {'rate': 15.0}})
    frame = run_until_still(simulation, speed=1e-9)
    state, built = simulation.state, simulation.effects['stretch']
    listed, force = built.constraints, built.data.edges.force[built.constraints.index]
    residual = listed.residual(state.x)
    np.testing.assert_allclose(residual, -listed.compliance * force, rtol=0.0,
                               atol=1e-5 * np.abs(residual).max())
    weight = 0.2 * state.mass.sum()
    assert frame.pins['a'].force[2] == pytest.approx(-weight, rel=1e-6)
    one, other = listed.particles.T
    d = state.x[2, other] - state.x[2, one]
    pull = force * d / np.linalg.norm(state.x[:, other] - state.x[:, one], axis=0)
    for height in (-0.3, 0.05, 0.3):
        below = state.x[2] < height
        carried = -(pull * (below[one].astype(float) - below[other])).sum()
        assert carried == pytest.approx(0.2 * state.mass[below].sum(), rel=1e-3)


def test_many_substeps_give_what_gauss_seidel_gives():
    """The difference falls with the substeps."""
    apart = []
    for substeps in (30, 120):
        ways = [run(hung(method, substeps), 15).x
                for method in ('line', 'gauss_seidel_symmetric')]
        apart.append(rms(*ways))
    assert apart[1] < 0.3 * apart[0]
    assert apart[1] < 2e-3


@pytest.mark.parametrize('substeps', [4, 8])
def test_paths_halve_the_error_of_a_swing(substeps):
    """And more than that: the two are to cost about the same (doc/solver.md)."""
    truth = run(hung('gauss_seidel_symmetric', 256), 24).x
    swept, solved = (rms(run(hung(method, substeps), 24).x, truth)
                     for method in ('gauss_seidel_symmetric', 'line'))
    assert solved < 0.45 * swept


def test_a_taut_sheet_is_as_still_as_with_gauss_seidel():
    """At a strain of 0.1: zigzag paths must not straighten before others have pulled."""
    file, vertices = sheet_file(24)
    speed = {}
    for method in ('gauss_seidel_symmetric', 'line'):
        simulation = simulate(
            mesh=file, effects=STRETCH, density=0.2, method=method, integrator='bdf2', substeps=4,
            scene_effects={'damping': {'rate': 2.0}}, gravity=(0.0, 0.0, -GRAVITY), pins={
                name: {'cloth': 'c', 'at': np.flatnonzero(side * vertices[:, 0] > 0.499).tolist(),
                       'motion': [[0.0, 0.5 * side, 0.0, 0.0], [1.0, 0.55 * side, 0.0, 0.0]]}
                for name, side in (('left', -1.0), ('right', 1.0))})
        frames = [simulation.step() for _ in range(150)]
        speed[method] = np.sqrt(np.mean([(frame.v**2).sum(1).mean() for frame in frames[-30:]]))
    assert speed['line'] < 1.3 * speed['gauss_seidel_symmetric']


@pytest.mark.parametrize('substeps', [1, 4, 16])
def test_rough_starts_stay_finite_and_no_wilder_than_gauss_seidel(substeps):
    """Velocities of 3 m/s each, and a crumpled sheet: by the largest speed of the first second."""
    for start in ('velocities', 'crumpled'):
        most = {}
        for method in ('gauss_seidel', 'line'):
            simulation = hung(method, substeps, stretch={'stretch': {'warp': 2e4, 'weft': 2e4}})
            random, free = np.random.default_rng(1), simulation.state.inv_mass > 0.0
            if start == 'velocities':
                simulation.state.v[:, free] = random.normal(0.0, 3.0, (3, free.sum()))
            else:
                simulation.state.x[:2, free] *= 0.5
                simulation.state.x[:, free] += random.normal(0.0, 0.04, (3, free.sum()))
            energy = []
            for _ in range(60):
                frame = simulation.step()
                assert np.isfinite(frame.x).all()
                energy.append((frame.v**2).sum())
            most[method] = max(energy)
        assert most['line'] <= 1.05 * most['gauss_seidel'], (start, most)


def test_rigid_edges_hold_a_sheet_together():
    simulation = hung('line', 16, stretch={'stretch': {'compliance': 0.0}},
                      scene_effects={'damping': {'rate': 4.0}})
    run(simulation, 90)
    assert largest_strain(simulation) < 0.05
