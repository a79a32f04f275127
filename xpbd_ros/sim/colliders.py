"""
Colliders: signed distance and normal of each shape, and poses across a frame.

The signed distance φ is positive outside; the normal is its gradient, a unit vector. Where the
gradient is undefined (a sphere's centre, a box's medial planes) a fixed axis of the shape stands
in, so the normal is always of length 1.
"""

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.rotation import interpolate, rotate

PLANE, SPHERE, CAPSULE, CYLINDER, BOX = range(5)


class Colliders(NamedTuple):
    """All colliders of a scene, with room for more."""

    count: np.ndarray
    """how many there are, shape (1,)"""
    shape: np.ndarray
    """PLANE …, shape (capacity,)"""
    size: np.ndarray
    """[m]: radius, half length along z, –; or half extents of a box; shape (capacity, 3)"""
    reach: np.ndarray
    """radius of a ball around the position that holds the shape [m]; -1: unbounded"""
    inner: np.ndarray
    """what moves no further than this in a substep cannot get through it [m]; inf: nothing can"""
    start: np.ndarray
    """pose at the frame's start: x y z, qx qy qz qw; shape (capacity, 7)"""
    goal: np.ndarray
    """pose at the frame's end, shape (capacity, 7)"""
    moving: np.ndarray
    """whether the two poses differ, shape (capacity,)"""
    twist: np.ndarray
    """surface velocity, linear [m/s] and angular [rad/s], where given; shape (capacity, 6)"""
    has_twist: np.ndarray
    """shape (capacity,)"""


def new_colliders(capacity: int) -> Colliders:
    """Return room for that many colliders, and none."""
    poses = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (capacity, 1))
    return Colliders(
        np.zeros(1, np.int64), np.zeros(capacity, np.int64), np.zeros((capacity, 3)),
        np.zeros(capacity), np.zeros(capacity), poses.copy(), poses,
        np.zeros(capacity, np.bool_), np.zeros((capacity, 6)), np.zeros(capacity, np.bool_))


@jit
def write_pose(colliders, c, s, poses):
    """Write the pose of collider c a fraction s into the frame."""
    a, b = colliders.start, colliders.goal
    for k in range(3):
        poses[c, k] = a[c, k] + s * (b[c, k] - a[c, k])
    if colliders.moving[c]:
        q = interpolate((a[c, 3], a[c, 4], a[c, 5], a[c, 6]),
                        (b[c, 3], b[c, 4], b[c, 5], b[c, 6]), s)
        poses[c, 3], poses[c, 4], poses[c, 5], poses[c, 6] = q
    else:
        for k in range(3, 7):
            poses[c, k] = a[c, k]


@jit(inline=True)
def to_local(p, c, x, y, z):
    """Bring a point of the world into the axes of collider c, whose pose is p[c]."""
    return rotate(-p[c, 3], -p[c, 4], -p[c, 5], p[c, 6], x - p[c, 0], y - p[c, 1], z - p[c, 2])


@jit(inline=True)
def to_world(p, c, x, y, z):
    """Bring a point in the axes of collider c into the world."""
    rx, ry, rz = rotate(p[c, 3], p[c, 4], p[c, 5], p[c, 6], x, y, z)
    return p[c, 0] + rx, p[c, 1] + ry, p[c, 2] + rz


@jit
def reach(shape, size):
    """Return the radius of a ball around the position that holds the shape [m]; -1: unbounded."""
    if shape == SPHERE:
        return size[0]
    if shape == CAPSULE:
        return size[0] + size[1]
    if shape == CYLINDER:
        return sqrt(size[0] * size[0] + size[1] * size[1])
    if shape == BOX:
        return sqrt(size[0] * size[0] + size[1] * size[1] + size[2] * size[2])
    return -1.0


@jit
def inner(shape, size):
    """Return half the smallest half extent [m]: what goes no deeper is nearest to where it was."""
    if shape == PLANE:
        return inf
    if shape in (SPHERE, CAPSULE):
        return 0.5 * size[0]
    if shape == CYLINDER:
        return 0.5 * min(size[0], size[1])
    return 0.5 * min(size[0], size[1], size[2])


@jit(inline=True)
def signed_distance(colliders, c, x, y, z):
    """Return φ [m] and the unit normal at a point in the axes of collider c."""
    return shape_distance(colliders.shape[c], colliders.size[c, 0], colliders.size[c, 1],
                          colliders.size[c, 2], x, y, z)


@jit(inline=True)
def shape_distance(shape, a, b, c, x, y, z):
    """Return φ [m] and the unit normal for a shape and its three sizes (``Colliders.size``)."""
    if shape == PLANE:
        return z, 0.0, 0.0, 1.0
    if shape == SPHERE:
        return _round(x, y, z, a)
    if shape == CAPSULE:
        return _round(x, y, z - min(max(z, -b), b), a)
    if shape == CYLINDER:
        return _cylinder(x, y, z, a, b)
    return _box(x, y, z, a, b, c)


@jit(inline=True)
def _round(x, y, z, radius):
    """Return the distance to a ball around the origin."""
    l = sqrt(x * x + y * y + z * z)
    if l > 0.0:
        return l - radius, x / l, y / l, z / l
    return -radius, 0.0, 0.0, 1.0


@jit(inline=True)
def _cylinder(x, y, z, radius, half):
    """Return the distance to a cylinder along z, closed by discs."""
    r = sqrt(x * x + y * y)
    rx, ry = (x / r, y / r) if r > 0.0 else (1.0, 0.0)
    up = 1.0 if z >= 0.0 else -1.0
    side, cap = r - radius, abs(z) - half
    if side > 0.0 and cap > 0.0:
        l = sqrt(side * side + cap * cap)
        return l, rx * side / l, ry * side / l, up * cap / l
    if side > cap:
        return side, rx, ry, 0.0
    return cap, 0.0, 0.0, up


@jit(inline=True)
def _box(x, y, z, a, b, c):
    """Return the distance to a box of half extents a, b, c."""
    sx = 1.0 if x >= 0.0 else -1.0
    sy = 1.0 if y >= 0.0 else -1.0
    sz = 1.0 if z >= 0.0 else -1.0
    qx, qy, qz = abs(x) - a, abs(y) - b, abs(z) - c
    ox, oy, oz = max(qx, 0.0), max(qy, 0.0), max(qz, 0.0)
    l = sqrt(ox * ox + oy * oy + oz * oz)
    if l > 0.0:
        return l, sx * ox / l, sy * oy / l, sz * oz / l
    if qx >= qy and qx >= qz:
        return qx, sx, 0.0, 0.0
    if qy >= qz:
        return qy, 0.0, sy, 0.0
    return qz, 0.0, 0.0, sz
