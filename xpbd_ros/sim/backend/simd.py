"""
SIMD lanes for Numba: one vector type, its operators, and ways to and from memory.

    for q in range(0, count, lanes(x)):
        store(y, q, load(x, q) * a + load(y, q))

A kernel is written once, with lanes as its step. ``load`` and ``store`` take flat indices into
C-contiguous float arrays; like Numba's own indexing they check bounds only with
NUMBA_BOUNDSCHECK=1. A scalar that meets a vector is cast to its lanes' type, so a literal never
turns float32 into float64. There are no fast-math flags: every operation is IEEE, so results do
not depend on the width of the registers.

The width is that of the machine's registers; XPBD_ROS_VECTOR_BITS = 128, 256 or 512 overrides it.
With 32 a vector has one lane, whatever the dtype: code for a GPU, whose threads are the lanes.
Built on Numba's public extension API and on llvmlite's IR builder.
"""

import operator
import os

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model
import numpy as np

from xpbd_ros.errors import brief, InputError
from xpbd_ros.sim.backend.operators import type_first

PROCESSOR = binding.get_host_cpu_name()
"""LLVM's name of this machine's processor, such as znver4"""
FEATURES = binding.get_host_cpu_features()
"""instruction sets that LLVM says it has, such as avx2"""
WIDTH_VARIABLE = 'XPBD_ROS_VECTOR_BITS'
"""environment variable that overrides the width"""
WIDTHS = (32, 128, 256, 512)
"""that kernels are written for"""


def width_of(text: str | None) -> int:
    """Return the width that the environment variable asks for, or that of the machine [bits]."""
    if not text:
        return 512 if FEATURES.get('avx512f') else 256 if FEATURES.get('avx') else 128
    if text not in map(str, WIDTHS):
        raise InputError(f'the environment variable {WIDTH_VARIABLE}: must be one of '
                         f'{", ".join(map(str, WIDTHS))} (got {brief(text):.40})')
    return int(text)


BITS = width_of(os.environ.get(WIDTH_VARIABLE))
"""width of a vector"""


def lane_count(dtype) -> int:
    """Return how many numbers of a dtype a vector holds."""
    return lanes_of(8 * np.dtype(dtype).itemsize)


def lanes_of(bits: int) -> int:
    """Return how many numbers of so many bits a vector holds."""
    return max(BITS // bits, 1)


class Vector(types.Type):
    """A vector of floats, or of truth values."""

    def __init__(self, lane, count):
        self.lane = lane
        self.count = count
        super().__init__(name=f'Vector({lane} x {count})')

    @property
    def llvm(self):
        """The type in LLVM."""
        if self.lane == types.boolean:
            return ir.VectorType(ir.IntType(1), self.count)
        element = ir.FloatType() if self.lane.bitwidth == 32 else ir.DoubleType()
        return ir.VectorType(element, self.count)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, kind.llvm)


def vector_of(array) -> Vector:
    """Return the vector type that belongs to an array's type."""
    assert isinstance(array, types.Array) and array.layout == 'C', f'not C-contiguous: {array}'
    return Vector(array.dtype, lanes_of(array.dtype.bitwidth))


def place(context, builder, array_type, array, index, count: int = 1):
    """Return a pointer to ``count`` numbers of an array, from a flat index on."""
    array = cgutils.create_struct_proxy(array_type)(context, builder, value=array)
    if context.enable_boundscheck:
        for end in (index, builder.add(index, index.type(count - 1))):
            cgutils.do_boundscheck(context, builder, end, array.nitems)
    return builder.gep(array.data, [index], inbounds=True)


def pointer_at(context, builder, array_type, array, index, kind):
    """Return a pointer to the vector of an LLVM type that starts at a flat index."""
    pointer = place(context, builder, array_type, array, index, kind.count)
    return builder.bitcast(pointer, kind.as_pointer())


def shuffle_mask(numbers):
    """Return a mask of ``shuffle_vector``: lanes by number, those of the second vector last."""
    return ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), list(numbers))


def splatted(builder, scalar, kind):
    """Return a vector of an LLVM type with a scalar in every lane."""
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar,
                                    ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined),
                                  shuffle_mask([0] * kind.count))


def widened(context, builder, value, kind, vector):
    """Return a value as a vector: itself, or a scalar in every lane."""
    if isinstance(kind, Vector):
        return value
    return splatted(builder, context.cast(builder, value, kind, vector.lane), vector.llvm)


def call_intrinsic(builder, name, vector, arguments):
    """Call the LLVM intrinsic of a name for a vector type."""
    suffix = f'v{vector.count}f{vector.lane.bitwidth}'
    kind = ir.FunctionType(vector.llvm, [a.type for a in arguments])
    function = builder.module.declare_intrinsic(f'llvm.{name}.{suffix}', (), kind)
    return builder.call(function, arguments)


@intrinsic
def lanes(typing, array):
    """Return how many lanes a vector of the array's dtype has; known at compile time."""
    count = vector_of(array).count
    return types.intp(array), lambda context, *_: context.get_constant(types.intp, count)


@intrinsic
def load(typing, array, index):
    """Return the vector that starts at a flat index."""
    vector = vector_of(array)

    def generate(context, builder, signature, arguments):
        array_, index_ = arguments
        pointer = pointer_at(context, builder, signature.args[0], array_, index_, vector.llvm)
        return builder.load(pointer, align=vector.lane.bitwidth // 8)
    return vector(array, types.intp), generate


@intrinsic
def store(typing, array, index, value):
    """Write a vector, or a scalar in every lane, from a flat index on."""
    vector = vector_of(array)

    def generate(context, builder, signature, arguments):
        array_, index_, value_ = arguments
        pointer = pointer_at(context, builder, signature.args[0], array_, index_, vector.llvm)
        builder.store(widened(context, builder, value_, signature.args[2], vector), pointer,
                      align=vector.lane.bitwidth // 8)
        return context.get_dummy_value()
    return types.void(array, types.intp, value), generate


@intrinsic
def splat(typing, array, scalar):
    """Return a vector of the array's kind with a scalar in every lane."""
    vector = vector_of(array)

    def generate(context, builder, signature, arguments):
        return widened(context, builder, arguments[1], signature.args[1], vector)
    return vector(array, scalar), generate


def _lane_mask(array, sign):
    vector = vector_of(array)
    mask = Vector(types.boolean, vector.count)

    def generate(context, builder, signature, arguments):
        kind = ir.VectorType(ir.IntType(32), vector.count)
        numbers = ir.Constant(kind, list(range(vector.count)))
        return builder.icmp_signed(sign, numbers, splatted(
            builder, builder.trunc(arguments[1], kind.element), kind))
    return mask(array, types.intp), generate


@intrinsic
def first(typing, array, count):
    """Return a mask that is true in the first ``count`` lanes."""
    return _lane_mask(array, '<')


@intrinsic
def after(typing, array, count):
    """Return a mask that is true in all but the first ``count`` lanes."""
    return _lane_mask(array, '>=')


@intrinsic
def select(typing, mask, yes, no):
    """Return ``yes`` where the mask is true, else ``no``; one of them may be a scalar."""
    vector = yes if isinstance(yes, Vector) else no

    def generate(context, builder, signature, arguments):
        yes_, no_ = (widened(context, builder, a, k, vector)
                     for a, k in zip(arguments[1:], signature.args[1:]))
        return builder.select(arguments[0], yes_, no_)
    return vector(mask, yes, no), generate


@intrinsic
def both(typing, a, b):
    """Return the mask that is true where both are."""
    return a(a, b), lambda context, builder, signature, arguments: builder.and_(*arguments)


@intrinsic
def either(typing, a, b):
    """Return the mask that is true where one of them is."""
    return a(a, b), lambda context, builder, signature, arguments: builder.or_(*arguments)


@intrinsic
def any_lane(typing, mask):
    """Tell whether a mask is true in some lane."""
    def generate(context, builder, signature, arguments):
        bits = ir.IntType(signature.args[0].count)
        return builder.icmp_unsigned('!=', builder.bitcast(arguments[0], bits), bits(0))
    return types.boolean(mask), generate


@intrinsic
def all_lanes(typing, mask):
    """Tell whether a mask is true in every lane."""
    def generate(context, builder, signature, arguments):
        whole = ir.IntType(signature.args[0].count)
        return builder.icmp_unsigned('==', builder.bitcast(arguments[0], whole), whole(-1))
    return types.boolean(mask), generate


@intrinsic
def bits(typing, mask):
    """Return a mask as an integer, lane 0 in the lowest bit."""
    def generate(context, builder, signature, arguments):
        whole = builder.bitcast(arguments[0], ir.IntType(signature.args[0].count))
        return builder.zext(whole, ir.IntType(64))
    return types.int64(mask), generate


@intrinsic
def lowest_bit(typing, number):
    """Return the index of the lowest bit that is set; the number must not be 0."""
    def generate(context, builder, signature, arguments):
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))
    return types.int64(types.int64), generate


@intrinsic
def count_bits(typing, number):
    """Return how many bits are set."""
    def generate(context, builder, signature, arguments):
        return builder.ctpop(arguments[0])
    return types.int64(types.int64), generate


@intrinsic
def highest(typing, a):
    """Return the largest lane."""
    def generate(context, builder, signature, arguments):
        lanes_ = [builder.extract_element(arguments[0], ir.Constant(ir.IntType(32), k))
                  for k in range(signature.args[0].count)]
        found = lanes_[0]
        for each in lanes_[1:]:
            found = builder.select(builder.fcmp_ordered('>', each, found), each, found)
        return found
    return a.lane(a), generate


@intrinsic
def root(typing, a):
    """Return the square root of every lane."""
    return a(a), lambda context, builder, signature, arguments: call_intrinsic(
        builder, 'sqrt', signature.return_type, arguments)


@intrinsic
def absolute(typing, a):
    """Return |a|, lane by lane."""
    return a(a), lambda context, builder, signature, arguments: call_intrinsic(
        builder, 'fabs', signature.return_type, arguments)


@intrinsic
def nearest(typing, a):
    """Return the nearest whole numbers; of halves, the even ones."""
    return a(a), lambda context, builder, signature, arguments: call_intrinsic(
        builder, 'nearbyint', signature.return_type, arguments)


def _extreme(a, b, sign):
    vector = a if isinstance(a, Vector) else b

    def generate(context, builder, signature, arguments):
        a_, b_ = (widened(context, builder, v, k, vector)
                  for v, k in zip(arguments, signature.args))
        return builder.select(builder.fcmp_ordered(sign, a_, b_), a_, b_)
    return vector(a, b), generate


@intrinsic
def larger(typing, a, b):
    """Return the larger of two vectors, lane by lane; one may be a scalar."""
    return _extreme(a, b, '>')


@intrinsic
def smaller(typing, a, b):
    """Return the smaller of two vectors, lane by lane; one may be a scalar."""
    return _extreme(a, b, '<')


@intrinsic
def fma(typing, a, b, c):
    """Return a b + c, rounded once."""
    vector = next(v for v in (a, b, c) if isinstance(v, Vector))

    def generate(context, builder, signature, arguments):
        return call_intrinsic(builder, 'fma', vector, [
            widened(context, builder, v, k, vector)
            for v, k in zip(arguments, signature.args)])
    return vector(a, b, c), generate


def exchange(builder, rows, size):
    """
    Let blocks of size x size lanes of rows trade places with those across the diagonal.

    Each pair of rows in one instruction; all sizes, one after another, are a transpose.
    """
    count = rows[0].type.count
    low = [count + q - size if q & size else q for q in range(count)]
    masks = [shuffle_mask(mask) for mask in (low, [q + size for q in low])]
    for k in range(len(rows)):
        if not k & size:
            rows[k], rows[k + size] = [
                builder.shuffle_vector(rows[k], rows[k + size], mask) for mask in masks]


@intrinsic
def transpose(typing, source, start, row_stride, target, target_start, target_stride):
    """Copy a square tile: target[start + q stride + r] = source[start + r stride + q]."""
    vector = vector_of(source)

    def generate(context, builder, signature, arguments):
        source_, start_, stride_, target_, target_start_, target_stride_ = arguments
        count, kind, align = vector.count, vector.llvm, vector.lane.bitwidth // 8
        integer = start_.type

        def at(array_type, array, begin, stride, k):
            index = builder.add(begin, builder.mul(stride, integer(k)))
            return pointer_at(context, builder, array_type, array, index, kind)

        rows = [builder.load(at(signature.args[0], source_, start_, stride_, k), align=align)
                for k in range(count)]
        size = count // 2
        while size:
            exchange(builder, rows, size)
            size //= 2
        for k in range(count):
            builder.store(rows[k], at(signature.args[3], target_, target_start_, target_stride_,
                                      k), align=align)
        return context.get_dummy_value()
    return types.void(source, types.intp, types.intp, target, types.intp, types.intp), generate


def _arithmetic(operation, name):
    def typer(a, b):
        if isinstance(a, Vector) and (a == b or isinstance(b, types.Number)):
            return a
        if isinstance(b, Vector) and isinstance(a, types.Number):
            return b

    def lower(context, builder, signature, arguments):
        return getattr(builder, name)(*(
            widened(context, builder, v, k, signature.return_type)
            for v, k in zip(arguments, signature.args)))

    for operator_ in (operation, getattr(operator, 'i' + operation.__name__)):
        type_first(operator_)(typer)
        for kinds in ((Vector, Vector), (Vector, types.Number), (types.Number, Vector)):
            lower_builtin(operator_, *kinds)(lower)


for _operation, _name in ((operator.add, 'fadd'), (operator.sub, 'fsub'),
                          (operator.mul, 'fmul'), (operator.truediv, 'fdiv')):
    _arithmetic(_operation, _name)


def _comparison(operation, sign):
    def typer(a, b):
        if isinstance(a, Vector) and (a == b or isinstance(b, types.Number)):
            return Vector(types.boolean, a.count)

    def lower(context, builder, signature, arguments):
        vector = signature.args[0]
        return builder.fcmp_ordered(sign, arguments[0], widened(
            context, builder, arguments[1], signature.args[1], vector))

    type_first(operation)(typer)
    for kind in (Vector, types.Number):
        lower_builtin(operation, Vector, kind)(lower)


for _operation, _sign in ((operator.lt, '<'), (operator.gt, '>'),
                          (operator.le, '<='), (operator.ge, '>=')):
    _comparison(_operation, _sign)

type_first(operator.neg)(lambda a: a if isinstance(a, Vector) else None)
lower_builtin(operator.neg, Vector)(
    lambda context, builder, signature, arguments: builder.fneg(arguments[0]))
