"""Turned and rounded solids about their own origin: points, triangles and normals."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from xpbd_ros.study.picture.vectors import unit


def _lathe(radius: ArrayLike, height: ArrayLike, normal: ArrayLike, around: int) -> tuple:
    """Turn a profile, from the bottom up and with its normals (k, 2), about z."""
    radius, height, normal = (np.asarray(value, dtype=float) for value in (radius, height, normal))
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(around)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    points = radius[:, None, None] * ring + height[:, None, None] * up
    normals = normal[:, :1, None] * ring + normal[:, 1:, None] * up
    row, column = np.meshgrid(np.arange(len(radius) - 1), np.arange(around), indexing='ij')
    following = (column + 1) % around
    a, b = row * around + column, row * around + following
    c, d = a + around, b + around
    triangles = np.stack([np.stack([a, b, d], -1), np.stack([a, d, c], -1)], -2)
    return points.reshape(-1, 3), triangles.reshape(-1, 3), normals.reshape(-1, 3)


def join(parts: Sequence[tuple]) -> tuple:
    starts = np.cumsum([0] + [len(points) for points, _, _ in parts])
    return (np.concatenate([points for points, _, _ in parts]),
            np.concatenate([t + start for (_, t, _), start in zip(parts, starts)]),
            np.concatenate([normals for _, _, normals in parts]))


def capsule(radius: float, length: float) -> tuple:
    """Two half balls and the wall between; a length of 0 makes a ball."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 26)
    shift = np.where(angle < 0, -length / 2, length / 2)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rise = radius * normal[:, 1] + shift
    if length:    # rings along the wall, where the light of the sky changes
        wall = np.linspace(-length / 2, length / 2, 12)
        rise = np.concatenate([rise[:13], wall, rise[13:]])
        normal = np.concatenate([normal[:13], np.tile([1.0, 0.0], (12, 1)), normal[13:]])
    return _lathe(radius * normal[:, 0], rise, normal, 56)


def cylinder(radius: float, length: float, *, top: float = 1.0, around: int = 56) -> tuple:
    """Wall and two lids; ``top`` is the share of the radius at the upper end (0: a cone)."""
    level, share = np.linspace(-length / 2, length / 2, 10), np.linspace(0, 1, 8)
    slope = unit([length, radius * (1 - top)])
    wall = _lathe(np.linspace(radius, radius * top, 10), level, np.tile(slope, (10, 1)), around)
    under = _lathe(radius * share, np.full(8, -length / 2), np.tile([0.0, -1.0], (8, 1)), around)
    above = _lathe(radius * top * share[::-1], np.full(8, length / 2),
                   np.tile([0.0, 1.0], (8, 1)), around)
    return join([under, wall, above])


def box(size: ArrayLike, cells: int = 10, bend: int = 4) -> tuple:
    """
    Six faces, in cells so that the light of the sky can change across them, and rounded edges.

    Rounding pushes each point of the sharp box out from a smaller box by the radius. Without it,
    the edges would cut through cloth whose triangles bridge them.
    """
    half = np.asarray(size, dtype=float) / 2
    radius = 0.12 * half.min()
    inner = half - radius
    curve = radius * np.tan(np.linspace(0, np.pi / 4, bend + 1)[1:])
    lines = [np.concatenate([-c - curve[::-1], np.linspace(-c, c, cells + 1), c + curve])
             for c in inner]
    last = cells + 2 * bend
    i, j = np.meshgrid(np.arange(last), np.arange(last), indexing='ij')
    a = i * (last + 1) + j
    b, c, d = a + last + 1, a + last + 2, a + 1
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], -2).reshape(-1, 3)
    faces = []
    for axis in range(3):
        side, rise = (axis + 1) % 3, (axis + 2) % 3
        sharp = np.empty((last + 1, last + 1, 3))
        sharp[..., side], sharp[..., rise] = np.meshgrid(lines[side], lines[rise], indexing='ij')
        for sign in (1, -1):
            sharp[..., axis] = sign * half[axis]
            core = np.clip(sharp, -inner, inner).reshape(-1, 3)
            normals = unit(sharp.reshape(-1, 3) - core)
            faces.append((core + radius * normals, triangles[:, ::sign], normals))
    return join(faces)
