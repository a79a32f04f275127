"""Colliders outside the kernels: shape, motion and lifetime of each, and states after a frame."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import inf

import numpy as np

from xpbd_ros.sim.commands import Pose, Twist
from xpbd_ros.sim.contact.collider_entries import Entry, shape_size, SHAPES
from xpbd_ros.sim.contact.colliders import (
    Colliders,
    inner,
    reach,
    steepness,
    write_grid,
    write_heights,
)
from xpbd_ros.sim.contact.distance_field import Field
from xpbd_ros.sim.geometry.quaternion import turns
from xpbd_ros.sim.target_motion import MonotoneCubic, Motion


@dataclass
class Placed:
    """One collider in the simulation."""

    entry: Entry
    motion: Motion
    twist: Twist | None = None
    """velocity of its surface, such as a conveyor's; None: that of the pose"""
    lifetime_ns: int = 0
    """it is removed after this time without a command [ns]; 0: never"""
    expires_ns: int | None = None
    """simulation time at which it is removed [ns]; None: never"""
    field: Field | None = None
    """signed distance field of a mesh; None for other shapes"""
    heights: np.ndarray | None = None
    """[m], shape (along y, along x); None unless the shape is ``heights``"""

    def renew(self, now_ns: int) -> None:
        """Restart the lifetime at the simulation time ``now_ns`` [ns]."""
        self.expires_ns = now_ns + self.lifetime_ns if self.lifetime_ns else None

    @property
    def reach(self) -> float:
        """Bounding sphere or half space, encoded as ``Colliders.reach``."""
        if self.field is not None:
            return self.field.reach
        if self.heights is not None:
            return -1.0 - max(0.0, float(self.heights.max()))
        return reach(SHAPES[self.entry.shape], np.array(shape_size(self.entry)))

    @property
    def inner(self) -> float:
        """Relative motion in a substep up to which no particle passes through it [m]."""
        if self.field is not None:
            return 0.5 * self.field.spacing
        if self.heights is not None:
            assert self.entry.heights is not None
            across, along = self.entry.heights.size
            rows, columns = self.heights.shape
            return 0.5 * min(across / (columns - 1), along / (rows - 1))
        return inner(SHAPES[self.entry.shape], np.array(shape_size(self.entry)))

    @property
    def depth(self) -> float:
        """Penetration up to which its pad presses a particle between two colliders [m]."""
        if self.field is not None:
            return 0.5 * max(self.field.spacing, -float(self.field.values.min()))
        return inf if self.heights is not None else self.inner


@dataclass(frozen=True)
class ColliderState:
    """One collider after a frame."""

    entry: Entry
    pose: Pose
    linear: np.ndarray = field(compare=False)
    """velocity [m/s], shape (3,)"""
    angular: np.ndarray = field(compare=False)
    """angular velocity, world axes [rad/s], shape (3,)"""
    force: np.ndarray = field(compare=False)
    """of the cloth on the collider, mean over the frame [N], shape (3,)"""
    torque: np.ndarray = field(compare=False)
    """about its position, world axes [N m], shape (3,)"""


class ColliderStates(Mapping[str, ColliderState]):
    """
    All colliders after a frame, by name, stored as arrays: cheap where nothing reads them.

    Parameters
    ----------
    placed : colliders by name
    start, goal : poses x, y, z, qx, qy, qz, qw at the frame's start and end, shape (colliders, 7)
    impulses : that the cloth gave each collider in the frame [N s, N m s], shape (colliders, 6)
    dt : length of the frame [s]

    """

    def __init__(self, placed: Mapping[str, Placed], start: np.ndarray, goal: np.ndarray,
                 impulses: np.ndarray, dt: float):
        self.names = tuple(placed)
        self.poses = goal
        """at the frame's end, shape (colliders, 7)"""
        way = goal[:, :3] - start[:, :3]
        self.twists = np.hstack([way, turns(start[:, 3:], goal[:, 3:])]) / dt
        """[m/s, rad/s], shape (colliders, 6)"""
        self.wrenches = impulses / dt
        """force and torque of the cloth on each collider [N, N m], shape (colliders, 6)"""
        self._index = {name: k for k, name in enumerate(self.names)}
        self._entries = [each.entry for each in placed.values()]
        self._pose = [each.motion.pose for each in placed.values()]

    def __getitem__(self, name: str) -> ColliderState:
        """Return the state of one collider."""
        k = self._index[name]
        twist, wrench = self.twists[k].copy(), self.wrenches[k].copy()
        return ColliderState(self._entries[k], self._pose[k], twist[:3], twist[3:], wrench[:3],
                             wrench[3:])

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self.names)

    def __len__(self) -> int:
        """Return the number of colliders."""
        return len(self.names)


def motion_of(entry: Entry) -> Motion:
    """Return a collider's initial motion."""
    keyframes, pose = None, entry.pose
    if entry.motion is not None:
        keyframes = MonotoneCubic(entry.motion)
        pose = Pose(keyframes(0.0), pose.orientation)
    return Motion(pose, entry.max_speed, keyframes=keyframes, begins_at_target=bool(entry.frame))


def write_shape(colliders: Colliders, c: int, placed: Placed, nodes: int,
                places: int) -> tuple[int, int]:
    """
    Write the shape of collider c into the kernels' arrays.

    ``nodes`` and ``places`` tell how much of the room for meshes and for heights is taken; they
    are returned with what this one takes.
    """
    entry = placed.entry
    colliders.shape[c], colliders.size[c] = SHAPES[entry.shape], shape_size(entry)
    colliders.reach[c], colliders.inner[c] = placed.reach, placed.inner
    if placed.field is not None:
        assert colliders.grids is not None
        write_grid(colliders.grids, c, placed.field, nodes)
        nodes += placed.field.values.size
    if placed.heights is not None:
        assert colliders.heights is not None and entry.heights is not None
        write_heights(colliders.heights, c, placed.heights, places)
        colliders.size[c, 2] = steepness(placed.heights, entry.heights.size)
        places += placed.heights.size
    return nodes, places
