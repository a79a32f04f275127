"""Active pins and their states after a frame: pose, velocity, wrench."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.effect import Cloth, cloth_of
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.geometry.quaternion import conjugate, rotate, turns
from xpbd_ros.sim.particles.state import places
from xpbd_ros.sim.target_motion import Motion


@dataclass
class Held:
    """One active pin."""

    name: str
    slot: int
    motion: Motion
    particles: np.ndarray
    """slots, shape (k,)"""
    offsets: np.ndarray
    """particle positions in the pin's axes [m], shape (k, 3)"""
    compliance: float = 0.0
    """of the whole pin [m/N]; 0: its particles are pinned"""
    slip: float | None = None
    """force at which the pin is released [N]; None: never"""
    lifetime_ns: int = 0
    """the pin is released after this time without a command [ns]; 0: never"""
    expires_ns: int | None = None
    """simulation time at which the pin is released [ns]; None: never"""
    axes_open: bool = False
    """True if the first target is to define the pin's axes, without turning the particles"""

    def renew(self, now_ns: int) -> None:
        """Restart the lifetime at the simulation time ``now_ns`` [ns]."""
        self.expires_ns = now_ns + self.lifetime_ns if self.lifetime_ns else None

    def take_axes(self, orientation: tuple[float, float, float, float]) -> None:
        """Turn the pin's axes to an orientation; its particles stay in place."""
        x, y, z, w = conjugate(orientation)
        old, self.axes_open = self.motion.pose.orientation, False
        self.offsets = np.array([rotate.py_func(x, y, z, w, *rotate.py_func(*old, *q))
                                 for q in self.offsets.tolist()])
        self.motion.begin(Pose(self.motion.pose.position, orientation))


@dataclass(frozen=True)
class PinState:
    """One pin after a frame."""

    pose: Pose
    linear: np.ndarray = field(compare=False)
    """velocity [m/s], shape (3,)"""
    angular: np.ndarray = field(compare=False)
    """angular velocity, world axes [rad/s], shape (3,)"""
    force: np.ndarray = field(compare=False)
    """of the cloth on the gripper [N], shape (3,)"""
    torque: np.ndarray = field(compare=False)
    """about the pose's position [N m], shape (3,)"""
    particles: np.ndarray = field(compare=False)
    """indices of its particles in a frame's natural order, shape (k,)"""
    limited: bool = False
    """True if it lags behind its target at max_speed"""


def list_particles(pin, held: list[Held]) -> None:
    """Write the particles of some pins into the list of the kernels, a ``Pin``."""
    k = 0
    for one in held:
        end = k + len(one.particles)
        pin.particle[k:end], pin.slot[k:end] = one.particles, one.slot
        pin.offset[k:end] = one.offsets
        k = end
    pin.count[0] = k


class PinStates(Mapping[str, PinState]):
    """
    All active pins after a frame, by name, stored as arrays: cheap for hundreds of pins.

    Parameters
    ----------
    held : active pins
    start, goal : poses x, y, z, qx, qy, qz, qw at the frame's start and end, shape (pins, 7)
    wrenches : force and torque of the cloth on each pin [N, N m], shape (pins, 6)
    numbers : particle index in natural order of each slot, shape (slots,)
    dt : length of the frame [s]

    """

    def __init__(self, held: Sequence[Held], start: np.ndarray, goal: np.ndarray,
                 wrenches: np.ndarray, numbers: np.ndarray, dt: float):
        self.names = tuple(one.name for one in held)
        self.poses = goal
        """at the frame's end, shape (pins, 7)"""
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
        """Return the state of one pin."""
        k = self._index[name]
        return PinState(self._pose[k], self.twists[k, :3].copy(), self.twists[k, 3:].copy(),
                        self.wrenches[k, :3].copy(), self.wrenches[k, 3:].copy(),
                        self._numbers[self._particles[k]], self._limited[k])

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names in the order of the grasps."""
        return iter(self.names)

    def __len__(self) -> int:
        """Return the number of active pins."""
        return len(self.names)


def chosen(name: str, entry, cloths: dict[str, Cloth], x: np.ndarray) -> np.ndarray:
    """
    Return the slots of the particles that a scene's ``pins`` entry selects.

    Parameters
    ----------
    name, entry : key and value of the entry
    cloths : all cloths by name
    x : positions of all slots [m], shape (3, slots)

    """
    cloth = cloth_of(cloths, entry.cloth, f'pins.{name}.cloth')
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


def rows(poses: Iterable[Pose]) -> list[tuple[float, ...]]:
    """Return poses as x y z, qx qy qz qw."""
    return [(*pose.position, *pose.orientation) for pose in poses]
