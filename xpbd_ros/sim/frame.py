"""The result of one frame of a simulation."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from xpbd_ros.sim.commands import Command


@dataclass(frozen=True)
class Frame:
    """State after a frame, forces and events; particles in natural order."""

    index: int
    """0 is the start"""
    time_ns: int
    """simulation time since the start [ns]; exact"""
    x: np.ndarray
    """positions [m], shape (particles, 3)"""
    v: np.ndarray
    """velocities [m/s], shape (particles, 3)"""
    inv_mass: np.ndarray
    """[1/kg], shape (particles,); 0 while pinned"""
    pins: Mapping[str, Any]
    """name: PinState"""
    colliders: Mapping[str, Any]
    """name: ColliderState"""
    applied: tuple[Command, ...] = ()
    """commands applied before this frame"""
    refused: tuple[tuple[Command, str], ...] = ()
    """commands refused before this frame, each with the reason"""
    news: tuple[str, ...] = ()
    """events of this frame that no command caused, such as a pin that was released"""
