"""Colliders after a frame: poses, velocities, and the wrenches of the cloth on them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.quaternion import turns


@dataclass(frozen=True)
class ColliderState:
    """One collider after a frame."""

    entry: Any
    """``collider_entries.Entry``, which reads the scene's keys"""
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
    placed : ``collider.Placed`` by name
    start, goal : poses x, y, z, qx, qy, qz, qw at the frame's start and end, shape (colliders, 7)
    impulses : that the cloth gave each collider in the frame [N s, N m s], shape (colliders, 6)
    dt : length of the frame [s]

    """

    def __init__(self, placed: Mapping[str, Any], start: np.ndarray, goal: np.ndarray,
                 impulses: np.ndarray, dt: float):
        self.names = tuple(placed)
        self.poses = goal
        """at the frame's end, shape (colliders, 7)"""
        self._start, self._dt = start, dt
        self.wrenches = impulses / dt
        """force and torque of the cloth on each collider [N, N m], shape (colliders, 6)"""
        self._index = {name: k for k, name in enumerate(self.names)}
        self._entries = [each.entry for each in placed.values()]
        self._pose = [each.motion.pose for each in placed.values()]

    @cached_property
    def twists(self) -> np.ndarray:
        """Mean velocities in the frame [m/s, rad/s], shape (colliders, 6)."""
        way = self.poses[:, :3] - self._start[:, :3]
        return np.hstack([way, turns(self._start[:, 3:], self.poses[:, 3:])]) / self._dt

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
