"""Wrenches of the cloth on colliders: sums of impulses over a frame."""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit

LANES = 8
"""partial sums of each component, whatever the width of a vector, so that the bits are the same"""


class Wrenches(NamedTuple):
    """Impulses that colliders got from the cloth."""

    impulse: np.ndarray
    """linear [N s] and angular about the collider's position, world axes [N m s]; sum over the
    frame; shape (capacity, 6)"""
    partial: np.ndarray
    """partial sums of the collider at hand, shape (6, LANES)"""
    h: np.ndarray
    """length of the substep [s], shape (1,)"""


def new_wrenches(capacity: int) -> Wrenches:
    """Return zero wrenches of ``capacity`` colliders."""
    return Wrenches(np.zeros((capacity, 6)), np.zeros((6, LANES)), np.zeros(1))


@jit
def begin_wrenches(wrenches, substep):
    """Reset the sums in a frame's first substep."""
    if substep.begin == 0.0:
        wrenches.impulse[:] = 0.0
    wrenches.h[0] = substep.h


@jit
def add_reaction(contacts, c, state, i, x, y, z):
    """Subtract the impulse (x, y, z) on particle i [N s] from collider c's sum."""
    total, p = contacts.wrenches.impulse[c], contacts.after[c]
    rx, ry, rz = state.x[0, i] - p[0], state.x[1, i] - p[1], state.x[2, i] - p[2]
    total[0] -= x
    total[1] -= y
    total[2] -= z
    total[3] -= ry * z - rz * y
    total[4] -= rz * x - rx * z
    total[5] -= rx * y - ry * x
