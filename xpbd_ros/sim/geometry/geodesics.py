"""
Straight lines over a surface of triangles: from a particle across a few edges to another one.

The triangles that a line crosses are laid flat beside one another (J. Mitchell, D. Mount,
C. Papadimitriou, "The discrete geodesic problem", 1987). Each edge that is seen from a particle
has a window, the directions in which the line of sight crosses it; behind it lies one more
triangle, and that one's far corner is a straight line away if it is within the window.

Limits: where more than two triangles share an edge, no line crosses it.
"""

import numpy as np

from xpbd_ros.sim.geometry.mesh import length


def straight_lines(positions: np.ndarray, triangles: np.ndarray, across: int
                   ) -> tuple[np.ndarray, np.ndarray]:
    """
    Return pairs of particles with a straight line between them, and how long it is.

    Parameters
    ----------
    positions : [m], shape (particles, 3)
    triangles : particle indices, shape (triangles, 3)
    across : the most edges that a line crosses

    Returns
    -------
    particle indices in rising order, shape (pairs, 2); the shortest line of each pair [m]

    """
    beyond = _beyond(triangles)
    side = np.arange(triangles.size)    # a side has the number of the corner opposite to it
    source, right, left = (triangles[side // 3, (side + k) % 3] for k in range(3))
    from_right, from_left, base = (length(positions[p] - positions[q]) for p, q in (
        (source, right), (source, left), (right, left)))
    at_right, at_left = np.stack([from_right, 0.0 * base], 1), _apex(from_left, base, from_right)
    low, high = at_right, at_left    # the window
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
    """Return where a triangle's corner is by the side to it: along the base, and off it [m]."""
    s = (a * a - b * b + base * base) / (2.0 * base)
    return np.stack([s, np.sqrt(np.maximum(a * a - s * s, 0.0))], 1)


def _turn(a, b) -> np.ndarray:
    """Return a × b in the plane: positive where b lies to the left of a."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _beyond(triangles) -> np.ndarray:
    """Return the corner beyond the side opposite to each corner; -1 where there is not one."""
    sides = np.sort(triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), 1)
    _, side, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(side.reshape(-1), kind='stable')
    pairs = order[count[side.reshape(-1)[order]] == 2].reshape(-1, 2)
    found = np.full(triangles.size, -1)
    found[pairs] = pairs[:, ::-1]
    return found


def shortest(pairs, lines) -> tuple[np.ndarray, np.ndarray]:
    """Return each pair once, with the shortest of its lines."""
    pairs = np.sort(pairs, 1)
    order = np.lexsort((lines, pairs[:, 1], pairs[:, 0]))
    pairs, lines = pairs[order], lines[order]
    new = np.append(True, (pairs[1:] != pairs[:-1]).any(1))[:len(pairs)]
    return pairs[new], lines[new]
