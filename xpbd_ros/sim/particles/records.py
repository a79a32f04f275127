"""
Particles as records (x, y, z, mobility), which mesh constraints load and store by index.

A particle scattered over four arrays costs four gathers; a record is one short load. As many
records as a vector has lanes are transposed in registers into vectors x, y, z, m, in blocks of
four by four: any other order takes twice the shuffles.
"""

from numba import types
import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import fma, lanes, load, store
from xpbd_ros.sim.backend.simd_records import (
    _FIELDS,
    load_records,
    load_row,
    store_records,
    store_row,
)
from xpbd_ros.sim.particles.memory_layout import zeros


def new_records(slots: int, dtype) -> np.ndarray:
    """Return zeroed records for all slots, shape (slots, 4)."""
    return zeros((slots, _FIELDS), dtype)


def put_records(records, apart, index, start, x, y, z, m, step, dx, dy, dz):
    """
    Store x + step dx of a vector of particles, or add step dx to the accumulator.

    Parameters
    ----------
    records : shape (slots, 4)
    apart : accumulator (``particles.accumulators``) or None
    index, start : the particles are index[start:start + lanes]
    x, y, z, m : vectors of their positions [m] and mobilities [m/N]
    step : multiplier step
    dx, dy, dz : vectors of displacement per unit of step

    """


@inline(put_records)
def _put_records(records, apart, index, start, x, y, z, m, step, dx, dy, dz):
    if isinstance(apart, types.NoneType):
        def put(records, apart, index, start, x, y, z, m, step, dx, dy, dz):
            store_records(records, index, start, fma(step, dx, x), fma(step, dy, y),
                          fma(step, dz, z), m)
        return put

    def add(records, apart, index, start, x, y, z, m, step, dx, dy, dz):
        sx, sy, sz, rest = load_records(apart.records, index, start)
        store_records(apart.records, index, start, fma(step, dx, sx), fma(step, dy, sy),
                      fma(step, dz, sz), rest)
    return add


@jit
def to_records(state, records, first, last):
    """Copy positions and mobilities of the slots first:last, rounded up to whole vectors."""
    x, y, z, m = state.x[0], state.x[1], state.x[2], state.mobility
    for i in range(first, last, lanes(m)):
        store_row(records, i, load(x, i), load(y, i), load(z, i), load(m, i))
    _zero(state.apart, first, last + lanes(m))    # covers the whole vectors of ``_back``


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
    else:
        x, y, z = apart.move[0], apart.move[1], apart.move[2]
        for i in range(first, last, lanes(records)):
            xi, yi, zi, _ = load_row(apart.records, i)
            store(x, i, load(x, i) + xi)
            store(y, i, load(y, i) + yi)
            store(z, i, load(z, i) + zi)
