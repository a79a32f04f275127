"""
Colliders: signed distance and normal of each shape, and poses across a frame.

The signed distance φ is positive outside; the normal is its gradient, a unit vector. Where the
gradient is undefined (a sphere's centre, a box's medial planes) a fixed axis of the shape stands
in, so the normal is always of length 1.
"""

from math import sqrt
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
    start: np.ndarray
    """pose at the frame's start: x y z, qx qy qz qw; shape (capacity, 7)"""
    goal: np.ndarray
    """pose at the frame's end, shape (capacity, 7)"""
    twist: np.ndarray
    """surface velocity, linear [m/s] and angular [rad/s], where given; shape (capacity, 6)"""
    has_twist: np.ndarray
    """shape (capacity,)"""
    friction: np.ndarray
    """coefficient, shape (capacity,)"""


@jit
def pose_at(colliders, c, s):
    """Return position and orientation of collider c a fraction s into the frame."""
    a, b = colliders.start[c], colliders.goal[c]
    return ((a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]), a[2] + s * (b[2] - a[2])),
            interpolate((a[3], a[4], a[5], a[6]), (b[3], b[4], b[5], b[6]), s))


@jit
def to_local(pose, x, y, z):
    """World point to the collider's axes."""
    p, q = pose
    return rotate(-q[0], -q[1], -q[2], q[3], x - p[0], y - p[1], z - p[2])


@jit
def to_world(pose, x, y, z):
    """Point in the collider's axes to the world."""
    p, q = pose
    rx, ry, rz = rotate(q[0], q[1], q[2], q[3], x, y, z)
    return p[0] + rx, p[1] + ry, p[2] + rz


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
def signed_distance(shape, size, x, y, z):
    """Return φ [m] and the unit normal at a point in the collider's axes."""
    if shape == PLANE:
        return z, 0.0, 0.0, 1.0
    if shape == SPHERE:
        return _round(x, y, z, size[0])
    if shape == CAPSULE:
        return _round(x, y, z - min(max(z, -size[1]), size[1]), size[0])
    if shape == CYLINDER:
        return _cylinder(x, y, z, size[0], size[1])
    return _box(x, y, z, size)


@jit
def _round(x, y, z, radius):
    """Return the distance to a ball around the origin."""
    l = sqrt(x * x + y * y + z * z)
    if l > 0.0:
        return l - radius, x / l, y / l, z / l
    return -radius, 0.0, 0.0, 1.0


@jit
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


@jit
def _box(x, y, z, half):
    """Return the distance to a box of the given half extents."""
    sx = 1.0 if x >= 0.0 else -1.0
    sy = 1.0 if y >= 0.0 else -1.0
    sz = 1.0 if z >= 0.0 else -1.0
    qx, qy, qz = abs(x) - half[0], abs(y) - half[1], abs(z) - half[2]
    ox, oy, oz = max(qx, 0.0), max(qy, 0.0), max(qz, 0.0)
    l = sqrt(ox * ox + oy * oy + oz * oz)
    if l > 0.0:
        return l, sx * ox / l, sy * oy / l, sz * oz / l
    if qx >= qy and qx >= qz:
        return qx, sx, 0.0, 0.0
    if qy >= qz:
        return qy, 0.0, sy, 0.0
    return qz, 0.0, 0.0, sz
