"""Triangles of the polygons of a mesh file: fans, and ears where a fan would overlap."""

from collections.abc import Callable, Sequence

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.geometry.mesh import cross, dot, length

ROUNDING = 1e-9
"""areas below this, relative to the square of the polygon's extent, are taken for 0"""


def triangulated(vertices: np.ndarray, polygons: Sequence[Sequence[int]],
                 where: Callable[[int], str]) -> np.ndarray:
    """
    Return the triangles of plane polygons, shape (triangles, 3).

    Convex polygons, and others that their first corner sees whole, become fans around it; the rest
    loses one ear after the other.

    Parameters
    ----------
    vertices : shape (vertices, 3)
    polygons : vertex indices of each polygon, 3 at least
    where : names a polygon, for error messages

    Raises
    ------
    InputError : a polygon crosses itself

    """
    fans = [[(corners[0], b, c) for b, c in zip(corners[1:-1], corners[2:])]
            for corners in polygons]
    for k in _overlapping(vertices, polygons, fans):
        fans[k] = _without_ears(vertices, polygons[k], where(k))
    return np.array([triangle for fan in fans for triangle in fan], np.int64).reshape(-1, 3)


def _overlapping(vertices: np.ndarray, polygons, fans: list) -> list[int]:
    """Return the indices of fans with triangles against the polygon's vector area."""
    large = [k for k, fan in enumerate(fans) if len(fan) > 1]
    if not large or max(max(polygons[k]) for k in large) >= len(vertices):    # refused later
        return []
    owner = np.repeat(np.arange(len(large)), [len(fans[k]) for k in large])
    x = vertices[np.array([triangle for k in large for triangle in fans[k]])]
    with np.errstate(all='ignore'):    # of numbers that surface_mesh refuses
        x = x / np.abs(x).max()
        area = cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        whole = np.zeros((len(large), 3))
        np.add.at(whole, owner, area)
        size = length(area)
        against = dot(area, whole[owner]) < -ROUNDING * size * length(whole)[owner]
        empty = length(whole) < ROUNDING * np.bincount(owner, size)
    return [large[k] for k in np.union1d(owner[against], np.flatnonzero(empty))]


def _without_ears(vertices: np.ndarray, corners: Sequence[int], where: str
                  ) -> list[tuple[int, int, int]]:
    """Return the triangles of a polygon by cutting the best-shaped ear until none is left."""
    p = _flat(vertices[list(corners)])
    cannot = InputError(f'{where}: the polygon crosses itself or lies in a line, so it cannot be '
                        'split; split it into triangles in the program that made the file')
    if _crosses_itself(p):
        raise cannot
    left, found = np.arange(len(p)), []
    while len(left) > 2:
        before, after = np.roll(left, 1), np.roll(left, -1)
        area = _turn(p[before], p[left], p[after])
        longest = np.max([((p[one] - p[other])**2).sum(1) for one, other in (
            (before, left), (left, after), (after, before))], axis=0)
        good = np.flatnonzero(area > ROUNDING)
        for k in good[np.argsort(-area[good] / longest[good], kind='stable')]:
            ear = before[k], left[k], after[k]
            if not _holds_any(p[list(ear)], p[left]):
                break
        else:
            raise cannot
        found.append((corners[ear[0]], corners[ear[1]], corners[ear[2]]))
        left = np.delete(left, k)
    return found


def _flat(x: np.ndarray) -> np.ndarray:
    """Return a polygon's corners in its plane, counter-clockwise, of extent 1."""
    x = (x - x[0]) / np.abs(x - x[0]).max()
    normal = cross(x, np.roll(x, -1, 0)).sum(0)
    drop = int(np.argmax(np.abs(normal)))
    flat = x[:, [(drop + 1) % 3, (drop + 2) % 3]]
    return flat if normal[drop] >= 0.0 else flat[:, ::-1]


def _turn(a, b, c) -> np.ndarray:
    """Return twice the signed areas of triangles."""
    u, v = b - a, c - a
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _crosses_itself(p: np.ndarray) -> bool:
    """Return whether two edges cross within both of them."""
    a, b = p, np.roll(p, -1, 0)
    return any(((_turn(c, d, a) * _turn(c, d, b) < 0.0)
                & (_turn(a, b, c) * _turn(a, b, d) < 0.0)).any() for c, d in zip(a, b))


def _holds_any(triangle: np.ndarray, points: np.ndarray) -> bool:
    """Return whether a triangle holds a point that is not one of its corners."""
    a, b, c = triangle
    inside = np.min([_turn(a, b, points), _turn(b, c, points), _turn(c, a, points)],
                    axis=0) > -ROUNDING
    return bool((inside & ~(points[:, None] == triangle).all(2).any(1)).any())
