"""
Particles as records x y z m: what a constraint on any mesh loads and stores by index.

A particle scattered over four arrays costs four gathers; a record is one short load, and as many
of them as a vector has lanes are transposed in registers into vectors of x, y, z and m.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
import numpy as np

from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.layout import zeros
from xpbd_ros.sim.update import inline
from xpbd_ros.sim.vector import fma, lanes, load, store, vector_of

PACK = 16
"""constraints that share no particle, side by side: the lanes of the widest vector there is"""
_FIELDS = 4


def new_records(slots: int, dtype) -> np.ndarray:
    """Return records for all slots, shape (slots, 4)."""
    return zeros((slots, _FIELDS), dtype)


def _constants(numbers):
    return ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), numbers)


def _record_pointers(context, builder, signature, arguments, count, kind):
    """Return a pointer to the record of each lane."""
    records, index, start, *_ = (cgutils.create_struct_proxy(t)(context, builder, value=v).data
                             if isinstance(t, types.Array) else v
                             for t, v in zip(signature.args, arguments))
    for q in range(count):
        place = builder.gep(index, [builder.add(start, start.type(q))], inbounds=True)
        particle = builder.sext(builder.load(place), start.type)
        first = builder.mul(particle, start.type(_FIELDS))
        yield builder.bitcast(builder.gep(records, [first], inbounds=True), kind.as_pointer())


def _transposed(builder, rows):
    """Return the transpose of rows, each a vector; counts are powers of two."""
    while len(rows) > 1:    # pairs of vectors become one, interleaved
        half = len(rows) // 2
        count = rows[0].type.count
        mixed = _constants([k for q in range(count) for k in (q, count + q)])
        rows = [builder.shuffle_vector(rows[k], rows[k + half], mixed) for k in range(half)]
    return rows[0]


def _parts(builder, whole, size):
    return [builder.shuffle_vector(whole, whole, _constants(list(range(k, k + size))))
            for k in range(0, whole.type.count, size)]


def _whole(context, builder, signature, arguments, count):
    """Return a pointer to as many neighbouring records as a vector has lanes."""
    records = cgutils.create_struct_proxy(signature.args[0])(
        context, builder, value=arguments[0]).data
    first = builder.mul(arguments[1], arguments[1].type(_FIELDS))
    kind = ir.VectorType(records.type.pointee, _FIELDS * count)
    return builder.bitcast(builder.gep(records, [first], inbounds=True), kind.as_pointer())


@intrinsic
def load_row(typing, records, start):
    """Return x, y, z, m of neighbouring records."""
    vector = vector_of(records)
    result = types.UniTuple(vector, _FIELDS)

    def generate(context, builder, signature, arguments):
        whole = builder.load(_whole(context, builder, signature, arguments, vector.count),
                             align=vector.lane.bitwidth // 8)
        return context.make_tuple(builder, result, [builder.shuffle_vector(
            whole, whole, _constants(list(range(k, _FIELDS * vector.count, _FIELDS))))
            for k in range(_FIELDS)])
    return result(records, types.intp), generate


@intrinsic
def store_row(typing, records, start, x, y, z, m):
    """Write x, y, z, m of neighbouring records."""
    vector = vector_of(records)

    def generate(context, builder, signature, arguments):
        builder.store(_transposed(builder, arguments[2:]), _whole(
            context, builder, signature, arguments, vector.count),
            align=vector.lane.bitwidth // 8)
        return context.get_dummy_value()
    return types.void(records, types.intp, *[vector] * _FIELDS), generate


@intrinsic
def load_records(typing, records, index, start):
    """Return x, y, z, m of the particles in index[start:start + lanes]."""
    vector = vector_of(records)
    result = types.UniTuple(vector, _FIELDS)

    def generate(context, builder, signature, arguments):
        kind = ir.VectorType(vector.llvm.element, _FIELDS)
        rows = [builder.load(pointer, align=vector.lane.bitwidth // 8) for pointer in
                _record_pointers(context, builder, signature, arguments, vector.count, kind)]
        return context.make_tuple(builder, result, _parts(
            builder, _transposed(builder, rows), vector.count))
    return result(records, index, types.intp), generate


@intrinsic
def store_records(typing, records, index, start, x, y, z, m):
    """Write x, y, z, m of the particles in index[start:start + lanes]."""
    vector = vector_of(records)

    def generate(context, builder, signature, arguments):
        kind = ir.VectorType(vector.llvm.element, _FIELDS)
        rows = _parts(builder, _transposed(builder, arguments[3:]), _FIELDS)
        for row, pointer in zip(rows, _record_pointers(
                context, builder, signature, arguments, vector.count, kind)):
            builder.store(row, pointer, align=vector.lane.bitwidth // 8)
        return context.get_dummy_value()
    return types.void(records, index, types.intp, *[vector] * _FIELDS), generate


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
    _zero(state.apart, first, last)


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
