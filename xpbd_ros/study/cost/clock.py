"""
A clock that a step reads after each part (``stages.lap``): the same kernels, and the same bits.

So an effect is timed inside the running scene, with the caches as the others leave them.
"""

import ctypes
from typing import NamedTuple

from numba import njit
import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.stepping.stages import lap, stage

MONOTONIC = 1
"""CLOCK_MONOTONIC of Linux"""

_read = ctypes.CDLL(None).clock_gettime
_read.argtypes = [ctypes.c_int, ctypes.c_void_p]
_read.restype = ctypes.c_int


class Clock(NamedTuple):
    """Times by row."""

    book: np.ndarray
    """nanoseconds and readings of each row, shape (rows, 2)"""
    last: np.ndarray
    """seconds and nanoseconds at the last reading, shape (2,)"""
    now: np.ndarray
    """the same at this one"""


def new_clock(rows: int) -> Clock:
    """Return a clock with a row for each effect's part, and one for the integration."""
    return Clock(np.zeros((rows, 2), np.int64), np.zeros(2, np.int64), np.zeros(2, np.int64))


@jit(cache_name=None)
def start(clock):
    """Read the clock for the first time."""
    clock.book[:] = 0
    _read(MONOTONIC, clock.last.ctypes.data)


@stage(lap, Clock)
@jit(cache_name=None)
def add_lap(clock, row):
    """Add the time since the last reading to one row."""
    now, last = clock.now, clock.last
    _read(MONOTONIC, now.ctypes.data)
    clock.book[row, 0] += (now[0] - last[0]) * 1_000_000_000 + now[1] - last[1]
    clock.book[row, 1] += 1
    last[0], last[1] = now[0], now[1]


@njit
def _laps(clock, count):
    start(clock)
    for _ in range(count):
        add_lap(clock, 0)


def lap_ns(count: int = 20_000) -> float:
    """Return what one reading costs by itself [ns]: the least of some rounds."""
    found, clock = [], new_clock(1)
    for _ in range(7):
        _laps(clock, count)
        found.append(clock.book[0, 0] / count)
    return min(found)
