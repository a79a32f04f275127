"""
Accumulators: where methods that move all particles at once add up the moves.

They read the positions x as they are, so the moves of a pass are added up elsewhere and applied
together.
"""

from typing import NamedTuple

import numpy as np


class Jacobi(NamedTuple):
    """All constraints move from the same positions."""

    move: np.ndarray
    """sum of the moves of a pass [m], shape (3, slots)"""
    records: np.ndarray
    """the same as records, for constraints of meshes; shape (slots, 4)"""
    per_relaxation: np.ndarray
    """1 / ω, shape (1,)"""


class Explicit(NamedTuple):
    """Constraints exert the force that they have at x."""

    move: np.ndarray
    """H² F / m [m], shape (3, slots)"""
    records: np.ndarray
    """the same as records, for constraints of meshes; shape (slots, 4)"""
