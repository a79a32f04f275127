"""Numbers too small to matter are 0 while a frame is computed, and only then."""

import numpy as np
import pytest

from support.scenes import with_effects
from xpbd_ros.sim.backend.denormals import flush_denormals, ON_X86, restore_mode
from xpbd_ros.sim.backend.jit import jit

TINY = 2.0**-1030


@jit(cache_name='denormals')
def halves(numbers, flush):
    """Halve twice and double twice."""
    mode = flush_denormals() if flush else np.uint32(0)
    for i in range(len(numbers)):
        numbers[i] *= 0.5
        numbers[i] *= 4.0
        numbers[i] *= 0.5
    if flush:
        restore_mode(mode)


@pytest.mark.skipif(not ON_X86, reason='only x86 has a flush-to-zero mode (MXCSR)')
def test_they_are_flushed_within_and_not_after():
    for flush, kept in ((True, 0.0), (False, TINY)):
        numbers = np.full(100, TINY)
        halves(numbers, flush)
        np.testing.assert_array_equal(numbers, kept)
    assert TINY * 0.5 > 0.0
    assert (np.array([TINY]) * 0.5)[0] > 0.0


@pytest.mark.skipif(not ON_X86, reason='only x86 has a flush-to-zero mode (MXCSR)')
def test_a_sway_that_has_died_away_is_gone_from_the_state():
    simulation = with_effects(gravity=(0, 0, 0))
    simulation.state.x[2, simulation.slot] = TINY * np.arange(30)
    simulation.state.v[2, simulation.slot] = TINY
    simulation.step()
    np.testing.assert_array_equal(simulation.state.v[2], 0.0)
