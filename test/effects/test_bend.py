"""Bending: the energy on a cylinder is that of a plate, in every direction."""

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from support.scenes import run, simulate
from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.sim.stepping.methods import SOFT

B = 3e-4


def bending(grid, size=(1.0, 1.0)):
    """Return what resists bending in a sheet, and its rest shape, by slot."""
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
def test_energy_on_a_cylinder_is_a_plates_in_every_direction(degrees, n):
    """
    With κxx = κ cos², κyy = κ sin², κxy = κ sin cos it is ½ B (κxx² + κyy² + 2 κxy²) = ½ B κ².

    A row has n - 2 places of n - 1 where it curves; cells twist everywhere.
    """
    bends, x = bending((n, n))
    curvature = 1e-3
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    inner = (n - 2) / (n - 1)
    expected = 0.5 * B * curvature**2 * ((c**4 + s**4) * inner + 2.0 * c**2 * s**2)
    assert bends.energy(on_a_cylinder(x, curvature, degrees)) == pytest.approx(
        expected, rel=1e-5)


@pytest.mark.parametrize('degrees', [0.0, 30.0, 45.0, 90.0])
def test_warp_and_weft_may_bend_differently_and_cells_be_oblong(degrees):
    """The twist has their geometric mean."""
    warp, weft, curvature = 2.0, 5.0, 1e-3
    simulation = simulate((5, 11), (1.0, 0.6), effects={'bend': {'warp': warp, 'weft': weft}})
    rolled = on_a_cylinder(simulation.state.x, curvature, degrees)
    c2, s2 = np.cos(np.radians(degrees))**2, np.sin(np.radians(degrees))**2
    rigidity = 3 / 4 * warp * c2**2 + 9 / 10 * weft * s2**2 + 2.0 * np.sqrt(warp * weft) * c2 * s2
    assert simulation.effects['bend'].constraints.energy(rolled) == pytest.approx(
        0.5 * rigidity * curvature**2 * 0.6, rel=1e-5)


def test_a_mesh_bends_as_stiffly_along_weft_as_weft_says():
    """Rolled along weft it stores four times as much; test_plate has all directions."""
    simulation = simulate(mesh=True, effects={'bend': {'warp': 1.0, 'weft': 4.0}})
    along = [simulation.effects['bend'].constraints.energy(
        on_a_cylinder(simulation.state.x, 1e-3, degrees)) for degrees in (0.0, 90.0)]
    assert along[1] / along[0] == pytest.approx(4.0, rel=0.15)


@pytest.mark.parametrize('rows', [1, 2, 3, 8])
@pytest.mark.parametrize('n, error', [(11, 1e-2), (21, 2.6e-3), (41, 7e-4)])
def test_a_cantilever_sags_as_a_beam_does_whatever_its_rows(rows, n, error):
    """
    q L⁴ / (8 B) for a load q per area, and second order.

    Free to relax: hinges that see the curvature of every other particle give a third more.
    """
    simulation = simulate((n, rows), (1.0, 0.3), effects={'bend': {'stiffness': B}})
    bends, slot = simulation.effects['bend'].constraints, simulation.slot
    number = np.full(simulation.state.x.shape[1], -1)
    number[slot] = np.arange(len(slot))
    count = len(bends.particles)
    each = np.repeat(np.arange(count), 4)
    operator = sparse.csr_matrix(
        (bends.weight.ravel(), (each, number[bends.particles].ravel())), (count, len(slot)))
    stiffness = operator.T @ sparse.diags(1.0 / bends.compliance) @ operator
    free = np.arange(len(slot)) % n > 1    # clamped half way between the first two
    load = np.where(free, simulation.cloths[0].mesh.area, 0.0)
    sag = np.zeros(len(slot))
    sag[free] = spsolve(stiffness[free][:, free].tocsc(), load[free])
    d = 1.0 / (n - 1)
    expected = (1.0 - 0.5 * d)**4 / (8.0 * B)
    assert sag.reshape(rows, n)[:, -1].mean() == pytest.approx(expected, rel=error)


@pytest.mark.parametrize('angle', [0.1, 1.0, 3.0, np.pi, 3.5, 6.0])
def test_a_fold_stores_energy_without_a_wrap(angle):
    """Half a strip turned about the line across it: B w |C|² / (2 d³), |C| = 2 d sin(θ/2); H7."""
    bends, x = bending((3, 1))
    y = x.copy()
    (_, _, _, last), = bends.particles
    y[0, last], y[2, last] = 0.5 + 0.5 * np.cos(angle), 0.5 * np.sin(angle)
    expected = 0.5 * B / 0.5**3 * (np.sin(0.5 * angle))**2
    assert bends.energy(y) == pytest.approx(expected, rel=1e-12, abs=1e-18)


def test_hinges_of_an_irregular_mesh_are_at_most_half_too_stiff():
    """Rolled, within the table of doc/numerics.md 5.7; the triangles are nearly equilateral."""
    simulation = simulate(mesh=True, effects={'bend': {'stiffness': B}})
    mesh = simulation.cloths[0].mesh
    for degrees in (0.0, 30.0, 75.0):
        energy = simulation.effects['bend'].constraints.energy(
            on_a_cylinder(simulation.state.x, 1e-3, degrees))
        plate = 0.5 * B * 1e-6 * mesh.area.sum()
        assert 0.6 * plate < energy < 1.5 * plate    # a rim of triangles lacks its hinges


def test_a_flat_sheet_stores_no_energy_in_any_affine_pose():
    bends, x = bending((5, 4), (1.0, 0.7))
    x = x.T
    deformed = (Rotation.random(random_state=1).apply(x @ np.diag([1.3, 0.6, 1.0]) + [
        0.3, 0.1, 0.0] * x[:, [1]]) + [5.0, -2.0, 1.0]).T
    assert bends.energy(deformed) < 1e-25
    assert np.abs(bends.residual(deformed)).max() < 1e-13


def test_bending_without_stiffness_are_as_absent():
    """H2; the least that a scene may say: its inverse must not become infinite on the way."""
    simulation = simulate((3, 3), effects={'bend': {'stiffness': 1e-300}}, gravity=(0, 0, 0),
                          iterations=2)
    simulation.state.x[2, simulation.slot[4]] += 0.5
    start = simulation.frame().x
    np.testing.assert_allclose(run(simulation, 3).x, start, atol=1e-14)


def test_points_and_pairs_do_not_bend():
    for grid, count in (((1, 1), 0), ((1, 2), 0), ((2, 1), 0), ((1, 5), 3), ((5, 1), 3)):
        assert len(bending(grid)[0].particles) == count


@pytest.mark.parametrize('bend', [{}, {'stiffness': 1.0, 'warp': 1.0}, {'warp': 1.0}])
def test_one_rigidity_or_two(bend):
    with pytest.raises(InputError, match='warp and weft'):
        simulate((3, 3), effects={'bend': bend})


@pytest.mark.parametrize('integrator', ['ndf2', slow('bdf2')])
def test_a_clamped_strip_swings_with_the_period_of_a_beam(integrator):
    """
    V22, coarse: ω = 3.516 √(B / ρ L⁴); it is let go from a small deflection.

    Shear and damping are negligible: they are there to share the compiled step of other tests.
    """
    rigidity, density, n, length = 1e-3, 0.2, 8, 0.3
    strip = simulate((n + 2, 2), ((n + 1) * length / n, length / n), gravity=(0, 0, 0),
                     substeps=40, density=density, method='line', integrator=integrator,
                     iterations=4, scene_effects={'damping': {'rate': 0.0}}, effects={
                         'bend': {'stiffness': rigidity},
                         'shear': {'stiffness': 1e-6},
                         'stretch': {'warp': 500.0, 'weft': 500.0}},
                     pins={'root': {'cloth': 'c', 'at': [0, 1, n + 2, n + 3]}})
    x = strip.frame().x
    along = np.maximum(x[:, 0] - 1.5 * length / n, 0.0)
    strip.state.x[2, strip.slot] = 0.05 * along**2 * (3.0 * length - along)
    tip = [strip.step().x[n + 1, 2] for _ in range(90)]
    period = 2.0 * np.pi / (3.516 * np.sqrt(rigidity / (density * length**4)))
    (first, *_) = np.flatnonzero(np.diff(np.sign(tip)))
    assert (first + 1.5) / 60.0 == pytest.approx(0.25 * period, rel=0.12)


def rumpled(excess, mesh, substeps, **options):
    """Return a sheet without weight, that only bends, and its ρ times SOFT or less."""
    unit = simulate((6, 5), mesh=mesh, effects={'bend': {'stiffness': 1.0}})
    rigidity = excess * SOFT / unit.effects['bend'].rate * (60.0 * substeps)**2
    sheet = simulate((6, 5), mesh=mesh, method='line', gravity=(0, 0, 0), substeps=substeps,
                     effects={'bend': {'stiffness': rigidity}}, **options)
    sheet.state.x[:] += np.random.default_rng(0).normal(0.0, 0.02, sheet.state.x.shape)
    return sheet


def after_sweeps(sheet, substeps):
    """Return positions after substeps of sweeps: an order, and the share of W in the solution."""
    bends, x = sheet.effects['bend'].constraints, sheet.state.x.copy()
    h, v = 1.0 / (60.0 * len(substeps)), np.zeros_like(x)
    m = h * h / np.where(sheet.state.mass > 0.0, sheet.state.mass, np.inf)
    for sweeps in substeps:
        f, start, x = np.zeros((len(bends.compliance), 3)), x, x + h * v
        for order, share in sweeps:
            for c in np.arange(len(f))[::order]:
                i, k, alpha = bends.particles[c], bends.weight[c], bends.compliance[c]
                df = -(x[:, i] @ k + alpha * f[c]) / (share * (m[i] @ k**2) + alpha)
                f[c] += df
                np.add.at(x.T, i, np.outer(m[i] * k, df))
        v = (x - start) / h
    return sheet.natural(x)


FORTH, BACK, BOTH = [(1, 0.5)], [(-1, 0.5)], [(1, 1.0), (-1, 1.0)]


@pytest.mark.parametrize('mesh', [False, True])
@pytest.mark.parametrize('excess, substeps', [
    (0.99, [FORTH, BACK]), (0.99, [FORTH, BACK, BOTH]), (0.99, [BOTH]), (1.01, [BOTH, BOTH])])
@pytest.mark.parametrize('iterations', [1, 2])
def test_lines_sweep_soft_bending_forth_and_back_in_turn(mesh, excess, substeps, iterations):
    """With half of W; in both ways, with all of it, if it is stiff or no substep follows."""
    sheet = rumpled(excess, mesh, len(substeps), iterations=iterations)
    expected = after_sweeps(sheet, [sweeps * iterations for sweeps in substeps])
    np.testing.assert_allclose(run(sheet, 1).x, expected, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize('mesh', [False, True])
def test_single_passes_converge_to_the_implicit_step(mesh):
    """To (M + H² K) x = M x̄, in iterations."""
    sheet = rumpled(0.99, mesh, 2, iterations=60)
    mass, x = sheet.state.mass, sheet.state.x.copy()
    there, before = mass > 0.0, x
    system = stiffness(sheet)[np.ix_(there, there)] / 120.0**2 + np.diag(mass[there])
    for _ in range(2):
        before, x = x, 2.0 * x - before
        x[:, there] = np.linalg.solve(system, (mass * x)[:, there].T).T
    np.testing.assert_allclose(run(sheet, 1).x, sheet.natural(x), rtol=0.0, atol=1e-13)


def stiffness(sheet):
    """Return the stiffness of bending in each direction [N/m], shape (slots, slots)."""
    bends, slots = sheet.effects['bend'].constraints, len(sheet.state.mass)
    found = np.zeros((slots, slots))
    for particles, weight, alpha in zip(bends.particles, bends.weight, bends.compliance):
        np.add.at(found, np.ix_(particles, particles), np.outer(weight, weight) / alpha)
    return found


@pytest.mark.parametrize('mesh', [False, True])
def test_the_rate_bounds_the_highest_frequency_of_bending(mesh):
    """Squared [1/s²]; and it is no more than twice as large."""
    sheet = simulate((6, 5), mesh=mesh, effects={'bend': {'stiffness': B}})
    mass = sheet.state.mass
    there, rate = mass > 0.0, sheet.effects['bend'].rate
    scale = np.sqrt(mass[there])
    highest = np.linalg.eigvalsh(stiffness(sheet)[np.ix_(there, there)]
                                 / np.outer(scale, scale)).max()
    assert highest <= rate <= 2.0 * highest
