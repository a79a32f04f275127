"""The particles that pins hold, and their target positions within a frame."""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.quaternion import interpolate, rotate


class Pin(NamedTuple):
    """Data of the kernel: the pinned particles, and the pins' poses by slot."""

    count: np.ndarray
    """pinned particles, shape (1,)"""
    particle: np.ndarray
    """slots, shape (slots,)"""
    slot: np.ndarray
    """index of the pin that holds it, shape (particles,)"""
    offset: np.ndarray
    """in the pin's axes [m], shape (particles, 3)"""
    start: np.ndarray
    """pose at the frame's start: x y z, qx qy qz qw; shape (max_pins, 7)"""
    goal: np.ndarray
    """pose at the frame's end, shape (max_pins, 7)"""
    force: np.ndarray
    """constraint force on each, mean over the frame [N], shape (particles, 3)"""
    last: np.ndarray
    """J_{n-1} / h by slot [N], shape (slots, 3)"""
    older: np.ndarray
    """J_{n-2} / h by slot [N], shape (slots, 3)"""


@jit(inline=True)
def place_of(pin, k, s):
    """Return p + R q of a held particle, at a fraction s of the frame."""
    a, b = pin.start[pin.slot[k]], pin.goal[pin.slot[k]]
    qx, qy, qz, qw = interpolate((a[3], a[4], a[5], a[6]), (b[3], b[4], b[5], b[6]), s)
    q = pin.offset[k]
    rx, ry, rz = rotate(qx, qy, qz, qw, q[0], q[1], q[2])
    return (a[0] + s * (b[0] - a[0]) + rx, a[1] + s * (b[1] - a[1]) + ry,
            a[2] + s * (b[2] - a[2]) + rz)
