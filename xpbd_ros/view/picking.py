"""Find the particle below the pointer."""

import numpy as np

SAME = 1e-3
"""distance from the ray up to which particles count as equally near, over the cloths' size"""


def particle_at(x: np.ndarray, origin: np.ndarray, direction: np.ndarray, size: float
                ) -> int | None:
    """
    Return the particle next to a ray, the front one of several; None if all are behind.

    Parameters
    ----------
    x : positions [m], shape (particles, 3)
    origin, direction : of the ray [m], unit vector; shape (3,)
    size : size of the cloths [m]

    """
    to = x - origin
    along = to @ direction
    apart = np.linalg.norm(to - along[:, None] * direction, axis=1)
    near = np.flatnonzero((apart < apart.min() + SAME * size) & (along > 0.0))
    return int(near[along[near].argmin()]) if len(near) else None
