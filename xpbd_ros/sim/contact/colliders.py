"""
Colliders: signed distance and normal of each shape, and poses across a frame.

The signed distance φ is positive outside; the normal is its gradient, a unit vector. Where the
gradient is undefined (a sphere's centre, a box's medial planes) a fixed axis of the shape stands
in, so the normal is always of length 1.
"""

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.quaternion import interpolate, rotate

PLANE, SPHERE, CAPSULE, CYLINDER, BOX, MESH, HEIGHTS = range(7)


class Grids(NamedTuple):
    """Signed distances on grids (``contact.distance_field``), of the colliders that are meshes."""

    values: np.ndarray
    """φ [m], one grid after another; x slowest, z fastest"""
    first: np.ndarray
    """where each collider's grid begins, shape (capacity,)"""
    nodes: np.ndarray
    """along x, y, z; shape (capacity, 3)"""
    origin: np.ndarray
    """place of the first node in the collider's axes [m], shape (capacity, 3)"""
    spacing: np.ndarray
    """[m], shape (capacity,)"""
    pad: np.ndarray
    """least distance from the rim of the grid to the surface [m], shape (capacity,)"""


class Heights(NamedTuple):
    """Heights of the colliders that are ground."""

    values: np.ndarray
    """[m], one field after another; y slowest, x fastest"""
    first: np.ndarray
    """where each collider's field begins, shape (capacity,)"""
    nodes: np.ndarray
    """along x, y; shape (capacity, 2)"""


class Colliders(NamedTuple):
    """All colliders of a scene, with room for more."""

    count: np.ndarray
    """how many there are, shape (1,)"""
    shape: np.ndarray
    """PLANE …, shape (capacity,)"""
    size: np.ndarray
    """[m]: radius, half length along z, –; half extents of a box; half extents of ground and its
    ``steepness`` [1]; shape (capacity, 3)"""
    reach: np.ndarray
    """radius of a ball around the position that holds the shape [m]; -1 - z: the half space below
    z does"""
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
    grids: Grids | None
    """None where no collider is a mesh"""
    heights: Heights | None
    """None where none is ground"""


def new_colliders(capacity: int, nodes: int = 0, places: int = 0) -> Colliders:
    """Return room for that many colliders, nodes of grids and heights, and none of them."""
    poses = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (capacity, 1))
    return Colliders(
        np.zeros(1, np.int64), np.zeros(capacity, np.int64), np.zeros((capacity, 3)),
        np.zeros(capacity), np.zeros(capacity), poses.copy(), poses,
        np.zeros(capacity, np.bool_), np.zeros((capacity, 6)), np.zeros(capacity, np.bool_),
        Grids(np.zeros(nodes, np.float32), np.zeros(capacity, np.int64),
              np.zeros((capacity, 3), np.int64), np.zeros((capacity, 3)), np.zeros(capacity),
              np.zeros(capacity)) if nodes else None,
        Heights(np.zeros(places), np.zeros(capacity, np.int64),
                np.zeros((capacity, 2), np.int64)) if places else None)


def write_grid(grids: Grids, c: int, field, first: int) -> None:
    """Write the distance field of collider c, from a node on."""
    values = field.values.ravel()
    grids.values[first:first + values.size] = values
    grids.first[c], grids.nodes[c] = first, field.values.shape
    grids.origin[c], grids.spacing[c], grids.pad[c] = field.origin, field.spacing, field.pad


def write_heights(heights: Heights, c: int, values: np.ndarray, first: int) -> None:
    """Write the heights of collider c [m], shape (along y, along x), from a place on."""
    heights.values[first:first + values.size] = values.ravel()
    heights.first[c], heights.nodes[c] = first, values.shape[::-1]


def steepness(values: np.ndarray, size: tuple[float, float]) -> float:
    """Return √(1 + S²), S the largest slope of heights over a rectangle of this size."""
    along_x = np.abs(np.diff(values, axis=1)).max() * (values.shape[1] - 1) / size[0]
    along_y = np.abs(np.diff(values, axis=0)).max() * (values.shape[0] - 1) / size[1]
    return float(np.sqrt(1.0 + along_x**2 + along_y**2))


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


