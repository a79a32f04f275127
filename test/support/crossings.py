"""Crossings and distances of triangles and edges by brute force."""

import numpy as np

FLAT = 1e-9
"""an edge that does not get further than this from a triangle's plane lies in it [m]"""


def crossings(x, triangles, block=512):
    """
    Return how many pairs of edge and triangle, without a particle in common, cross.

    What lies flat in one plane does not, whatever its last bits say. Only pairs whose bounding
    boxes meet are computed.
    """
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1), axis=0)
    corners, count = x[triangles], 0
    low, high = corners.min(1), corners.max(1)
    for some in np.array_split(edges, len(edges) // block + 1):
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


def volume(a, b, c):
    """Return a · (b × c)."""
    return (a * np.cross(b, c)).sum(-1)


def to_triangle(p, a, b, c):
    """Return the distance of a point to a triangle: to its plane, or to the nearest side."""
    n = np.cross(b - a, c - a)
    inside = all(np.cross(t - s, p - s) @ n >= 0.0 for s, t in ((a, b), (b, c), (c, a)))
    if inside:
        return abs((p - a) @ n) / np.linalg.norm(n)
    return min(to_edge(p, s, t) for s, t in ((a, b), (b, c), (c, a)))


def to_edge(p, a, b):
    """Return the distance of a point to an edge."""
    share = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(p - a - share * (b - a))


def of_edges(a, b, c, d):
    """Return the distance of two edges: of their lines between the ends, or from an end."""
    n = np.cross(b - a, d - c)
    s, t = np.linalg.lstsq(np.stack([b - a, c - d], 1), c - a, rcond=None)[0]
    if 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0:
        return abs((c - a) @ n) / np.linalg.norm(n)
    return min(to_edge(a, c, d), to_edge(b, c, d), to_edge(c, a, b), to_edge(d, a, b))
