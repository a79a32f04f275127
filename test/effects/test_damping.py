"""Damping: decay at the integrator's own order, gravity in full, and an exact terminal speed."""

import numpy as np
import pytest

from support.scenes import GRAVITY, hang, run, run_until_still, simulate

INTEGRATORS = pytest.mark.parametrize('integrator', ['backward_euler', 'bdf2', 'leapfrog'])


def falling(rate, substeps, gravity=-GRAVITY, integrator='backward_euler', **options):
    """Return a particle that only damping acts on."""
    return simulate((1, 1), gravity=(0, 0, gravity), substeps=substeps,
                    scene_effects={'pin': {}, 'damping': {'rate': rate}}, integrator=integrator,
                    method='explicit' if integrator == 'leapfrog' else 'gauss_seidel', **options)


def throw(simulation, velocity):
    """Give the particle a velocity."""
    simulation.state.v[:, simulation.slot] = np.array(velocity)[:, None]


@pytest.mark.parametrize('substeps', [1, 7])
def test_velocity_falls_by_the_implicit_step_in_every_substep(substeps):
    simulation = falling(1.7, substeps, 0.0)
    throw(simulation, (1.0, -2.0, 3.0))
    frame = run(simulation, 60)
    share = (1.0 + 1.7 / (60 * substeps))**(-60 * substeps)
    np.testing.assert_allclose(frame.v[0], share * np.array([1.0, -2.0, 3.0]), rtol=1e-11)


@pytest.mark.parametrize('integrator, order', [
    ('backward_euler', 1.0), ('bdf2', 2.0), ('leapfrog', 2.0)])
def test_velocity_decay_converges_at_the_integrators_order(integrator, order):
    errors = []
    for substeps in (2, 4, 8, 16):
        simulation = falling(1.7, substeps, 0.0, integrator=integrator)
        throw(simulation, (1.0, -2.0, 3.0))
        v = run(simulation, 60).v[0]
        np.testing.assert_allclose(v / v[0], [1.0, -2.0, 3.0], rtol=1e-10)
        errors.append(abs(v[0] - np.exp(-1.7)))
    np.testing.assert_allclose(np.log2(errors[:-1]) - np.log2(errors[1:]), order, atol=0.05)


@pytest.mark.parametrize('substeps', [1, 7])
def test_gravity_acts_in_full_on_what_is_damped(substeps):
    """A fall from rest begins with g, and v ← (v - g h) / (1 + rate h) from there on."""
    rate, simulation = 3.0, falling(3.0, substeps)
    h, v = simulation.frame_dt / substeps, 0.0
    for _ in range(30):
        frame = simulation.step()
        for _ in range(substeps):
            v = (v - GRAVITY * h) / (1.0 + rate * h)
        assert frame.v[0, 2] == pytest.approx(v, rel=1e-11)
    assert frame.v[0, 2] > -GRAVITY / rate


@INTEGRATORS
@pytest.mark.parametrize('substeps', [1, 7])
def test_the_terminal_speed_is_g_over_the_rate(integrator, substeps):
    simulation = falling(5.0, substeps, integrator=integrator)
    assert run(simulation, 600).v[0, 2] == pytest.approx(-GRAVITY / 5.0, rel=1e-10)


def test_the_leapfrog_loses_rate_times_momentum_in_every_frame():
    """Δv = g Δt - rate Δx to rounding, whatever the substeps and the rate."""
    for rate, substeps in ((3.0, 1), (3.0, 7), (80.0, 1), (200.0, 1), (200.0, 2)):
        simulation = falling(rate, substeps, integrator='leapfrog')
        x, v = np.zeros(3), np.zeros(3)
        for _ in range(10):
            frame = simulation.step()
            lost = -GRAVITY * simulation.frame_dt - (frame.v[0, 2] - v[2])
            assert lost == pytest.approx(rate * (frame.x[0, 2] - x[2]), abs=1e-12)
            x, v = frame.x[0].copy(), frame.v[0].copy()


def test_constraints_may_move_what_is_damped_by_less():
    """
    The mobility is w h² / (1 + h rate): seen in what one pass leaves undone.

    Two edges, the upper one first: C = α T_1 - A_12 T_2, with A_12 = -mobility
    (doc/numerics.md 4.1).
    """
    rate, alpha = 40.0, 1e-3
    simulation = hang(3, damping=rate, effects={'stretch': {'compliance': alpha}})
    x, h = run_until_still(simulation, speed=1e-11).x[:, 2], simulation.frame_dt
    mass = simulation.state.mass[simulation.slot]
    upper, lower = (mass[1] + mass[2]) * GRAVITY, mass[2] * GRAVITY
    extra = (x[:-1] - x[1:] - 0.5) - alpha * np.array([upper, lower])
    mobility = h**2 / (1.0 + h * rate) / mass[1]
    assert sorted(extra) == pytest.approx(
        [0.0, mobility * lower], abs=1e-9) or sorted(extra) == pytest.approx(
        [0.0, mobility * upper], abs=1e-9)


@INTEGRATORS
@pytest.mark.parametrize('rate', [0.0, 1e300])
def test_the_extremes_of_the_rate(integrator, rate):
    simulation = falling(rate, 2, 0.0, integrator=integrator)
    throw(simulation, (1.0, 1.0, 1.0))
    frame = run(simulation, 3)
    assert simulation.effects['damping'].data.rate[0] == rate
    assert frame.v[0, 0] == pytest.approx(1.0 if rate == 0.0 else 0.0, rel=1e-12)


@pytest.mark.parametrize('integrator', ['backward_euler', 'bdf2'])
def test_what_is_pinned_is_not_damped(integrator):
    simulation = simulate((1, 1), scene_effects={'damping': {'rate': 50.0}}, substeps=4, pins={
        'a': {'cloth': 'c', 'at': [0], 'motion': [[0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]]}},
        integrator=integrator)
    np.testing.assert_allclose(run(simulation, 10).v[0], [1.0, 0.0, 0.0], rtol=1e-6, atol=1e-12)
