"""
Colliders for the kernels: shapes, poses across a frame, bounds for the broad phase.

The signed distance φ (``contact.signed_distance``) is positive outside; the normal is its
gradient, a unit vector. Where the gradient is undefined (a sphere's centre, a box's medial planes)
the normal is a fixed axis of the shape.
"""

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.quaternion import interpolate, rotate

PLANE, SPHERE, CAPSULE, CYLINDER, BOX, MESH, HEIGHTS = range(7)


class Grids(NamedTuple):
    """Signed distance grids (``contact.distance_field``) of the mesh colliders."""

    values: np.ndarray
    """φ [m] of all grids, each with x slowest and z fastest, shape (nodes,)"""
    first: np.ndarray
    """index of each collider's first node in ``values``, shape (capacity,)"""
    nodes: np.ndarray
    """number of nodes along x, y, z, shape (capacity, 3)"""
    origin: np.ndarray
    """position of the first node in the collider's axes [m], shape (capacity, 3)"""
    spacing: np.ndarray
    """[m], shape (capacity,)"""
    clearance: np.ndarray
    """least distance from the boundary of the grid to the surface [m], shape (capacity,)"""


class Heights(NamedTuple):
    """Height fields of the ``heights`` colliders."""

    values: np.ndarray
    """heights [m] of all fields, each with y slowest and x fastest, shape (nodes,)"""
    first: np.ndarray
    """index of each collider's first node in ``values``, shape (capacity,)"""
    nodes: np.ndarray
    """number of nodes along x, y, shape (capacity, 2)"""


class Colliders(NamedTuple):
    """All colliders of a scene."""

    count: np.ndarray
    """number of colliders, shape (1,)"""
    shape: np.ndarray
    """PLANE …, shape (capacity,)"""
    size: np.ndarray
    """[m]: radius and half length along z; half extents of a box; half extents of a height field
    and its ``steepness`` [1]; shape (capacity, 3)"""
    reach: np.ndarray
    """radius of the bounding sphere around the position [m]; negative, -1 - z: the shape is
    bounded by the half space below z; shape (capacity,)"""
    inner: np.ndarray
    """relative motion in a substep up to which no particle passes through it [m]; inf: never;
    shape (capacity,)"""
    start: np.ndarray
    """pose at the frame's start: x, y, z, qx, qy, qz, qw; shape (capacity, 7)"""
    goal: np.ndarray
    """pose at the frame's end, shape (capacity, 7)"""
    moving: np.ndarray
    """True if the two poses differ, shape (capacity,)"""
    twist: np.ndarray
    """surface velocity, linear [m/s] and angular [rad/s], shape (capacity, 6)"""
    has_twist: np.ndarray
    """True if ``twist`` is given; else it follows from the poses; shape (capacity,)"""
    grids: Grids | None
    """None without capacity for meshes"""
    heights: Heights | None
    """None without capacity for height fields"""
    stiffness: np.ndarray | None
    """foundation modulus of each pad [Pa/m], 0 of a rigid collider, shape (capacity,); None in a
    scene without pads"""
    depth: np.ndarray | None
    """penetration up to which a pad presses a particle between two colliders [m], inf: always;
    shape (capacity,); None in a scene without pads"""


def new_colliders(capacity: int, nodes: int, places: int, *,
                  pads: bool = False) -> Colliders:
    """Return an empty set with capacity for colliders, grid nodes and height field nodes."""
    poses = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (capacity, 1))
    return Colliders(
        np.zeros(1, np.int64), np.zeros(capacity, np.int64), np.zeros((capacity, 3)),
        np.zeros(capacity), np.zeros(capacity), poses.copy(), poses,
        np.zeros(capacity, np.bool_), np.zeros((capacity, 6)), np.zeros(capacity, np.bool_),
        Grids(np.zeros(nodes, np.float32), np.zeros(capacity, np.int64),
              np.zeros((capacity, 3), np.int64), np.zeros((capacity, 3)), np.zeros(capacity),
              np.zeros(capacity)) if nodes else None,
        Heights(np.zeros(places), np.zeros(capacity, np.int64),
                np.zeros((capacity, 2), np.int64)) if places else None,
        np.zeros(capacity) if pads else None, np.zeros(capacity) if pads else None)


@jit(inline=True)
def is_on_pad(pads, k):
    """Return True if a pad presses candidate k; ``pads`` is that of ``Contacts``."""
    if pads is None:
        return False
    else:    # Numba prunes the branch that is not taken
        return pads.soft[k]


@jit(inline=True)
def has_pad(stiffness, c):
    """Return True if collider c has a pad; ``stiffness`` is that of ``Colliders``."""
    if stiffness is None:
        return False
    else:    # Numba prunes the branch that is not taken
        return stiffness[c] > 0.0


def write_grid(grids: Grids, c: int, field, first: int) -> None:
    """Write the distance field of collider c to the nodes from ``first`` on."""
    values = field.values.ravel()
    grids.values[first:first + values.size] = values
    grids.first[c], grids.nodes[c] = first, field.values.shape
    grids.origin[c], grids.spacing[c] = field.origin, field.spacing
    grids.clearance[c] = field.clearance


def write_heights(heights: Heights, c: int, values: np.ndarray, first: int) -> None:
    """Write the heights of collider c [m], (along y, along x), to the nodes from ``first`` on."""
    heights.values[first:first + values.size] = values.ravel()
    heights.first[c], heights.nodes[c] = first, values.shape[::-1]


def steepness(values: np.ndarray, size: tuple[float, float]) -> float:
    """Return √(1 + S²), S the largest slope of heights over a rectangle of this size."""
    along_x = np.abs(np.diff(values, axis=1)).max() * (values.shape[1] - 1) / size[0]
    along_y = np.abs(np.diff(values, axis=0)).max() * (values.shape[0] - 1) / size[1]
    return float(np.sqrt(1.0 + along_x**2 + along_y**2))


@jit
def write_pose(colliders, c, s, poses):
    """Write the pose of collider c at fraction s of the frame to ``poses``, (capacity, 7)."""
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
    """Transform a point from world axes to those of collider c, whose pose is p[c]."""
    return rotate(-p[c, 3], -p[c, 4], -p[c, 5], p[c, 6], x - p[c, 0], y - p[c, 1], z - p[c, 2])


@jit(inline=True)
def to_world(p, c, x, y, z):
    """Transform a point from the axes of collider c, whose pose is p[c], to world axes."""
    rx, ry, rz = rotate(p[c, 3], p[c, 4], p[c, 5], p[c, 6], x, y, z)
    return p[c, 0] + rx, p[c, 1] + ry, p[c, 2] + rz


@jit(inline=True)
def vectors_to_local(p, c, x, y, z):
    """Do the same as ``to_local`` by lanes; quicker for a collider that is not rotated."""
    dx, dy, dz = x - p[c, 0], y - p[c, 1], z - p[c, 2]
    if p[c, 3] == 0.0 and p[c, 4] == 0.0 and p[c, 5] == 0.0:
        return dx, dy, dz
    return rotate(-p[c, 3], -p[c, 4], -p[c, 5], p[c, 6], dx, dy, dz)


@jit(inline=True)
def normals_to_world(p, c, x, y, z):
    """Rotate vectors from the axes of collider c by lanes."""
    if p[c, 3] == 0.0 and p[c, 4] == 0.0 and p[c, 5] == 0.0:
        return x, y, z
    return rotate(p[c, 3], p[c, 4], p[c, 5], p[c, 6], x, y, z)


@jit
def reach(shape, size):
    """Return the radius of the bounding sphere around the position [m]; -1: half space z < 0."""
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
    """
    Return half the smallest half extent of a shape [m].

    A particle that enters no deeper is still closest to the side that it came from.
    """
    if shape == PLANE:
        return inf
    if shape in (SPHERE, CAPSULE):
        return 0.5 * size[0]
    if shape == CYLINDER:
        return 0.5 * min(size[0], size[1])
    return 0.5 * min(size[0], size[1], size[2])


