"""
Particles as records x y z m: what a constraint on any mesh loads and stores by index.

A particle scattered over four arrays costs four gathers; a record is one short load, and as many
of them as a vector has lanes are transposed in registers into vectors of x, y, z and m, four by
four of them: any other order takes a processor twice the shuffles.
"""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic
import numpy as np

from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.layout import zeros
from xpbd_ros.sim.update import inline
from xpbd_ros.sim.vector import exchange, fma, lanes, load, place, store, vector_of

PACK = 16
"""constraints that share no particle, side by side: the lanes of the widest vector there is"""
_FIELDS = 4


def new_records(slots: int, dtype) -> np.ndarray:
    """Return records for all slots, shape (slots, 4)."""
    return zeros((slots, _FIELDS), dtype)


def _constants(numbers):
    return ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), list(numbers))


def _record(context, builder, signature, arguments, number):
    """Return a pointer to one record."""
    first = place(context, builder, signature.args[0], arguments[0],
                  builder.mul(number, number.type(_FIELDS)), _FIELDS)
    return builder.bitcast(first, ir.VectorType(first.type.pointee, _FIELDS).as_pointer())


def _neighbours(context, builder, signature, arguments, count):
    """Return a pointer to each of as many neighbouring records as a vector has lanes."""
    return [_record(context, builder, signature, arguments,
                    builder.add(arguments[1], arguments[1].type(q))) for q in range(count)]


def _indexed(context, builder, signature, arguments, count):
    """Return a pointer to the record of each lane."""
    start = arguments[2]
    first = place(context, builder, signature.args[1], arguments[1], start, count)
    return [_record(context, builder, signature, arguments, builder.sext(
        builder.load(builder.gep(first, [start.type(q)], inbounds=True)), start.type))
        for q in range(count)]


def _joined(builder, rows):
    """Return vectors one after another in one."""
    while len(rows) > 1:
        both = _constants(range(2 * rows[0].type.count))
        rows = [builder.shuffle_vector(a, b, both) for a, b in zip(rows[::2], rows[1::2])]
    return rows[0]


def _parts(builder, whole, size):
    return [builder.shuffle_vector(whole, whole, _constants(range(k, k + size)))
            for k in range(0, whole.type.count, size)]


def _turned(builder, rows):
    """Return four vectors of which each square of 4 x 4 lanes is transposed."""
    for size in (1, 2):
        exchange(builder, rows, size)
    return rows


def _load(builder, vector, pointers):
    """Return x, y, z, m of some records."""
    records = [builder.load(pointer, align=vector.lane.bitwidth // 8) for pointer in pointers]
    records *= max(1, _FIELDS // vector.count)    # two lanes: each twice
    rows = [_joined(builder, records[k::_FIELDS]) for k in range(_FIELDS)]
    return [_parts(builder, field, vector.count)[0] for field in _turned(builder, rows)]


def _store(builder, vector, pointers, fields):
    """Write x, y, z, m to some records."""
    fields = [_joined(builder, [field] * max(1, _FIELDS // vector.count)) for field in fields]
    rows = [_parts(builder, row, _FIELDS) for row in _turned(builder, fields)]
    for pointer, record in zip(pointers, [row for part in zip(*rows) for row in part]):
        builder.store(record, pointer, align=vector.lane.bitwidth // 8)


def _loader(records, *place, pointers):
    vector = vector_of(records)
    result = types.UniTuple(vector, _FIELDS)

    def generate(context, builder, signature, arguments):
        return context.make_tuple(builder, result, _load(builder, vector, pointers(
            context, builder, signature, arguments, vector.count)))
    return result(records, *place), generate


def _storer(records, *place, pointers):
    vector = vector_of(records)

    def generate(context, builder, signature, arguments):
        _store(builder, vector, pointers(context, builder, signature, arguments, vector.count),
               arguments[-_FIELDS:])
        return context.get_dummy_value()
    return types.void(records, *place, *[vector] * _FIELDS), generate


@intrinsic
def load_row(typing, records, start):
    """Return x, y, z, m of neighbouring records."""
    return _loader(records, types.intp, pointers=_neighbours)


@intrinsic
def store_row(typing, records, start, x, y, z, m):
    """Write x, y, z, m of neighbouring records."""
    return _storer(records, types.intp, pointers=_neighbours)


@intrinsic
def load_records(typing, records, index, start):
    """Return x, y, z, m of the particles in index[start:start + lanes]."""
    return _loader(records, index, types.intp, pointers=_indexed)


@intrinsic
def store_records(typing, records, index, start, x, y, z, m):
    """Write x, y, z, m of the particles in index[start:start + lanes]."""
    return _storer(records, index, types.intp, pointers=_indexed)


def put_records(records, apart, index, start, x, y, z, m, step, dx, dy, dz):
    """Move by step d from x, y, z; where moves are added up, add them to those."""


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
    """Copy positions and mobilities of the slots from first to last, or a few more."""
    x, y, z, m = state.x[0], state.x[1], state.x[2], state.mobility
    for i in range(first, last, lanes(m)):
        store_row(records, i, load(x, i), load(y, i), load(z, i), load(m, i))
    _zero(state.apart, first, last + lanes(m))    # as many as ``_back`` adds


@jit
def _zero(apart, first, last):    # Numba prunes a branch on None where that is an argument
    if apart is not None:
        apart.records[first:last] = 0.0


@jit
def to_positions(state, records, first, last):
    """Copy positions back, whatever the method."""
    _back(state, None, records, first, last)


@jit
def from_records(state, records, first, last):
    """Copy positions back, or add the moves to those of the other constraints."""
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
