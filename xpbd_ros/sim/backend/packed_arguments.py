"""
Arguments of compiled code as one array of numbers.

Numba's wrapper takes the named tuples of a scene apart at every call. That code is straight, but
keeps hundreds of arrays in view, so that compiling it takes as long as half of a step. ``Packed``
holds the numbers that compiled code has of a tuple (``arguments``), one for each leaf; a kernel
gets the tuple by ``unpacked``.
"""

from collections.abc import Sequence
from itertools import count
from typing import Any

from llvmlite import ir
from numba import typeof, types
from numba.core.datamodel import models
from numba.core.pythonapi import NativeValue
from numba.extending import intrinsic, register_model, typeof_impl, unbox
import numpy as np

from xpbd_ros.sim.backend.jit import WHY_PLAIN

SLOT = ir.IntType(64)


class PackedType(types.Type):
    """What Numba knows of a ``Packed``."""

    def __init__(self, tuple_: types.BaseTuple):
        self.tuple = tuple_
        super().__init__(f'Packed({tuple_})')


class Packed:
    """A tuple of arrays, numbers and such tuples, as ``unpacked`` takes it; it keeps them."""

    def __init__(self, values: tuple):
        self.kind = PackedType(typeof(values))
        self._values = values
        self._slots = packed(flat(values, self.kind.tuple), address)
        self.address = address(self._slots)


@register_model(PackedType)
class PackedModel(models.PrimitiveModel):
    """In compiled code it is the address of the numbers."""

    def __init__(self, manager, kind):
        super().__init__(manager, kind, SLOT)


@typeof_impl.register(Packed)
def _type_of(value, context):
    return value.kind


@unbox(PackedType)
def _address_of(kind, value, c):
    number = c.pyapi.object_getattr_string(value, 'address')
    found = c.pyapi.long_as_longlong(number)
    c.pyapi.decref(number)
    return NativeValue(found)


@intrinsic
def unpacked(typing, values):
    """Return the tuple of a ``Packed``."""
    def write(context, builder, signature, arguments):
        slots, number = builder.inttoptr(arguments[0], SLOT.as_pointer()), count()

        def load(kind):
            if isinstance(kind, tuple | list):
                return tuple(map(load, kind))
            slot = builder.gep(slots, [SLOT(next(number))])
            if isinstance(kind, ir.IntType):
                return builder.trunc(builder.load(slot), kind)
            if isinstance(kind, ir.PointerType):
                return builder.inttoptr(builder.load(slot), kind)
            return builder.load(builder.bitcast(slot, kind.as_pointer()))
        model = context.data_model_manager[signature.return_type]
        return model.from_argument(builder, load(model.get_argument_type()))
    return values.tuple(values), write


def address(array: np.ndarray) -> int:
    """Return where an array is."""
    return array.__array_interface__['data'][0]


def leaves(kind) -> list:
    """Return the types in LLVM of an argument, in order."""
    if isinstance(kind, tuple | list):
        return [leaf for each in kind for leaf in leaves(each)]
    return [kind]


def flat(value: Any, kind: types.Type, *, inside: bool = False) -> list:
    """
    Return the parameters of a kernel for an argument: whole numbers, floats, arrays, None for 0.

    As ``arguments`` passes them: contiguous arrays in named tuples as an address and a shape.
    """
    if isinstance(kind, types.BaseTuple):
        ours = isinstance(kind, types.NamedTuple)
        return [leaf for item, each in zip(value, kind)
                for leaf in flat(item, each, inside=ours)]
    if not isinstance(kind, types.Array):
        return [value]
    if is_compact(kind, inside):
        return [value, *value.shape]
    return [None, None, value.size, value.itemsize, value, *value.shape, *value.strides]


def packed(parameters: Sequence[Any], address) -> np.ndarray:
    """Return parameters as bytes of one SLOT each; ``address(array)`` is where an array is."""
    found = np.zeros(len(parameters), np.int64)
    for k, value in enumerate(parameters):
        if isinstance(value, np.ndarray):
            found[k] = address(value)
        elif isinstance(value, float | np.floating):
            found[k:k + 1].view(np.result_type(value))[0] = value
        elif value is not None:
            found[k] = value
    return found


def is_compact(kind: types.Array, inside: bool) -> bool:
    """Tell whether an array is passed as an address and a shape; ``inside`` as in ``flat``."""
    return not WHY_PLAIN and inside and kind.layout == 'C' and kind.ndim > 0
