"""
Lanes of float64, whatever the precision of the arrays, and lanes by index.

Contact computes in float64 with float32 states too. Loads convert to float64, stores round to the
array's precision; so does each kernel for one particle, with the same bits.
"""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from xpbd_ros.sim.backend.simd import (
    lanes_of,
    place,
    pointer_at,
    shuffle_mask,
    splatted,
    Vector,
    widened,
)

WIDE = Vector(types.float64, lanes_of(64))
WIDTH = WIDE.count
"""numbers in a vector"""
_ROW = 3


def _ext(builder, value, target):
    """Return a float or a vector of floats as float64."""
    return value if value.type == target else builder.fpext(value, target)


def _round(builder, value, target):
    """Return float64 in the precision of an array."""
    return value if value.type == target else builder.fptrunc(value, target)


def _narrow(array):
    """Return the vector that an array's numbers fill, as wide as one of float64."""
    return Vector(array.dtype, WIDTH).llvm


def _positions(context, builder, signature, arguments):
    """Return a pointer to each number array[first + index[start + lane]]."""
    array, first, index, start = arguments[:4]
    chosen = place(context, builder, signature.args[2], index, start, WIDTH)
    return [place(context, builder, signature.args[0], array, builder.add(first, builder.load(
        builder.gep(chosen, [start.type(q)], inbounds=True)))) for q in range(WIDTH)]


@intrinsic
def wide(typing, scalar):
    """Return a vector with a scalar in every lane."""
    def generate(context, builder, signature, arguments):
        return splatted(builder, context.cast(builder, arguments[0], signature.args[0], WIDE.lane),
                        WIDE.llvm)
    return WIDE(scalar), generate


@intrinsic
def load_wide(typing, array, index):
    """Return the vector that starts at a flat index."""
    def generate(context, builder, signature, arguments):
        array_, index_ = arguments
        pointer = pointer_at(context, builder, signature.args[0], array_, index_, _narrow(array))
        return _ext(builder, builder.load(pointer, align=array.dtype.bitwidth // 8), WIDE.llvm)
    return WIDE(array, types.intp), generate


@intrinsic
def store_wide(typing, array, index, value):
    """Write a vector, or a scalar in every lane, from a flat index on."""
    def generate(context, builder, signature, arguments):
        array_, index_, value_ = arguments
        pointer = pointer_at(context, builder, signature.args[0], array_, index_, _narrow(array))
        whole = widened(context, builder, value_, signature.args[2], WIDE)
        builder.store(_round(builder, whole, _narrow(array)), pointer,
                      align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()
    return types.void(array, types.intp, value), generate


@intrinsic
def gather(typing, array, first, index, start):
    """Return array[first + index[start + lane]], flat; ``index``: int64."""
    def generate(context, builder, signature, arguments):
        found = ir.Constant(WIDE.llvm, ir.Undefined)
        for lane, pointer in enumerate(_positions(context, builder, signature, arguments)):
            found = builder.insert_element(found, _ext(
                builder, builder.load(pointer), ir.DoubleType()), ir.IntType(32)(lane))
        return found
    return WIDE(array, types.intp, index, types.intp), generate


@intrinsic
def scatter(typing, array, first, index, start, value):
    """Write array[first + index[start + lane]], flat; no two lanes may have the same index."""
    def generate(context, builder, signature, arguments):
        for lane, pointer in enumerate(_positions(context, builder, signature, arguments)):
            builder.store(_round(builder, builder.extract_element(
                arguments[4], ir.IntType(32)(lane)), pointer.type.pointee), pointer)
        return context.get_dummy_value()
    return types.void(array, types.intp, index, types.intp, WIDE), generate


@intrinsic
def store_integers(typing, array, index, first, step):
    """Write first, first + step, first + 2 step, … to as many places as a vector has lanes."""
    def generate(context, builder, signature, arguments):
        array_, index_, first_, step_ = arguments
        lane = context.get_data_type(signature.args[0].dtype)
        kind = ir.VectorType(ir.IntType(64), WIDTH)
        numbers = builder.add(splatted(builder, first_, kind), builder.mul(
            splatted(builder, step_, kind), ir.Constant(kind, list(range(WIDTH)))))
        kind = ir.VectorType(lane, WIDTH)
        numbers = numbers if lane.width == 64 else builder.trunc(numbers, kind)
        pointer = pointer_at(context, builder, signature.args[0], array_, index_, kind)
        builder.store(numbers, pointer, align=lane.width // 8)
        return context.get_dummy_value()
    return types.void(array, types.intp, types.intp, types.intp), generate


@intrinsic
def any_true(typing, array, index):
    """Return True if one of as many truth values as a vector has lanes is true."""
    def generate(context, builder, signature, arguments):
        array_, index_ = arguments
        kind = ir.VectorType(context.get_data_type(signature.args[0].dtype), WIDTH)
        found = builder.load(pointer_at(context, builder, signature.args[0], array_, index_, kind),
                             align=1)
        whole = ir.IntType(WIDTH * kind.element.width)
        return builder.icmp_unsigned('!=', builder.bitcast(found, whole), whole(0))
    return types.boolean(array, types.intp), generate


@intrinsic
def load_columns(typing, array, row):
    """Return the columns of rows from ``row`` on of a float64 array, shape (rows, 3)."""
    result = types.UniTuple(WIDE, _ROW)

    def generate(context, builder, signature, arguments):
        whole = builder.load(_rows(context, builder, signature, arguments), align=8)
        return context.make_tuple(builder, result, [
            builder.shuffle_vector(whole, whole, shuffle_mask(range(a, _ROW * WIDTH, _ROW)))
            for a in range(_ROW)])
    return result(array, types.intp), generate


@intrinsic
def store_columns(typing, array, row, x, y, z):
    """Write the columns of rows from ``row`` on."""
    def generate(context, builder, signature, arguments):
        x_, y_, z_ = (widened(context, builder, v, k, WIDE)
                      for v, k in zip(arguments[2:], signature.args[2:]))
        two = shuffle_mask(range(2 * WIDTH))
        one, other = builder.shuffle_vector(x_, y_, two), builder.shuffle_vector(z_, z_, two)
        whole = builder.shuffle_vector(one, other, shuffle_mask(
            [a * WIDTH + q for q in range(WIDTH) for a in range(_ROW)]))
        builder.store(whole, _rows(context, builder, signature, arguments), align=8)
        return context.get_dummy_value()
    return types.void(array, types.intp, x, y, z), generate


def _rows(context, builder, signature, arguments):
    """Return a pointer to as many rows of an array as a vector has lanes."""
    row = arguments[1]
    return pointer_at(context, builder, signature.args[0], arguments[0],
                      builder.mul(row, row.type(_ROW)),
                      ir.VectorType(ir.DoubleType(), _ROW * WIDTH))
