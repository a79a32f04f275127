"""Vectors from a surface to measured points near it."""

import numpy as np
from scipy.spatial import cKDTree

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.closest_points import on_triangle

NEAR = 12
"""triangles whose centres are closest to a point, among which its closest point is looked for"""


def to_points(x: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """
    Return p - c for each point p, with the closest point c of the triangles.

    Only the NEAR triangles with the closest centres are looked at, which is exact for triangles of
    similar size.

    Parameters
    ----------
    x : corners [m], shape (particles, 3)
    triangles : shape (triangles, 3)
    points : [m], shape (points, 3)

    Returns
    -------
    [m], shape (points, 3)

    """
    near = cKDTree(x[triangles].mean(1)).query(points, min(NEAR, len(triangles)))[1]
    found = np.empty(points.shape)
    _to_points(x, triangles.astype(np.int64), points, near.reshape(len(points), -1), found)
    return found


@jit
def _to_points(x, triangles, points, near, found):
    """Write p - c of each point to ``found``, with c on one of the triangles in ``near``."""
    for i in range(len(points)):
        p = (points[i, 0], points[i, 1], points[i, 2])
        least = np.inf
        for k in range(near.shape[1]):
            a, b, c = triangles[near[i, k], 0], triangles[near[i, k], 1], triangles[near[i, k], 2]
            u, v, w = on_triangle(p, (x[a, 0], x[a, 1], x[a, 2]), (x[b, 0], x[b, 1], x[b, 2]),
                                  (x[c, 0], x[c, 1], x[c, 2]))
            dx = p[0] - (u * x[a, 0] + v * x[b, 0] + w * x[c, 0])
            dy = p[1] - (u * x[a, 1] + v * x[b, 1] + w * x[c, 1])
            dz = p[2] - (u * x[a, 2] + v * x[b, 2] + w * x[c, 2])
            if dx * dx + dy * dy + dz * dz < least:
                least = dx * dx + dy * dy + dz * dz
                found[i, 0], found[i, 1], found[i, 2] = dx, dy, dz
