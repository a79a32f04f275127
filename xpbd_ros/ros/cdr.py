"""
The length of a serialized message.

``serialize_message`` returns a buffer of the size that rmw_fastrtps estimated. The estimate aligns
the elements of an empty sequence to 8 bytes and CDR does not, so a message with such a sequence
(each ParameterValue has two) may end in bytes of uninitialized memory. Strict readers refuse it.
"""

import functools
import importlib
import struct
from typing import Any

from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractSequence,
    AbstractType,
    Array,
    BasicType,
    NamespacedType,
)

HEADER = 4
"""length of the encapsulation header; alignment counts from behind it [bytes]"""
SIZES = {'boolean': 1, 'octet': 1, 'char': 1, 'int8': 1, 'uint8': 1, 'int16': 2, 'uint16': 2,
         'int32': 4, 'uint32': 4, 'float': 4, 'int64': 8, 'uint64': 8, 'double': 8}
"""size of each primitive type, by its rosidl name [bytes]"""


def trimmed(data: bytes, kind: type) -> bytes:
    """Return a serialized message of type ``kind`` without the bytes behind its last field."""
    if not overestimated(kind):
        return data
    order = '<' if data[1] == 1 else '>'
    return data[:HEADER + _end(memoryview(data)[HEADER:], 0, kind, struct.Struct(f'{order}I'))]


@functools.cache
def overestimated(kind: Any) -> bool:
    """Return whether rmw_fastrtps may estimate too large a size for messages of this type."""
    return any(_aligns_when_empty(slot) for slot in kind.SLOT_TYPES)


def _aligns_when_empty(slot: AbstractType) -> bool:
    if isinstance(slot, NamespacedType):
        return overestimated(_class(tuple(slot.namespaces), slot.name))
    if isinstance(slot, AbstractSequence) and isinstance(slot.value_type, BasicType):
        return SIZES[slot.value_type.typename] > 4
    return isinstance(slot, AbstractSequence | Array) and _aligns_when_empty(slot.value_type)


@functools.cache
def _class(namespaces: tuple[str, ...], name: str) -> type:
    return getattr(importlib.import_module('.'.join(namespaces)), name)


def _end(data: memoryview, at: int, kind: Any, count: struct.Struct) -> int:
    """Return the offset behind a message of type ``kind`` that begins at ``at`` [bytes]."""
    for slot in kind.SLOT_TYPES:
        at = _skip(data, at, slot, count)
    return at


def _skip(data: memoryview, at: int, slot: AbstractType, count: struct.Struct) -> int:
    """Return the offset behind a field that begins at ``at``, alignment included [bytes]."""
    if isinstance(slot, NamespacedType):
        return _end(data, at, _class(tuple(slot.namespaces), slot.name), count)
    if isinstance(slot, BasicType):
        return _skip_numbers(at, slot, 1)
    if isinstance(slot, Array):
        length = slot.size
    else:
        at += -at % count.size
        length, = count.unpack_from(data, at)
        at += count.size
    if isinstance(slot, AbstractGenericString):
        return at + length
    if isinstance(slot.value_type, BasicType):
        return _skip_numbers(at, slot.value_type, length)
    for _ in range(length):
        at = _skip(data, at, slot.value_type, count)
    return at


def _skip_numbers(at: int, slot: BasicType, length: int) -> int:
    size = SIZES[slot.typename]
    return at + -at % size + length * size if length else at
