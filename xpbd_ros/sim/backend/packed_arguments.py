"""
Arguments of compiled code as one array of 64-bit words.

Numba's wrapper unpacks the named tuples of a scene at every call. Compiling that code, which keeps
hundreds of values alive, takes nearly as long as compiling the step. ``Packed`` holds the words
that compiled code passes for a tuple (``arguments``), and a kernel reads the tuple from them by
``unpacked``.
"""

from collections.abc import Callable
from functools import partial
from itertools import count
import struct
from typing import Any

from llvmlite import ir
from numba import typeof, types
from numba._dispatcher import compute_fingerprint
from numba.core.datamodel import default_manager, models
from numba.core.pythonapi import NativeValue
from numba.extending import intrinsic, register_model, typeof_impl, unbox
import numpy as np

WORD = ir.IntType(64)
_LAYOUTS: dict[bytes, tuple] = {}
"""types and layouts of tuples by Numba's fingerprint, since ``typeof`` takes milliseconds"""


class PackedType(types.Type):
    """Numba type of a ``Packed``."""

    def __init__(self, tuple_: types.BaseTuple):
        self.tuple = tuple_
        super().__init__(f'Packed({tuple_})')


class Packed:
    """The words of a tuple of arrays, numbers and such tuples. It keeps a reference to them."""

    def __init__(self, values: tuple):
        key = compute_fingerprint(values)
        if key not in _LAYOUTS:
            kind = typeof(values)
            _LAYOUTS[key] = PackedType(kind), layout(kind)
        self.kind, found = _LAYOUTS[key]
        self._values = values
        self._words = np.array(words(values, found, host_address), np.int64)
        self.address = host_address(self._words)


@register_model(PackedType)
class PackedModel(models.PrimitiveModel):
    """In compiled code: the address of the words."""

    def __init__(self, manager, kind):
        super().__init__(manager, kind, WORD)


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
        first, number = builder.inttoptr(arguments[0], WORD.as_pointer()), count()

        def load(kind):
            if isinstance(kind, tuple | list):
                return tuple(map(load, kind))
            word = builder.gep(first, [WORD(next(number))])
            if isinstance(kind, ir.IntType):
                return builder.trunc(builder.load(word), kind)
            if isinstance(kind, ir.PointerType):
                return builder.inttoptr(builder.load(word), kind)
            return builder.load(builder.bitcast(word, kind.as_pointer()))
        model = context.data_model_manager[signature.return_type]
        return model.from_argument(builder, load(model.get_argument_type()))
    return values.tuple(values), write


def host_address(array: np.ndarray) -> int:
    """Return the address of an array's data."""
    return array.__array_interface__['data'][0]


def layout(kind: types.Type) -> list | Callable[..., list[int]]:
    """Return what ``words`` needs to write values of a type; of a tuple, one for each item."""
    if isinstance(kind, types.BaseTuple):
        compact = getattr(default_manager[kind], 'compact', [False] * len(kind))
        return [_compact_array if each else layout(item) for each, item in zip(compact, kind)]
    if isinstance(kind, types.Array):
        return _array
    if isinstance(kind, types.Float):
        return partial(_number, 'd' if kind.bitwidth == 64 else 'f4x')
    return _integer


def words(value: Any, how: Any, address: Callable[[np.ndarray], int]) -> list[int]:
    """
    Return the words by which ``arguments`` passes a value.

    Parameters
    ----------
    value : tuple, array, number or None
    how : its ``layout``
    address : returns where an array is

    """
    if isinstance(how, list):
        return [word for item, each in zip(value, how) for word in words(item, each, address)]
    return how(value, address)


def _compact_array(array, address) -> list[int]:
    return [address(array), *array.shape]


def _array(array, address) -> list[int]:
    return [0, 0, array.size, array.itemsize, address(array), *array.shape, *array.strides]


def _number(code, value, address) -> list[int]:
    return [struct.unpack('q', struct.pack(code, value))[0]]


def _integer(value, address) -> list[int]:
    return [0 if value is None else int(value)]
