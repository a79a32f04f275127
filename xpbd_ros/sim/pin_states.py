"""Pins as Python has them: what each holds, where it goes, and what it feels."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.effect import Cloth
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.geometry.quaternion import turns
from xpbd_ros.sim.particles.state import places
from xpbd_ros.sim.target_motion import Motion


@dataclass
class Held:
    """One pin that holds."""

    name: str
    slot: int
    motion: Motion
    particles: np.ndarray
    """slots, shape (k,)"""
    offsets: np.ndarray
    """[m], in the pin's axes, shape (k, 3)"""
    compliance: float = 0.0
    """of the whole pin [m/N]; 0: its particles are pinned"""
    slip: float | None = None
    """force at which it lets go [N]"""
    lifetime_ns: int = 0
    """it lets go by itself after this long without a word [ns]; 0: never"""
    expires_ns: int | None = None
    """when it lets go by itself"""

    def renew(self, now_ns: int) -> None:
        """Let its lifetime begin."""
        self.expires_ns = now_ns + self.lifetime_ns if self.lifetime_ns else None


@dataclass(frozen=True)
class PinState:
    """One pin after a frame."""

    pose: Pose
    linear: np.ndarray = field(compare=False)
    """velocity [m/s], shape (3,)"""
    angular: np.ndarray = field(compare=False)
    """velocity of the turn [rad/s], shape (3,)"""
    force: np.ndarray = field(compare=False)
    """of the cloth on the gripper [N], shape (3,)"""
    torque: np.ndarray = field(compare=False)
    """about the pose [N m], shape (3,)"""
    particles: np.ndarray = field(compare=False)
    """numbers of what it holds, in the natural order of a frame; shape (k,)"""
    limited: bool = False
    """whether it lags behind its target at max_speed"""


class PinStates(Mapping[str, PinState]):
    """
    All pins after a frame, by name; as arrays, so that many of them take no time.

    Parameters
    ----------
    held : the pins
    start, goal : poses at the frame's start and end: x y z, qx qy qz qw; shape (pins, 7)
    wrenches : of the cloth on each [N, N m], shape (pins, 6)
    numbers : of the particles in natural order, by slot
    dt : length of the frame [s]

    """

    def __init__(self, held: Sequence[Held], start: np.ndarray, goal: np.ndarray,
                 wrenches: np.ndarray, numbers: np.ndarray, dt: float):
        self.names = tuple(one.name for one in held)
        self.poses = goal
        """shape (pins, 7)"""
        way = goal[:, :3] - start[:, :3]
        self.twists = np.hstack([way, turns(start[:, 3:], goal[:, 3:])]) / dt
        """[m/s, rad/s], shape (pins, 6)"""
        self.wrenches = wrenches
        """[N, N m], shape (pins, 6)"""
        self._index = {name: k for k, name in enumerate(self.names)}
        self._pose = [one.motion.pose for one in held]
        self._limited = [one.motion.limited for one in held]
        self._particles, self._numbers = [one.particles for one in held], numbers

    def __getitem__(self, name: str) -> PinState:
        """Return one of them."""
        k = self._index[name]
        return PinState(self._pose[k], self.twists[k, :3].copy(), self.twists[k, 3:].copy(),
                        self.wrenches[k, :3].copy(), self.wrenches[k, 3:].copy(),
                        self._numbers[self._particles[k]], self._limited[k])

    def __iter__(self) -> Iterator[str]:
        """Go through the names, in the order of the grasps."""
        return iter(self.names)

    def __len__(self) -> int:
        """Return how many hold."""
        return len(self.names)


def chosen(name: str, entry, cloths: dict[str, Cloth], x: np.ndarray) -> np.ndarray:
    """Return the particles that an entry of the scene names."""
    if entry.cloth not in cloths:
        raise InputError(f"pins.{name}.cloth: unknown cloth '{entry.cloth}' "
                         f'(known: {", ".join(cloths)})')
    cloth = cloths[entry.cloth]
    if entry.near is not None:
        there = cloth.slots
        distance = length(places(x, there) - entry.near)
        near = there[distance <= entry.radius]
        if not len(near):
            gap = distance.min()
            raise InputError(f'pins.{name}: no particle within {entry.radius:g} m of '
                             f'{list(entry.near)}; the nearest is {gap:.3g} m away')
        return near
    if isinstance(entry.at, str) and cloth.mesh.grid is None:
        raise InputError(f'pins.{name}.at: {entry.at} is a place on a grid, and '
                         f"'{cloth.name}' is a mesh; use near and radius (m), or a list "
                         'of particle numbers')
    return cloth.at(entry.at, f'pins.{name}.at')
