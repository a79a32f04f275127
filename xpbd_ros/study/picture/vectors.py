"""Directions and turns."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]


def unit(vectors: ArrayLike) -> Array:
    vectors = np.asarray(vectors, dtype=float)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def rotation(quaternion: Sequence[float]) -> Array:
    """Return the matrix (3, 3) of a quaternion x, y, z, w."""
    x, y, z, w = unit(quaternion)
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def basis(axis: Array) -> Array:
    """Return a right-handed rotation (3, 3) whose last row is the axis."""
    axis = unit(axis)
    side = np.cross([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0], axis)
    side = unit(side)
    return np.stack([side, np.cross(axis, side), axis])
