"""Pins as Python has them: what each holds, where it goes, and what it feels."""

from dataclasses import dataclass, field

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.effect import Cloth
from xpbd_ros.sim.mesh import length
from xpbd_ros.sim.motion import Motion
from xpbd_ros.sim.state import places


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
    expires_ns: int | None = None
    """when it lets go by itself"""


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
