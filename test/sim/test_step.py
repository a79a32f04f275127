"""The substep loop: what it converges to, how fast, and what it costs."""

import tracemalloc

from numba.core.runtime import _nrt_python, rtsys
import numpy as np
import pytest

from support.scenes import (
    edge_forces,
    GRAVITY,
    hang,
    numbers,
    run,
    run_until_still,
    simulate,
    with_effects,
)

SETTINGS = [(1, 1), (1, 20), (5, 20), (20, 10)]


@pytest.mark.smoke
@pytest.mark.parametrize('substeps, iterations', SETTINGS)
@pytest.mark.parametrize('compliance', [1e-2, 1e-6])
def test_a_hanging_mass_stretches_m_g_alpha_at_every_setting(substeps, iterations, compliance):
    simulation = hang(effects={'stretch': {'compliance': compliance}}, substeps=substeps,
                      iterations=iterations)
    frame = run_until_still(simulation)
    stretch = simulation.state.mass[simulation.slot[1]] * GRAVITY * compliance
    np.testing.assert_allclose(frame.x[1], [0.0, 0.0, -1.0 - stretch], rtol=0.0,
                               atol=1e-6 * stretch)


@pytest.mark.parametrize('n', [2, 5, 12])
def test_a_hanging_strip_stretches_as_the_continuum(n):
    """V6: ΔL = ρ g L² / (2 Y) with any number of particles, because the rim has half the mass."""
    density, modulus, length = 0.2, 10.0, 1.5
    simulation = hang(n, length=length, damping=20.0, density=density, substeps=16, iterations=20,
                      effects={'stretch': {'warp': modulus, 'weft': 1.0}})
    frame = run_until_still(simulation, speed=1e-11)
    assert -frame.x[-1, 2] - length == pytest.approx(
        density * GRAVITY * length**2 / (2.0 * modulus), rel=1e-9)
    edge = numbers(simulation, simulation.effects['stretch'].constraints.particles).min(1)
    weight = density * length / (n - 1) * GRAVITY
    np.testing.assert_allclose(-edge_forces(simulation, 'stretch'), weight * (n - 1.5 - edge),
                               rtol=1e-8)


def test_one_iteration_adds_the_compliance_of_later_edges():
    """
    V7: C_j = α T_j - Σ A_jk T_k over the k after j, with A = J M Jᵀ, in rest.

    M holds the mobilities w h² / (1 + h rate): damping is implicit too.
    """
    n, substeps, alpha, rate = 12, 4, 1e-2, 30.0
    simulation = hang(n, damping=rate, substeps=substeps, effects={
        'stretch': {'compliance': alpha}})
    frame = run_until_still(simulation, speed=1e-11)
    edges = simulation.effects['stretch'].constraints
    i, j = numbers(simulation, edges.particles).T
    tension = -edge_forces(simulation, 'stretch')
    span = frame.x[i] - frame.x[j]
    distance = np.linalg.norm(span, axis=1)
    jacobian = np.zeros((n - 1, n, 3))
    rows = np.arange(n - 1)
    jacobian[rows, i] = span / distance[:, None]
    jacobian[rows, j] = -span / distance[:, None]
    a = np.einsum('cik,i,dik->cd', jacobian, frame.inv_mass, jacobian)
    h = simulation.frame_dt / substeps
    expected = alpha * tension - h**2 / (1.0 + h * rate) * np.triu(a, 1) @ tension
    np.testing.assert_allclose(distance - edges.rest_length, expected, rtol=1e-9)
    assert (expected / (alpha * tension)).max() > 1.01    # the artefact is there to be seen


@pytest.mark.parametrize('rate, amplitude, frequency', [
    (60, 0.884652, 0.920317), (240, 0.991431, 0.994273)])
def test_an_oscillator_has_the_damping_of_backward_euler(rate, amplitude, frequency):
    """V2, m = 1 kg, α = 1e-3 m/N, L = 1 m, from 1.5 m: |z| = 1/√(1+s²), ω'/ω = atan(s)/s."""
    simulation = hang(damping=0.0, gravity=(0, 0, 0), density=2.0, rate=rate,
                      effects={'stretch': {'compliance': 1e-3}})
    simulation.state.x[:, simulation.slot[1]] = (0.0, 0.0, -1.5)
    stretch = np.array([-1.0 - run(simulation, 1).x[1, 2] for _ in range(30)])
    (a, b), *_ = np.linalg.lstsq(np.column_stack([stretch[1:-1], stretch[:-2]]), stretch[2:])
    ratio = np.sqrt(-b)    # roots r exp(±iφ) of z² = a z + b
    angle = np.arccos(a / (2.0 * ratio))
    s = np.sqrt(1.0 / (1.0 * 1e-3)) / rate
    assert ratio == pytest.approx(1.0 / np.sqrt(1.0 + s * s), rel=1e-8)
    assert angle / s == pytest.approx(np.arctan(s) / s, rel=1e-8)
    assert ratio == pytest.approx(amplitude, abs=1e-6)
    assert angle / s == pytest.approx(frequency, abs=1e-6)


@pytest.mark.parametrize('rate, kept', [(60, 0.658), (240, 0.8676), (960, 0.9613)])
def test_a_spinning_pair_loses_momentum_as_backward_euler(rate, kept):
    """V4, 1 rev/s for 1 s; each step φ' = atan(sin φ / (2 - cos φ)) and L = m r² sin φ / h."""
    omega, radius = 2.0 * np.pi, 0.5
    simulation = simulate((2, 1), effects={'stretch': {'compliance': 0.0}}, gravity=(0, 0, 0),
                          rate=rate)
    simulation.state.v[1, simulation.slot] = (-omega * radius, omega * radius)
    phi = np.arctan(omega / rate)
    for _ in range(rate):
        frame = simulation.step()
        arm = frame.x[1] - frame.x[0]
        momentum = 0.5 * np.cross(arm, frame.v[1] - frame.v[0])[2]
        assert momentum == pytest.approx(2.0 * radius**2 * np.sin(phi) * rate, rel=1e-9)
        phi = np.arctan2(np.sin(phi), 2.0 - np.cos(phi))
    assert momentum / (2.0 * radius**2 * omega) == pytest.approx(kept, abs=0.01)


def swing(substeps, iterations):
    """Return where a soft strip let go from the horizontal is after a quarter of a second."""
    simulation = simulate(
        (5, 1), effects={'stretch': {'compliance': 2e-3}}, substeps=substeps,
        iterations=iterations, pins={'a': {'cloth': 'c', 'at': 'corner_00'}},
        scene_effects={'damping': {'rate': 0.5}})
    return run(simulation, 15).x.copy()


def test_the_error_halves_with_twice_the_substeps():
    exact = 2.0 * swing(8192, 1) - swing(4096, 1)
    errors = [np.abs(swing(n, 1) - exact).max() for n in (128, 256, 512, 1024)]
    slopes = np.log2(errors[:-1]) - np.log2(errors[1:])
    np.testing.assert_allclose(slopes, 1.0, atol=0.01)


def test_iterations_converge_at_a_fixed_substep():
    exact = swing(4, 100)
    errors = [np.abs(swing(4, k) - exact).max() for k in (1, 2, 4, 8)]
    assert errors[0] > 1e-4
    assert all(after < 0.1 * before for before, after in zip(errors, errors[1:-1]))
    assert errors[-1] < 1e-14


def native_allocations(simulation):
    """Return how many blocks the compiled step asks for in one frame."""
    before = rtsys.get_allocation_stats()
    simulation._step(simulation._tuple, simulation.state, simulation._method(),
                     simulation.frame_dt, simulation.solver.substeps)
    after = rtsys.get_allocation_stats()
    assert after.alloc - before.alloc == after.free - before.free
    return after.mi_alloc - before.mi_alloc


def test_a_substep_allocates_nothing():
    """The count is that of the arguments' wrappers, whatever the substeps and iterations."""
    few = with_effects((40, 41), substeps=1, iterations=1)
    many = with_effects((40, 41), substeps=9, iterations=3)
    few.step()
    many.step()
    assert many.stats()['contacts'] > 1000
    _nrt_python.memsys_enable_stats()
    try:
        assert native_allocations(few) == native_allocations(many)
    finally:
        _nrt_python.memsys_disable_stats()


def test_a_step_allocates_no_array_of_the_size_of_the_state(monkeypatch):
    """All but the frame that it hands out, which is a copy."""
    simulation = with_effects((80, 81), substeps=3)
    frame = simulation.frame()
    monkeypatch.setattr(simulation, 'frame', lambda *_: frame)
    tracemalloc.start()
    try:
        run(simulation, 30)
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        run(simulation, 5)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak - before < simulation.state.mass.nbytes


def test_a_frame_that_is_let_go_leaves_nothing_behind():
    simulation = with_effects((80, 81), substeps=3)
    tracemalloc.start()
    try:
        run(simulation, 100)    # until Python keeps as many small numbers as it will
        before, _ = tracemalloc.get_traced_memory()
        run(simulation, 20)
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < simulation.state.mass.nbytes
