"""
Displacement accumulators of the methods that move all particles at once (Jacobi, explicit).

Constraints read the positions x and add their displacements to an accumulator; the sum is applied
after the pass.
"""

from typing import NamedTuple

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
