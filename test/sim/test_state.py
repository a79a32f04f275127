"""Free fall: what the integrator does to a particle that nothing holds."""

import numpy as np
import pytest

from support.scenes import GRAVITY, run, simulate

STRETCH = {'stretch': {'compliance': 1e-3}}


@pytest.mark.parametrize('substeps', [1, 7])
def test_free_fall_is_the_recurrence_of_backward_euler(substeps):
    """V1: z = -½ g h² n (n + 1) after n substeps, at any iteration count, for any mass."""
    simulation = simulate((4, 3), effects=STRETCH, substeps=substeps, iterations=3)
    start = simulation.frame().x
    frame = run(simulation, 30)
    n, h = 30 * substeps, simulation.frame_dt / substeps
    np.testing.assert_allclose(frame.x[:, 2], -0.5 * GRAVITY * h**2 * n * (n + 1), rtol=1e-12)
    np.testing.assert_allclose(frame.v[:, 2], -GRAVITY * h * n, rtol=1e-11)
    np.testing.assert_allclose(frame.x[:, :2], start[:, :2], atol=1e-12)


def test_free_fall_is_first_order():
    """V1: the error of the height is ½ g T h."""
    for substeps in (1, 2, 4):
        simulation = simulate((1, 1), effects=STRETCH, substeps=substeps)
        error = run(simulation, 60).x[0, 2] + 0.5 * GRAVITY
        assert error == pytest.approx(-0.5 * GRAVITY / (60 * substeps), rel=1e-9)


def test_without_gravity_velocity_stays():
    simulation = simulate((1, 1), effects=STRETCH, gravity=(0, 0, 0), substeps=3)
    simulation.state.v[:, simulation.slot] = [[0.3], [-0.2], [0.1]]
    frame = run(simulation, 60)
    np.testing.assert_allclose(frame.x[0], (0.3, -0.2, 0.1), rtol=1e-12)
    np.testing.assert_allclose(frame.v[0], (0.3, -0.2, 0.1), rtol=1e-12)
