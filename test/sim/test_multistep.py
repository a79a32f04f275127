"""What NDF2 makes of motion that no substep resolves."""

import numpy as np
import pytest

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lanes
from xpbd_ros.sim.particles.history import FULL, HALF, History, NONE, REACH, with_order_reduction
from xpbd_ros.sim.particles.memory_layout import zeros

H, GAP = 0.1, 0.5


@jit(cache_name='test')
def steady(history, now, last, older, gap, h):
    """Steady all particles."""
    for q in range(0, len(gap), lanes(gap)):
        with_order_reduction(history, now, (last, older), gap, q, h)


def freshness(before: float, *velocities) -> float:
    """Return what ``fresh`` becomes after these velocities, older ones first."""
    fresh, gap = zeros(16, np.float64), zeros(16, np.float64)
    fresh[:], gap[:] = before, GAP
    older, last, now = (zeros((3, 16), np.float64) for _ in range(3))
    for array, v in zip((older, last, now), velocities):
        array[:] = np.reshape(v, (3, 1))
    steady(History(now, now, last, last, fresh, np.zeros(1)), now, last, older, gap, H)
    assert (fresh == fresh[0]).all()
    return fresh[0]


FAR = 1.01 * REACH * GAP / H


@pytest.mark.parametrize('size', [FAR, 100.0 * FAR])
def test_what_goes_to_and_fro_takes_bdf2(size):
    """Its velocities are a, b, -a, with |b| > |a|."""
    half, more = np.array([0.5 * size, 0.0, 0.0]), np.array([-0.6 * size, 0.0, 0.0])
    assert freshness(FULL, half, more, -half) == HALF
    assert freshness(NONE, half, more, -half) == NONE, 'it had no history anyway'


def test_what_turns_smoothly_or_goes_on_does_not():
    a = np.array([FAR, 0.0, 0.0])
    assert freshness(FULL, -a, 0.4 * a, a) == FULL, 'it turns back, and that is all'
    assert freshness(FULL, 9.0 * a, 7.0 * a, 9.0 * a) == FULL, 'it goes on'
    assert freshness(FULL, 0.49 * a, -0.6 * a, -0.49 * a) == FULL, 'it does not go far'
    assert freshness(FULL, np.zeros(3), np.zeros(3), np.zeros(3)) == FULL
    assert freshness(FULL, a, np.full(3, np.nan), -a) == FULL
