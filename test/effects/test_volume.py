"""Bodies of tetrahedra: an elastic solid, whatever is done to it."""

import numpy as np
import pytest
from scipy.optimize import minimize

from support.meshes import box, disc, file_of
from support.scenes import run, run_stage, simulate
from support.shipped_scenes import WITH_MESHIO
from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.sim.geometry.mesh import cross, dot
from xpbd_ros.sim.measure import elastic_energy, kinetic_energy
from xpbd_ros.sim.particles.state import Substep
from xpbd_ros.sim.stepping import stages

pytestmark = WITH_MESHIO
CELLS, SIZE = (2, 2, 3), 0.1
YOUNG = 2e4


def body(poisson=0.3, *, young=YOUNG, cells=CELLS, pose=None, **options):
    """Return a box of 0.2 m × 0.2 m × 0.3 m without weight, which pins may hold."""
    return simulate(mesh=file_of(*box(cells, SIZE)), density=100.0, pose=pose,
                    effects={'volume': {'young': young, 'poisson': poisson}}, **{
                        'gravity': (0, 0, 0), 'scene_effects': {'pin': {}}, **options})


def place(simulation, x):
    """Put the particles somewhere, at rest; natural order."""
    simulation.state.x[:, simulation.slot] = np.asarray(x).T
    simulation.state.v[:] = 0.0


def volumes(simulation, x):
    """Return the volume of each tetrahedron [m³]."""
    a, b, c, d = (x[simulation.cloths[0].mesh.tetrahedra[:, k]] for k in range(4))
    return dot(cross(b - a, c - a), d - a) / 6.0


def settle(simulation, held, rounds, h=0.01):
    """Let what is not held find its rest: quasi-static, by the kernels alone."""
    state, built = simulation.state, simulation.effects['volume']
    state.inv_mass[simulation.slot[held]] = 0.0
    built.hold(state.inv_mass)
    state.mobility[:] = state.inv_mass * h**2
    for _ in range(rounds):
        state.reaction[:] = 0.0
        for stage in (stages.prepare, *[stages.project, stages.project_back] * 10):
            run_stage(stage, built.data, state, Substep(h, 0.0, 1.0))
    return simulation.frame().x, simulation.natural(state.reaction)


def energy_of(f, mu, lame):
    """Smith et al. 2018, eq 14, with the norm of F kept in place of their barrier."""
    n, growth = np.sqrt((f * f).sum()), np.linalg.det(f) - 1.0
    return (0.5 * mu * (n**2 - 3.0 - 2.0 * growth + 8.0 / 9.0 * growth**2 + (n - 3**0.5)**2 / 3.0)
            + 0.5 * lame * growth**2)


def test_the_energy_of_an_affine_patch_is_stable_neo_hookean():
    """For any F: inverted and flat ones, and a point, too."""
    simulation = body(0.4)
    x, rng = simulation.frame().x, np.random.default_rng(3)
    mu, lame = YOUNG / 2.8, YOUNG * 0.4 / (1.4 * 0.2)
    for f in (*(np.eye(3) + s * rng.normal(size=(3, 3)) for s in (0.1, 0.5, 1.0, 4.0)),
              np.diag([1.0, 1.0, -1.0]), np.diag([1.0, 1.0, 0.0]), np.zeros((3, 3))):
        place(simulation, x @ f.T)
        assert elastic_energy(simulation) == pytest.approx(
            0.012 * energy_of(f, mu, lame), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize('ratio', [0.0, 0.7, 1e3])
def test_the_energy_has_one_minimum(ratio):
    """From any F, a reflection or next to a point too, it falls on the way to a rotation."""
    rng = np.random.default_rng(4)
    for scale in (1e-6, 0.1, 0.3, 1.0, 3.0):
        for _ in range(5):
            found = scale * rng.normal(size=9)
            best = minimize(lambda f: energy_of(f.reshape(3, 3), 1.0, ratio), found,
                            method='BFGS', options={'gtol': 1e-9, 'maxiter': 2000})
            f = best.x.reshape(3, 3)
            np.testing.assert_allclose(f.T @ f, np.eye(3), atol=1e-4)
            assert np.linalg.det(f) > 0.0


def pulled(poisson, e):
    """Return a bar, where it is when pulled, and which particles are inside."""
    simulation = body(poisson)
    x = simulation.frame().x
    inside = ((x > 1e-9) & (x < [0.2 - 1e-9, 0.2 - 1e-9, 0.3 - 1e-9])).all(1)
    assert inside.sum() == 2
    target = x * [1.0 - poisson * e, 1.0 - poisson * e, 1.0 + e]
    place(simulation, target)
    return simulation, x, target, inside


@pytest.mark.parametrize('poisson', [0.0, 0.3, 0.45])
def test_a_pulled_bar_has_youngs_modulus_and_poissons_ratio(poisson):
    """The ends pull with E e A, and nothing holds the sides, which are where ν has them."""
    e, area = 1e-5, 0.04
    simulation, x, target, inside = pulled(poisson, e)
    found, force = settle(simulation, ~inside, 3, h=1e-4)
    np.testing.assert_allclose(found, target, rtol=0.0, atol=1e-5 * e)
    top, bottom = x[:, 2] > 0.3 - 1e-9, x[:, 2] < 1e-9
    assert force[top, 2].sum() == pytest.approx(-YOUNG * e * area, rel=1e-3)
    assert force[bottom, 2].sum() == pytest.approx(YOUNG * e * area, rel=1e-3)
    side = (x[:, 0] < 1e-9) & ~top & ~bottom
    assert np.abs(force[side].sum(0)).max() < 1e-3 * YOUNG * e * area


@pytest.mark.parametrize('poisson', [slow(0.0), 0.45])
def test_patch_test_converges_as_substeps_shrink(poisson):
    """The patch test; what is left is that gradients turn while a substep is solved."""
    errors = []
    for h in (0.004, 0.002):
        e = 1e-4
        simulation, x, target, inside = pulled(poisson, e)
        moved = target.copy()
        moved[inside] += 0.01 * e * np.random.default_rng(1).normal(size=(2, 3))
        place(simulation, moved)
        found, _ = settle(simulation, ~inside, 2000, h=h)
        errors.append(np.abs(found - target).max() / e)
    assert errors[0] < 0.01
    assert errors[1] < 0.45 * errors[0]


def test_volume_loss_vanishes_as_poisson_nears_a_half():
    """V19: what it loses goes with the bulk compliance, 1 - 2 ν."""
    lost = []
    for poisson in (0.3, 0.49, 0.499):
        simulation = body(poisson)
        x = simulation.frame().x
        place(simulation, x * [1.0, 1.0, 0.9])
        ends = (x[:, 2] < 1e-9) | (x[:, 2] > 0.3 - 1e-9)
        found, _ = settle(simulation, ends, 1000, h=1e-3)
        lost.append(1.0 - volumes(simulation, found).sum() / 0.012)
    assert 0.03 < lost[0] < 0.1
    assert lost[1] > 6.0 * lost[2] > 0.0
    assert lost[2] < 0.002


@pytest.mark.parametrize('what', ['flat', 'inside out', 'crumpled', 'in a point'])
@pytest.mark.parametrize('young', [2e3, 2e9])
def test_a_body_that_is_flat_or_inside_out_comes_back(what, young):
    """H14; the stiff one is what sqrt(tr FᵀF) for C_D blows up with."""
    simulation = body(0.4, young=young, substeps=10,
                      scene_effects={'damping': {'rate': 4.0}, 'pin': {}})
    x, rng = simulation.frame().x, np.random.default_rng(2)
    place(simulation, {'flat': x * [1.0, 1.0, 0.0], 'inside out': x * [1.0, 1.0, -1.0],
                       'in a point': 0.0 * x,
                       'crumpled': x + rng.normal(0.0, 0.5 * SIZE, x.shape)}[what])
    for _ in range(240):
        frame = simulation.step()
        assert np.isfinite(frame.x).all()
        assert np.abs(frame.x).max() < 10.0
    assert volumes(simulation, frame.x).min() > 0.0
    assert volumes(simulation, frame.x).sum() == pytest.approx(0.012, rel=1e-3)


@pytest.mark.parametrize('precision, most', [
    ('float64', 1e-12), slow('float32', 2e-5)])
@pytest.mark.parametrize('young', [1e3, 1e9])
def test_a_turned_body_rests(young, precision, most):
    """Whatever the stiffness, even in float32: no terms that cancel at rest."""
    simulation = body(0.45, young=young, substeps=4, precision=precision,
                      pose={'orientation': [0.5, -0.1, 0.7, 0.5]})
    x = simulation.frame().x
    assert np.abs(run(simulation, 30).x - x).max() < most


def test_a_body_swings_with_the_energy_that_it_was_given():
    """BDF2 loses it with the cube of the substep; the effect is what swings."""
    lost = []
    for substeps in (32, 64):
        simulation = body(0.3, method='gauss_seidel_symmetric', integrator='bdf2',
                          substeps=substeps)
        x = simulation.frame().x
        place(simulation, x * [1.0, 1.0, 1.05])
        start = elastic_energy(simulation)
        run(simulation, 8)
        assert kinetic_energy(simulation.state) > 0.0
        lost.append(1.0 - (elastic_energy(simulation) + kinetic_energy(simulation.state)) / start)
    assert 0.0 < lost[1] < 0.5 * lost[0]


@pytest.mark.parametrize('poisson', [0.5, 0.7])
def test_no_finite_bulk_modulus_is_refused(poisson):
    with pytest.raises(InputError, match=r'volume.*poisson: must be < 0.5 \(got 0.[57]\)'):
        body(poisson)


def test_a_surface_is_refused():
    with pytest.raises(InputError, match=r'cloths.c.effects.volume: needs a mesh of tetrahedra'):
        simulate(mesh=file_of(*disc()), effects={'volume': {'young': 1e4}})
