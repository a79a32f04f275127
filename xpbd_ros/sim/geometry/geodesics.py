"""
Straight geodesics on a triangle mesh, from a particle across a few edges to another particle.

The triangles that a line crosses are unfolded into a plane (J. Mitchell, D. Mount,
C. Papadimitriou, "The discrete geodesic problem", 1987). Each edge visible from a source particle
has a window: the range of directions in which lines from the source cross it. A straight line
reaches the far corner of the triangle behind the edge if that corner's direction is in the window.

Limits: no line crosses an edge that more than two triangles share.
"""

import numpy as np

from xpbd_ros.sim.geometry.mesh import length


def straight_lines(positions: np.ndarray, triangles: np.ndarray, across: int
                   ) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the pairs of particles connected by a straight line, and its length.

    Parameters
    ----------
    positions : [m], shape (particles, 3)
    triangles : particle indices, shape (triangles, 3)
    across : largest number of edges that a line crosses

    Returns
    -------
    particle indices in rising order, shape (pairs, 2); length of each pair's shortest line [m],
    shape (pairs,)

    """
    beyond = _neighbour_corners(triangles)
    side = np.arange(triangles.size)    # sides are numbered as the corners opposite to them
    source, right, left = (triangles[side // 3, (side + k) % 3] for k in range(3))
    from_right, from_left, base = (length(positions[p] - positions[q]) for p, q in (
        (source, right), (source, left), (right, left)))
    at_right, at_left = np.stack([from_right, 0.0 * base], 1), _apex(from_left, base, from_right)
    low, high = at_right, at_left    # points on the two rays that bound the window
    pairs, lines = [np.zeros((0, 2), triangles.dtype)], [np.zeros(0)]
    for _ in range(across):
        on = beyond[side] >= 0
        source, right, left, at_right, at_left, low, high, far = (each[on] for each in (
            source, right, left, at_right, at_left, low, high, beyond[side]))
        triangle, corner = np.divmod(far, 3)
        apex = triangles[triangle, corner]
        from_right, from_left, base = (length(positions[p] - positions[q]) for p, q in (
            (right, apex), (left, apex), (right, left)))
        along = (at_left - at_right) / base[:, None]
        s = _apex(from_right, from_left, base)
        x = at_right + s[:, :1] * along + s[:, 1:] * (along[:, ::-1] * [1.0, -1.0])
        after, before = _turn(low, x) >= 0.0, _turn(x, high) >= 0.0
        seen = after & before & (apex != source)
        pairs.append(np.stack([source, apex], 1)[seen])
        lines.append(np.sqrt((x[seen]**2).sum(1)))
        turned = triangles[triangle, (corner + 1) % 3] == left
        of_left, of_right = (3 * triangle + (corner + 1 + (turned == away)) % 3
                             for away in (False, True))
        source, right, left, at_right, at_left, low, high, side = (
            np.concatenate([on_right[after], on_left[before]]) for on_right, on_left in (
                (source, source), (right, apex), (apex, left), (at_right, x), (x, at_left),
                (low, np.where(after[:, None], x, low)),
                (np.where(before[:, None], x, high), high), (of_left, of_right)))
    return shortest(np.concatenate(pairs), np.concatenate(lines))


def _apex(a, b, base) -> np.ndarray:
    """
    Return a triangle's corner in coordinates along and perpendicular to its base [m].

    ``a`` and ``b`` are the lengths of the sides from the base's start and end to the corner [m],
    shape (n,); the result's shape is (n, 2).
    """
    s = (a * a - b * b + base * base) / (2.0 * base)
    return np.stack([s, np.sqrt(np.maximum(a * a - s * s, 0.0))], 1)


def _turn(a, b) -> np.ndarray:
    """Return a × b of vectors in the plane, shape (n,): positive where b is to the left of a."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _neighbour_corners(triangles) -> np.ndarray:
    """
    Return the corner behind the side opposite to each corner, shape (3 · triangles,).

    Corner k of triangle t has the number 3 t + k; -1 where the side has not exactly one neighbour.
    """
    sides = np.sort(triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), 1)
    _, side, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(side.reshape(-1), kind='stable')
    pairs = order[count[side.reshape(-1)[order]] == 2].reshape(-1, 2)
    found = np.full(triangles.size, -1)
    found[pairs] = pairs[:, ::-1]
    return found


def shortest(pairs, lines) -> tuple[np.ndarray, np.ndarray]:
    """Return the unique pairs (n, 2) and the length of the shortest line of each [m], (n,)."""
    pairs = np.sort(pairs, 1)
    order = np.lexsort((lines, pairs[:, 1], pairs[:, 0]))
    pairs, lines = pairs[order], lines[order]
    new = np.append(True, (pairs[1:] != pairs[:-1]).any(1))[:len(pairs)]
    return pairs[new], lines[new]
