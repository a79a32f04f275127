"""
Compensated summation of the moves of projections (Kahan 1965), for float32 with short substeps.

A particle is moved some ten times in a substep, and each sum x + Δx is rounded to the last bit of
x. The velocity is the sum of all Δx over H, so their errors are noise of v that grows as N^(3/2)
with N substeps per second. The sum of the errors is therefore kept, and added to the difference of
positions from which v is computed (``integration.velocity``).

x + Δx - x is exact (Sterbenz), and with it the error. What inequalities move is not compensated,
but seams are.
"""

from typing import NamedTuple

from numba import types
import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import fma, load, store
from xpbd_ros.sim.backend.simd_records import load_records, store_records
from xpbd_ros.sim.backend.simd_vector3 import fma3, vector3
from xpbd_ros.sim.particles.memory_layout import zeros


class Rounding(NamedTuple):
    """Moves of this substep's projections, less what x took up of them."""

    move: np.ndarray
    """[m], shape (3, slots)"""
    records: np.ndarray
    """those of a sweep over mesh constraints [m], as records, shape (slots, 4)"""


def new_rounding(slots: int, dtype) -> Rounding:
    """Return zeros."""
    return Rounding(zeros((3, slots), dtype), zeros((slots, 4), dtype))


def store_moved(x, errors, i, xi, step, d):
    """
    Store x = xi + step d from index i on; add the rounding error to ``errors`` unless it is None.

    ``errors`` is a row of ``Rounding.move``.
    """


def store_sum(x, errors, i, xi, move):
    """Store x = xi + move from index i on, likewise."""


def store_moved_records(records, errors, index, c, x, step, d, m):
    """Store x + step d, given as Vector3, in the records index[c:], likewise."""


@jit
def add_move(x, rounding, k, i, move):
    """x[k, i] += move; add the rounding error to ``rounding`` unless it is None."""
    start = x[k, i]
    x[k, i] = start + move
    if rounding is not None:
        rounding.move[k, i] += move + (start - x[k, i])


@jit
def error_of(rounding, k, i):
    """Return the accumulated rounding error of x[k, i] [m]; 0 without compensation."""
    return 0.0 if rounding is None else rounding.move[k, i]


def clear(errors, i):
    """Set a row of ``Rounding.move`` to zero from index i on."""


def with_errors(move, errors, i):
    """Return the vector ``move`` plus its rounding errors, a row from index i on."""


@inline(store_moved)
def _store_moved(x, errors, i, xi, step, d):
    if isinstance(errors, types.NoneType):
        return lambda x, errors, i, xi, step, d: store(x, i, fma(step, d, xi))

    def compensated(x, errors, i, xi, step, d):
        moved = fma(step, d, xi)
        store(x, i, moved)
        store(errors, i, load(errors, i) + fma(step, d, xi - moved))
    return compensated


@inline(store_sum)
def _store_sum(x, errors, i, xi, move):
    if isinstance(errors, types.NoneType):
        return lambda x, errors, i, xi, move: store(x, i, xi + move)

    def compensated(x, errors, i, xi, move):
        moved = xi + move
        store(x, i, moved)
        store(errors, i, load(errors, i) + (move + (xi - moved)))
    return compensated


@inline(store_moved_records)
def _store_moved_records(records, errors, index, c, x, step, d, m):
    if isinstance(errors, types.NoneType):
        def plain(records, errors, index, c, x, step, d, m):
            moved = fma3(step, d, x)
            store_records(records, index, c, moved.x, moved.y, moved.z, m)
        return plain

    def compensated(records, errors, index, c, x, step, d, m):
        moved = fma3(step, d, x)
        store_records(records, index, c, moved.x, moved.y, moved.z, m)
        ex, ey, ez, em = load_records(errors, index, c)
        error = fma3(step, d, x - moved) + vector3(ex, ey, ez)
        store_records(errors, index, c, error.x, error.y, error.z, em)
    return compensated


@inline(clear)
def _clear(errors, i):
    if isinstance(errors, types.NoneType):
        return lambda errors, i: None
    return lambda errors, i: store(errors, i, 0.0)


@inline(with_errors)
def _with_errors(move, errors, i):
    if isinstance(errors, types.NoneType):
        return lambda move, errors, i: move
    return lambda move, errors, i: move + load(errors, i)
