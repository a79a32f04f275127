"""
PACK integers at once: comparison with a number, and compression of those chosen by bits.

Integers have no rounding, so each is done by whatever instructions are fastest: where the machine
permutes eight lanes by a vector of indices (AVX2), compression takes two of these; where it has
an instruction for it (AVX-512), that one.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from xpbd_ros.sim.backend.simd import BITS, FEATURES, place, splatted
from xpbd_ros.sim.backend.simd_records import PACK

NUMBER, INDEX = ir.IntType(32), ir.IntType(64)
HALF = 8
"""lanes that one instruction permutes"""
PERMUTES = bool(FEATURES.get('avx2')) and BITS >= 32 * HALF
COMPRESSES = bool(FEATURES.get('avx512f')) and BITS >= 32 * PACK
_PLACES = [[lane for lane in range(HALF) if chosen >> lane & 1] for chosen in range(1 << HALF)]


def _vector(context, builder, kind, array, index, count):
    """Return a pointer to a vector of an array's integers."""
    return builder.bitcast(place(context, builder, kind, array, index, count),
                           ir.VectorType(NUMBER, count).as_pointer())


@intrinsic
def equal_bits(typing, array, index, number):
    """Return bits that tell which of PACK int32 numbers, from an index on, equal a number."""
    def generate(context, builder, signature, arguments):
        array_, index_, number_ = arguments
        found = builder.load(_vector(context, builder, signature.args[0], array_, index_, PACK),
                             align=4)
        same = builder.icmp_signed('==', found, splatted(builder, number_, found.type))
        return builder.zext(builder.bitcast(same, ir.IntType(PACK)), INDEX)
    return types.int64(array, types.intp, types.int32), generate


@intrinsic
def fill(typing, array, index, number):
    """Write an int32 number to PACK places from an index on."""
    def generate(context, builder, signature, arguments):
        array_, index_, number_ = arguments
        builder.store(splatted(builder, number_, ir.VectorType(NUMBER, PACK)), _vector(
            context, builder, signature.args[0], array_, index_, PACK), align=4)
        return context.get_dummy_value()
    return types.void(array, types.intp, types.int32), generate


@intrinsic
def compress(typing, source, begin, chosen, target, index):
    """
    Copy those of PACK int32 numbers whose bits are set to a target, one after another.

    Parameters
    ----------
    source, begin : array, and index of the first of the PACK numbers
    chosen : bits
    target, index : array, and where to write; what follows, up to PACK numbers in all, is lost

    """
    def generate(context, builder, signature, arguments):
        step = _at_once if COMPRESSES else _permuted if PERMUTES else _one_by_one
        step(context, builder, signature, *arguments)
        return context.get_dummy_value()
    return types.void(source, types.intp, types.int64, target, types.intp), generate


def _at_once(context, builder, signature, source, begin, chosen, target, index):
    row, mask = ir.VectorType(NUMBER, PACK), ir.VectorType(ir.IntType(1), PACK)
    instruction = builder.module.declare_intrinsic(
        f'llvm.x86.avx512.mask.compress.v{PACK}i32', (), ir.FunctionType(row, [row, row, mask]))
    found = builder.load(_vector(context, builder, signature.args[0], source, begin, PACK),
                         align=4)
    wanted = builder.bitcast(builder.trunc(chosen, ir.IntType(PACK)), mask)
    builder.store(builder.call(instruction, [found, found, wanted]), _vector(
        context, builder, signature.args[3], target, index, PACK), align=4)


def _permuted(context, builder, signature, source, begin, chosen, target, index):
    lanes = ir.VectorType(NUMBER, HALF)
    row = ir.VectorType(ir.IntType(8), HALF)
    rows = ir.ArrayType(row, len(_PLACES))
    table = cgutils.global_constant(builder, 'places', ir.Constant(rows, [
        ir.Constant(row, [*places, *[0] * (HALF - len(places))]) for places in _PLACES]))
    permute = builder.module.declare_intrinsic('llvm.x86.avx2.permd', (), ir.FunctionType(
        lanes, [lanes, lanes]))
    for half in range(PACK // HALF):
        part = builder.and_(builder.lshr(chosen, INDEX(HALF * half)), INDEX(2**HALF - 1))
        order = builder.zext(builder.load(builder.gep(table, [INDEX(0), part])), lanes)
        found = builder.load(_vector(context, builder, signature.args[0], source, builder.add(
            begin, INDEX(HALF * half)), HALF), align=4)
        builder.store(builder.call(permute, [found, order]), _vector(
            context, builder, signature.args[3], target, index, HALF), align=4)
        index = builder.add(index, builder.ctpop(part))


def _one_by_one(context, builder, signature, source, begin, chosen, target, index):
    for lane in range(PACK):
        found = builder.load(place(context, builder, signature.args[0], source, builder.add(
            begin, INDEX(lane))))
        builder.store(found, place(context, builder, signature.args[3], target, index))
        index = builder.add(index, builder.and_(builder.lshr(chosen, INDEX(lane)), INDEX(1)))
