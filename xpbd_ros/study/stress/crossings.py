"""Crossings of triangles and edges by brute force."""

import numpy as np

FLAT = 1e-9
"""an edge that does not get further than this from a triangle's plane lies in it [m]"""
BLOCK = 512
"""edges whose pairs are in memory at a time"""


def crossings(x: np.ndarray, triangles: np.ndarray) -> int:
    """
    Return the number of crossing pairs of an edge and a triangle without a common particle.

    What lies flat in one plane does not, whatever its last bits say. Only pairs whose bounding
    boxes meet are computed.
    """
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1), axis=0)
    corners, count = x[triangles], 0
    low, high = corners.min(1), corners.max(1)
    for some in np.array_split(edges, len(edges) // BLOCK + 1):
        ends = x[some]
        e, t = np.nonzero(((ends.min(1)[:, None] <= high) & (ends.max(1)[:, None] >= low)).all(2))
        (p, q), (a, b, c) = ends[e].swapaxes(0, 1), corners[t].swapaxes(0, 1)
        way = q - p
        up, down = volume(a - p, b - p, c - p), volume(a - q, b - q, c - q)
        found = up * down < 0.0
        size = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
        found &= np.minimum(np.abs(up), np.abs(down)) > FLAT * size
        sides = [volume(s - p, t - p, way) for s, t in ((a, b), (b, c), (c, a))]
        found &= (np.min(sides, 0) > 0.0) | (np.max(sides, 0) < 0.0)
        found &= ~(some[e][:, :, None] == triangles[t][:, None]).any((1, 2))
        count += int(found.sum())
    return count


def volume(a, b, c) -> np.ndarray:
    """Return a · (b × c)."""
    return (a * np.cross(b, c)).sum(-1)
