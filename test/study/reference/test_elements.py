"""Every kind of element: its derivatives, its forces, and what the simulation makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import eigsh

from support.shipped_scenes import WITH_MESHIO
from xpbd_ros.study.reference import (
    elastic,
    equilibrium,
    gradient,
    limit,
    newton,
    potential,
    Problem,
    problem_of,
    rms,
    Stiffness,
)
from xpbd_ros.study.reference.forces import FORCE_KERNELS
from xpbd_ros.study.reference.stiffness import Factor
from xpbd_ros.study.verify.energies import FRAMES, scene

pytestmark = WITH_MESHIO


@pytest.fixture(scope='module')
def every():
    """Return a scene with all effects, what it should compute, and places far from rest."""
    simulation = scene(8)
    problem = problem_of(simulation)
    rng = np.random.default_rng(1)
    return simulation, problem, problem.x + 0.02 * rng.standard_normal(problem.x.shape)


def each(problem):
    """Return a problem for each kind of element."""
    found = [replace(problem, elements=(part,)) for part in problem.elements]
    assert {type(part) for part in problem.elements} == set(FORCE_KERNELS)
    return found


def test_derivatives_are_those_of_the_energies(every):
    _, problem, x = every
    rng, eps = np.random.default_rng(2), 1e-6
    for one in each(problem):
        d = rng.standard_normal(x.shape)
        d[one.pinned] = 0.0
        change = (potential(one, x + eps * d) - potential(one, x - eps * d)) / (2.0 * eps)
        assert change == pytest.approx((gradient(one, x) * d).sum(), rel=1e-6)
        stiffness = Stiffness(one)
        change = (gradient(one, x + eps * d) - gradient(one, x - eps * d)) / (2.0 * eps)
        found = stiffness.operator(x) @ d[stiffness.particles].ravel()
        np.testing.assert_allclose(found, change[stiffness.particles].ravel(),
                                   atol=1e-6 * np.abs(found).max())


def test_forces_by_hand_are_those_of_the_formulas(every):
    _, problem, x = every
    for (part,) in (one.elements for one in each(problem)):
        f = np.zeros_like(x)
        FORCE_KERNELS[type(part)](x, np.zeros_like(x), f, part.particles, *part.parameters)
        alone = Problem(x=x, mass=problem.mass, elements=(part,))
        expected = -gradient(alone, x)
        np.testing.assert_allclose(f, expected, atol=1e-13 * np.abs(expected).max())


def test_clamped_no_block_is_negative_and_bounds_hold(every):
    _, problem, x = every
    rng = np.random.default_rng(4)
    for one in each(problem):
        stiffness, (part,) = Stiffness(one), one.elements
        k = part.particles.shape[1]
        clamped = np.linalg.eigvalsh(part.blocks(x, clamp=True).transpose(0, 1, 3, 2, 4).reshape(
            -1, 3 * k, 3 * k))
        assert clamped.min() > -1e-10 * clamped.max()
        bound = np.bincount(part.particles.ravel(), part.bound(x).ravel(), len(x))
        largest = eigsh(stiffness.operator(x), k=1, v0=rng.standard_normal(3 * len(
            stiffness.free)), return_eigenvectors=False)
        assert abs(largest[0]) <= bound.max() * (1.0 + 1e-12)


def test_the_simulation_stores_the_same_energy(every):
    simulation, problem, x = every
    count = len(simulation.slot)
    by_slot = np.zeros_like(simulation.state.x)
    by_slot[:, simulation.slot] = x[:count].T
    expected = sum(built.constraints.energy(by_slot) for built in simulation.effects.values()
                   if built.constraints is not None)
    springs = sum(part.energy(x) for part in problem.elements if part.name == 'linearsums')
    assert springs > 0.0
    assert elastic(problem, x) - springs == pytest.approx(expected, rel=1e-12)
    assert len(x) == count + 4    # the places that the pin with a compliance pulls to


def test_forces_that_a_simulation_is_told_to_apply_are_known(every):
    simulation, problem, _ = every
    count = len(simulation.slot)
    np.testing.assert_allclose(problem.force[:count] / problem.mass[:count, None],
                               np.tile([1.0, -2.0, 0.5], (count, 1)))
    assert not problem.force[count:].any()


def test_gas_is_solved_for_exactly():
    """A step with the whole Hessian, and what is at rest without being pressed empty."""
    problem = problem_of(scene(8, ('pressure',)))
    problem = replace(problem, gravity=np.zeros(3), force=None)
    stiffness = Stiffness(problem)
    x = problem.x * 1.02
    factor = stiffness.factor(x, mass=100.0)
    assert factor.positive
    rng = np.random.default_rng(3)
    right = rng.standard_normal(problem.x.shape)
    right[problem.pinned] = 0.0
    step = stiffness.solve(factor, right)
    rows = stiffness.particles
    mass = np.repeat(problem.mass[rows], 3)
    z = step[rows].ravel()
    np.testing.assert_allclose(stiffness.operator(x) @ z + 100.0 * mass * z, right[rows].ravel(),
                               atol=1e-9)
    rest = equilibrium(problem, x=x)
    gas = next(part for part in problem.elements if part.name == 'gas')
    assert gas.pressure(rest) < -1.0
    assert np.abs(gradient(problem, rest)[~problem.pinned]).max() < 1e-9


def test_a_sum_is_positive_if_all_of_its_eigenvalues_are():
    """The sum is S + U A⁻¹ Uᵀ; S alone may be indefinite."""
    rng, seen = np.random.default_rng(4), set()
    for _ in range(40):
        S = np.diag(rng.uniform(-1.0, 4.0, 6)) + 0.3 * np.ones((6, 6))
        U, a = rng.standard_normal((6, 2)), rng.uniform(0.1, 1.0, 2)
        whole = np.linalg.eigvalsh(S + U / a @ U.T).min() > 0.0
        assert Factor(sparse.csc_matrix(S), U, a).positive == whole
        seen.add((whole, bool(np.linalg.eigvalsh(S).min() > 0.0)))
    assert seen == {(True, True), (True, False), (False, False)}


def test_both_methods_agree_on_every_effect(every):
    _, problem, _ = every
    exact = limit(problem, 0.05, 1e-7)
    assert exact.uncertainty <= 1e-7
    errors = [exact.error(newton(problem, 0.05 / n, n, integrator='bdf2')[0])
              for n in (48, 96)]
    assert errors[1] < 1e-3
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.15)


def test_simulation_converges_to_the_reference_on_a_membrane():
    """As V29 has it for all of them."""
    exact, errors = None, []
    for substeps in (16, 32):
        simulation = scene(substeps, ('membrane',))
        exact = exact or limit(problem_of(simulation), FRAMES * simulation.frame_dt, 1e-9)
        for _ in range(FRAMES):
            frame = simulation.step()
        errors.append(rms(frame.x - exact.x))
    assert errors[1] < 2e-6
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
