"""
Displacement accumulators of the methods that move all particles at once (Jacobi, explicit).

Constraints read the positions x and add their displacements to an accumulator; the sum is applied
after the pass.
"""

from operator import getitem
from typing import NamedTuple

from numba import types
from numba.extending import intrinsic
import numpy as np


class Jacobi(NamedTuple):
    """Accumulator of a Jacobi pass: all constraints are projected from the same positions."""

    move: np.ndarray
    """sum of the displacements of a pass [m], shape (3, slots)"""
    records: np.ndarray
    """sum of the displacements of mesh constraints [m], as records, shape (slots, 4)"""
    per_relaxation: np.ndarray
    """1 / ω, shape (1,)"""


class Explicit(NamedTuple):
    """Accumulator of an explicit pass: constraints exert their force F at x."""

    move: np.ndarray
    """sum of H² F / m [m], shape (3, slots)"""
    records: np.ndarray
    """sum of H² F / m of mesh constraints [m], as records, shape (slots, 4)"""


def _field(accumulator, name: str):
    if isinstance(accumulator, types.NoneType):
        return types.none(accumulator), lambda context, builder, *_: context.get_dummy_value()
    array = accumulator[accumulator.fields.index(name)]

    def generate(context, builder, signature, arguments):
        return context.get_getattr(accumulator, name)(
            context, builder, accumulator, arguments[0], name)
    return array(accumulator), generate


@intrinsic
def moves(typing, accumulator):
    """Return the field ``move`` of an accumulator; None for None."""
    return _field(accumulator, 'move')


@intrinsic
def record_moves(typing, accumulator):
    """Return the field ``records`` of an accumulator; None for None."""
    return _field(accumulator, 'records')


@intrinsic
def row(typing, array, k):
    """Return row k of an array as a view, or None for None (a compiled function cannot)."""
    if isinstance(array, types.NoneType):
        return types.none(array, k), lambda context, builder, *_: context.get_dummy_value()
    view = typing.resolve_function_type(getitem, (array, k), {}).return_type

    def generate(context, builder, signature, arguments):
        return context.get_function(getitem, view(*signature.args))(builder, arguments)
    return view(array, k), generate
