"""Distances of triangles and edges."""

import numpy as np


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
