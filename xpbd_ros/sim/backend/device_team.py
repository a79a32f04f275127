"""A thread's place among those of a GPU, and the barrier where all of them meet."""

from typing import NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
import numpy as np

from xpbd_ros.sim.backend.simd import place

MEET_ALL, MEET_BLOCK = 'meet_all', 'meet_block'
"""names in LLVM of the barriers, which ``nvptx`` defines"""


class DeviceTeam(NamedTuple):
    """One thread's place in the grid of threads of a launch."""

    worker: int
    """number of this thread; those of neighbours on the card follow one another"""
    workers: int
    """number of threads"""
    block: int
    """number of threads of a block; the first ones are those of the first block"""
    gate: np.ndarray
    """state of the barrier, shape (1,)"""


@intrinsic
def add_atomically(typing, array, index, number):
    """Add to a number of an int64 array, to which other threads add too up to a barrier."""
    def generate(context, builder, signature, arguments):
        array_, index_, number_ = arguments
        at = place(context, builder, signature.args[0], array_, index_)
        builder.atomic_rmw('add', at, number_, 'monotonic')
        return context.get_dummy_value()
    return types.void(array, types.intp, types.int64), generate


def _meet(name, gate):
    def generate(context, builder, signature, arguments):
        at = place(context, builder, gate, arguments[0], ir.IntType(64)(0))
        kind = ir.FunctionType(ir.VoidType(), [at.type])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [at])
        return context.get_dummy_value()
    return types.void(gate), generate


@intrinsic
def meet_all(typing, gate):
    """Go on when all threads of the launch are here, and see all that they wrote before."""
    return _meet(MEET_ALL, gate)


@intrinsic
def meet_block(typing, gate):
    """Go on when all threads of the block are here, and see all that they wrote before."""
    return _meet(MEET_BLOCK, gate)
