"""
Denormal numbers count as zero while a frame is computed.

What decays towards 0, such as the sway of a cloth at rest, passes through numbers below 1e-308
(1e-38 in float32), with which a CPU computes some fifty times slower; none of them matters. The
thread's own mode is put back after the frame. Where the CPU is not an x86 nothing is changed.
"""

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

FLUSH = 0x8040
"""MXCSR: results that are denormal become 0 (bit 15), and so do operands (bit 6)"""
ON_X86 = binding.get_process_triple().split('-')[0] in ('x86_64', 'i386', 'i686')


@intrinsic
def flush_denormals(typing):
    """Take denormal numbers for 0 from now on, and return the mode as it was."""
    def generate(context, builder, signature, arguments):
        if not ON_X86:
            return ir.IntType(32)(0)
        before = _mode(builder)
        _set_mode(builder, builder.or_(before, before.type(FLUSH)))
        return before
    return types.uint32(), generate


@intrinsic
def restore_mode(typing, mode):
    """Go back to a mode that ``flush_denormals`` returned."""
    def generate(context, builder, signature, arguments):
        if ON_X86:
            _set_mode(builder, arguments[0])
        return context.get_dummy_value()
    return types.void(types.uint32), generate


def _mode(builder):
    place = cgutils.alloca_once(builder, ir.IntType(32))
    _call(builder, 'stmxcsr', place)
    return builder.load(place)


def _set_mode(builder, mode):
    place = cgutils.alloca_once(builder, ir.IntType(32))
    builder.store(mode, place)
    _call(builder, 'ldmxcsr', place)


def _call(builder, name, place):
    pointer = builder.bitcast(place, ir.IntType(8).as_pointer())
    kind = ir.FunctionType(ir.VoidType(), [pointer.type])
    builder.call(cgutils.get_or_insert_function(builder.module, kind, f'llvm.x86.sse.{name}'),
                 [pointer])
