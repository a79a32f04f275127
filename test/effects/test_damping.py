"""Damping: exact decay, at any substep, and gravity in full."""

import numpy as np
import pytest
from sim.small import GRAVITY, run, simulate


def falling(rate, substeps, gravity=-GRAVITY):
    """Return a particle that only damping acts on."""
    return simulate((1, 1), gravity=(0, 0, gravity), substeps=substeps,
                    scene_effects={'damping': {'rate': rate}})


@pytest.mark.parametrize('substeps', [1, 7])
def test_velocity_decays_as_the_exponential_whatever_the_substep(substeps):
    simulation = falling(1.7, substeps, 0.0)
    simulation.state.v[:] = (1.0, -2.0, 3.0)
    frame = run(simulation, 60)
    np.testing.assert_allclose(frame.v[0], np.exp(-1.7) * np.array([1.0, -2.0, 3.0]), rtol=1e-11)


@pytest.mark.parametrize('substeps', [1, 7])
def test_gravity_acts_in_full_on_what_is_damped(substeps):
    """A fall from rest begins with g, and v ← v exp(-rate h) - g h from there on."""
    rate, simulation = 3.0, falling(3.0, substeps)
    h, v = simulation.frame_dt / substeps, 0.0
    for _ in range(30):
        frame = simulation.step()
        for _ in range(substeps):
            v = v * np.exp(-rate * h) - GRAVITY * h
        assert frame.v[0, 2] == pytest.approx(v, rel=1e-11)
    assert frame.v[0, 2] > -GRAVITY / rate * 1.1


@pytest.mark.parametrize('rate', [0.0, 1e300])
def test_the_extremes_of_the_rate(rate):
    simulation = falling(rate, 2, 0.0)
    simulation.state.v[:] = 1.0
    frame = run(simulation, 3)
    assert simulation.effects['damping'].data.factor[0] == (1.0 if rate == 0.0 else
                                                            pytest.approx(0.0, abs=1e-300))
    assert frame.v[0, 0] == pytest.approx(1.0 if rate == 0.0 else 0.0, rel=1e-12)


def test_what_is_pinned_is_not_damped():
    simulation = simulate((1, 1), scene_effects={'damping': {'rate': 50.0}}, substeps=4, pins={
        'a': {'cloth': 'c', 'at': [0], 'motion': [[0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]]}})
    np.testing.assert_allclose(run(simulation, 10).v[0], [1.0, 0.0, 0.0], rtol=1e-6, atol=1e-12)
