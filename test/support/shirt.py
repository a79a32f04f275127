"""A T-shirt of two panels, front and back, as a mesh of triangles of about equal size."""

import numpy as np
from scipy.spatial import Delaunay

HEM, ARMPIT = (0.24, 0.0), (0.24, 0.43)
CUFF = (0.37, 0.36), (0.43, 0.49)
"""lower and upper end of a sleeve's opening"""
SHOULDER, NECK = (0.2, 0.625), (0.08, 0.655)
"""outer and inner end of a shoulder"""
DEPTH = {'back': 0.02, 'front': 0.08}
"""of the neckline below the shoulders' inner ends [m]"""
OFFSET = {'back': 1.0, 'front': 2 / 3}
"""height of the first row of particles, in rows: those of one panel are amid triangles of the
other"""
CLEAR = 0.5
"""least distance of particles to the outline in the beginning, relative to the spacing"""
ROUNDS, STEP, PRESSED = 30, 0.2, 1.2
"""particles push one another apart to more than the spacing (Persson and Strang 2004)"""


def shirt(spacing: float = 0.0125, gap: float = 0.008) -> tuple[np.ndarray, np.ndarray]:
    """
    Return vertices and triangles of a T-shirt that lies flat, with its front up.

    The panels have their particles in common along the seams: sides, undersides of the sleeves,
    shoulders and upper sides of the sleeves. Neck, sleeves and hem, at y = 0, are open.

    Parameters
    ----------
    spacing : distance of neighbours [m]
    gap : height of the front above the back [m]; seams are at half of it

    """
    (back, below, seam), (front, above, same) = (
        _panel(panel, spacing) for panel in ('back', 'front'))
    height = np.zeros(len(back))
    height[seam] = 0.5 * gap
    own = np.ones(len(front), bool)
    own[same] = False
    number = np.empty(len(front), np.int64)
    number[own] = len(back) + np.arange(own.sum())
    number[same] = seam
    vertices = np.concatenate([np.column_stack([back, height]),
                               np.column_stack([front[own], np.full(own.sum(), gap)])])
    return vertices.round(4), np.concatenate([below[:, ::-1], number[above]])


def _panel(name: str, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the particles of a panel, its counter-clockwise triangles, and which are on seams."""
    right, sewn = _right_side(spacing, name)
    outline = np.concatenate([right, right[-2:0:-1] * (-1.0, 1.0)])
    points = np.concatenate([outline, _lattice(outline, spacing, OFFSET[name])])
    for _ in range(ROUNDS):
        cells = _triangles(points, outline)
        ends = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])
        one, other = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0).T
        apart = points[one] - points[other]
        push = STEP * np.maximum(PRESSED * spacing / _length(apart) - 1.0, 0.0)[:, None] * apart
        move = np.column_stack([np.bincount(one, push[:, k]) for k in (0, 1)])
        points[len(outline):] += move[len(outline):]
    return points, _triangles(points, outline), np.flatnonzero([*sewn, *sewn[-2:0:-1]])


def _right_side(spacing: float, panel: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the outline of x ≥ 0 from the hem's middle to the neck's, and which is on seams."""
    x = np.linspace(NECK[0], 0.0, 41)
    neckline = np.column_stack([x, NECK[1] - DEPTH[panel] * (1.0 - (x / NECK[0])**2)])
    points, sewn = [], []
    for corners, is_sewn in (([(0.0, 0.0), HEM], False), ([HEM, ARMPIT], True),
                             ([ARMPIT, CUFF[0]], True), (CUFF, False),
                             ([CUFF[1], SHOULDER], True), ([SHOULDER, NECK], True),
                             (neckline, False)):
        points.append(_divided(np.array(corners), spacing))
        sewn.append(np.full(len(points[-1]), is_sewn))
        sewn[-1][0] |= len(sewn) > 1 and sewn[-2][-1]
    return np.concatenate([*points, neckline[-1:]]), np.concatenate([*sewn, [False]])


def _divided(line: np.ndarray, spacing: float) -> np.ndarray:
    """Return points at equal distances along a line through points, without its end."""
    at = np.concatenate([[0.0], np.cumsum(_length(line[1:] - line[:-1]))])
    count = round(at[-1] / spacing)
    places = np.arange(count) * (at[-1] / count)
    return np.column_stack([np.interp(places, at, line[:, k]) for k in (0, 1)])


def _lattice(outline: np.ndarray, spacing: float, offset: float) -> np.ndarray:
    """Return the points of a triangular lattice inside an outline."""
    row = 0.75**0.5 * spacing
    low, high = outline.min(0), outline.max(0)
    y = np.arange(low[1] + offset * row, high[1], row)[:, None]
    shift = 0.25 + 0.5 * (np.arange(len(y)) % 2)[:, None]
    x = np.arange(low[0], high[0], spacing) + shift * spacing
    points = np.stack(np.broadcast_arrays(x, y), -1).reshape(-1, 2)
    return points[_is_inside(points, outline) & (_distance(points, outline) > CLEAR * spacing)]


def _triangles(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Return the Delaunay triangles inside an outline, counter-clockwise."""
    cells = Delaunay(points).simplices.astype(np.int64)
    cells = cells[_is_inside(points[cells].mean(1), outline)]
    (ax, ay), (bx, by) = ((points[cells[:, k]] - points[cells[:, 0]]).T for k in (1, 2))
    turn = ax * by - ay * bx
    cells = np.where((turn < 0.0)[:, None], cells[:, ::-1], cells)
    return cells[np.abs(turn) > 0.01 * (ax**2 + ay**2)]    # without those along a straight side


def _is_inside(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Return which points are inside: rays from them cross the outline an odd number of times."""
    (x, y), odd = points.T, np.zeros(len(points), bool)
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0)):
        level = (ay > y) != (by > y)
        odd[level] ^= x[level] < ax + (y[level] - ay) * (bx - ax) / (by - ay)
    return odd


def _distance(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Return the distances of points to an outline [m]."""
    found = np.full(len(points), np.inf)
    for a, b in zip(outline, np.roll(outline, -1, axis=0)):
        way, off = b - a, points - a
        share = np.clip((off * way).sum(1) / (way * way).sum(), 0.0, 1.0)[:, None]
        found = np.minimum(found, _length(off - share * way))
    return found


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt((vectors**2).sum(-1))
