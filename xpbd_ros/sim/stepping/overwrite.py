"""Renew a deep copy of nested tuples of arrays, such as effects and state, in its memory."""

from typing import Any

import numpy as np


def overwrite(target: Any, source: Any, partners: dict[int, Any] | None = None) -> bool:
    """
    Copy the arrays of a structure onto those of an earlier deep copy.

    Of tuples with the method ``in_use``, as ``Contacts`` has it, what the source uses is copied.

    Returns
    -------
    False if the two differ in more than the values in arrays; then parts of ``target`` are
    overwritten

    """
    partners = {} if partners is None else partners
    if isinstance(source, np.ndarray):
        alike = (isinstance(target, np.ndarray) and target.shape == source.shape
                 and target.dtype == source.dtype
                 and partners.setdefault(id(source), target) is target    # share as they share
                 and partners.setdefault(id(target), source) is source)
        if alike:
            target[...] = source
        return alike
    if type(target) is not type(source):
        return False
    if isinstance(source, tuple):
        if hasattr(source, 'in_use'):
            target, source = source.in_use(target), source.in_use(source)
        return len(target) == len(source) and all(
            overwrite(a, b, partners) for a, b in zip(target, source))
    return target is source or target == source
