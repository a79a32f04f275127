"""
Particles as records (x, y, z, mobility), which mesh constraints load and store by index.

A particle scattered over four arrays costs four gathers; a record is one short load. As many
records as a vector has lanes are transposed in registers into vectors x, y, z, m, in blocks of
four by four: any other order takes twice the shuffles.
"""

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lanes, load, splat, store
from xpbd_ros.sim.backend.simd_records import FIELDS, load_row, store_row
from xpbd_ros.sim.backend.threads import turns, wait
from xpbd_ros.sim.particles.memory_layout import zeros


def new_records(slots: int, dtype) -> np.ndarray:
    """Return zeroed records for all slots, shape (slots, 4)."""
    return zeros((slots, FIELDS), dtype)


@jit
def to_records(state, records, first, last):
    """Copy positions and mobilities of the slots first:last, rounded up to whole vectors."""
    x, y, z, m = state.x[0], state.x[1], state.x[2], state.mobility
    for i in range(first, last, lanes(m)):
        store_row(records, i, load(x, i), load(y, i), load(z, i), load(m, i))
    _zero(state.apart, first, last + lanes(m))    # covers the whole vectors of ``_back``


@jit
def _collect(rounding, first, last):
    """Move the rounding errors of a sweep from their records to ``rounding.move``."""
    if rounding is not None:
        _add(rounding.move, rounding.records, first, last)
        rounding.records[first:last + lanes(rounding.records)] = 0.0


@jit
def _add(move, records, first, last):
    """Add records to the displacements of the slots first:last, rounded up to whole vectors."""
    x, y, z = move[0], move[1], move[2]
    for i in range(first, last, lanes(records)):
        xi, yi, zi, _ = load_row(records, i)
        store(x, i, load(x, i) + xi)
        store(y, i, load(y, i) + yi)
        store(z, i, load(z, i) + zi)


@jit
def _zero(apart, first, last):    # Numba prunes a branch on None where that is an argument
    if apart is not None:
        apart.records[first:last] = 0.0


@jit
def to_positions(state, records, first, last):
    """Copy positions from records to x, with any method."""
    _back(state, None, records, first, last)


@jit
def from_records(state, records, first, last):
    """Copy positions from records to x, or add accumulated displacements to ``apart.move``."""
    _back(state, state.apart, records, first, last)


@jit
def _back(state, apart, records, first, last):
    if apart is None:
        x, y, z = state.x[0], state.x[1], state.x[2]
        for i in range(first, last, lanes(records)):
            xi, yi, zi, _ = load_row(records, i)
            store(x, i, xi)
            store(y, i, yi)
            store(z, i, zi)
        _collect(state.rounding, first, last)
    else:
        _add(apart.move, apart.records, first, last)


@jit
def shared_to_records(state, records, first, last):
    """Do the same as ``to_records``, on all threads."""
    x, y, z, m = state.x[0], state.x[1], state.x[2], state.mobility
    step = lanes(m)
    left, right, over = turns(state.team, (last - first + step - 1) // step)
    for k in range(left, right, over):
        i = first + k * step
        store_row(records, i, load(x, i), load(y, i), load(z, i), load(m, i))
        _zero_row(state.apart, i)
    wait(state.team)


@jit
def shared_from_records(state, records, first, last):
    """Do the same as ``from_records``, on all threads."""
    step = lanes(state.mobility)
    left, right, over = turns(state.team, (last - first + step - 1) // step)
    for k in range(left, right, over):
        _row_back(state, state.apart, records, first + k * step)
    wait(state.team)


@jit
def _row_back(state, apart, records, i):
    if apart is None:
        x, y, z, _ = load_row(records, i)
        store(state.x[0], i, x)
        store(state.x[1], i, y)
        store(state.x[2], i, z)
        _collect_row(state.rounding, i)
    else:
        _add(apart.move, apart.records, i, i + 1)


@jit
def _collect_row(rounding, i):
    if rounding is not None:
        _add(rounding.move, rounding.records, i, i + 1)
        _clear_row(rounding.records, i)


@jit
def _zero_row(apart, i):
    if apart is not None:
        _clear_row(apart.records, i)


@jit
def _clear_row(records, i):
    zero = splat(records, 0.0)
    store_row(records, i, zero, zero, zero, zero)
