"""Colliders as Python has them: what each is, where it goes, and when it goes away."""

from dataclasses import dataclass, field

import numpy as np

from xpbd_ros.sim.commands import Pose, Twist
from xpbd_ros.sim.contact.collider_entries import Entry, shape_size, SHAPES
from xpbd_ros.sim.contact.colliders import inner, reach
from xpbd_ros.sim.contact.distance_field import Field
from xpbd_ros.sim.target_motion import monotone_cubic, Motion


@dataclass
class Placed:
    """One collider that is there."""

    entry: Entry
    motion: Motion
    twist: Twist | None = None
    """velocity of its surface, where that is not the pose's"""
    lifetime_ns: int = 0
    """it goes away by itself after this long without a word [ns]; 0: never"""
    expires_ns: int | None = None
    """when it goes away by itself"""
    field: Field | None = None
    """the distances to it, if it is a mesh"""
    heights: np.ndarray | None = None
    """[m], if it is ground; shape (along y, along x)"""

    def renew(self, now_ns: int) -> None:
        """Let its lifetime begin."""
        self.expires_ns = now_ns + self.lifetime_ns if self.lifetime_ns else None

    @property
    def reach(self) -> float:
        """The ball or half space that holds it, as the kernels have it."""
        if self.field is not None:
            return self.field.reach
        if self.heights is not None:
            return -1.0 - max(0.0, float(self.heights.max()))
        return reach(SHAPES[self.entry.shape], np.array(shape_size(self.entry)))

    @property
    def inner(self) -> float:
        """What moves no further in a substep cannot get through it [m]."""
        if self.field is not None:
            return 0.5 * self.field.spacing
        if self.heights is not None:
            across, along = self.entry.heights.size
            rows, columns = self.heights.shape
            return 0.5 * min(across / (columns - 1), along / (rows - 1))
        return inner(SHAPES[self.entry.shape], np.array(shape_size(self.entry)))


@dataclass(frozen=True)
class ColliderState:
    """One collider after a frame."""

    entry: Entry
    pose: Pose
    linear: np.ndarray = field(compare=False)
    """velocity [m/s], shape (3,)"""


def motion_of(entry: Entry, now: float) -> Motion:
    """Return how a collider moves from the start, at the simulation time ``now`` [s]."""
    keyframes, pose = None, entry.pose
    if entry.motion is not None:
        keyframes = monotone_cubic(entry.motion, now)
        pose = Pose(keyframes(now), pose.orientation)
    return Motion(pose, entry.max_speed, keyframes=keyframes)
