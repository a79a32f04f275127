"""
Records in SIMD registers: loads and stores that transpose.

A record is four numbers side by side, (x, y, z, m) of one particle. A load of several records
gives four vectors, one per field; a store is the inverse.
"""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from xpbd_ros.sim.backend.simd import exchange, place, shuffle_mask, vector_of

PACK = 16
"""constraints that share no particle, side by side: the lanes of the widest vector there is"""
FIELDS = 4


def _record(context, builder, signature, arguments, number):
    """Return a pointer to one record."""
    first = place(context, builder, signature.args[0], arguments[0],
                  builder.mul(number, number.type(FIELDS)), FIELDS)
    return builder.bitcast(first, ir.VectorType(first.type.pointee, FIELDS).as_pointer())


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
        both = shuffle_mask(range(2 * rows[0].type.count))
        rows = [builder.shuffle_vector(a, b, both) for a, b in zip(rows[::2], rows[1::2])]
    return rows[0]


def _parts(builder, whole, size):
    return [builder.shuffle_vector(whole, whole, shuffle_mask(range(k, k + size)))
            for k in range(0, whole.type.count, size)]


def _turned(builder, rows):
    """Return four vectors of which each square of 4 x 4 lanes is transposed."""
    for size in (1, 2):
        exchange(builder, rows, size)
    return rows


def _load(builder, vector, pointers):
    """Return x, y, z, m of some records."""
    records = [builder.load(pointer, align=vector.lane.bitwidth // 8) for pointer in pointers]
    records *= max(1, FIELDS // vector.count)    # two lanes: each twice
    rows = [_joined(builder, records[k::FIELDS]) for k in range(FIELDS)]
    return [_parts(builder, field, vector.count)[0] for field in _turned(builder, rows)]


def _store(builder, vector, pointers, fields):
    """Write x, y, z, m to some records."""
    fields = [_joined(builder, [field] * max(1, FIELDS // vector.count)) for field in fields]
    rows = [_parts(builder, row, FIELDS) for row in _turned(builder, fields)]
    for pointer, record in zip(pointers, [row for part in zip(*rows) for row in part]):
        builder.store(record, pointer, align=vector.lane.bitwidth // 8)


def _loader(records, *place, pointers):
    vector = vector_of(records)
    result = types.UniTuple(vector, FIELDS)

    def generate(context, builder, signature, arguments):
        return context.make_tuple(builder, result, _load(builder, vector, pointers(
            context, builder, signature, arguments, vector.count)))
    return result(records, *place), generate


def _storer(records, *place, pointers):
    vector = vector_of(records)

    def generate(context, builder, signature, arguments):
        _store(builder, vector, pointers(context, builder, signature, arguments, vector.count),
               arguments[-FIELDS:])
        return context.get_dummy_value()
    return types.void(records, *place, *[vector] * FIELDS), generate


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
