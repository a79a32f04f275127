"""Colliders outside the kernels: shape, motion and lifetime of each."""

from dataclasses import dataclass
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
