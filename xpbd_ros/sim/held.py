"""The constraints at pinned particles, whose forces somebody asks for."""

from typing import Any, NamedTuple

import numpy as np


class Held(NamedTuple):
    """Which they are; an effect that needs more of them has a list of its own, with this first."""

    count: np.ndarray
    """shape (1,)"""
    particles: np.ndarray
    """slots, shape (room, particles of a constraint)"""
    index: np.ndarray
    """where each keeps its force, shape (room,)"""


def room_for(count: int, width: int) -> Held:
    """Return a list for so many constraints of so many particles."""
    return Held(np.zeros(1, np.int64), np.zeros((count, width), np.int64),
                np.zeros(count, np.int64))


def hold(held: NamedTuple, constraints: Any, inv_mass: np.ndarray) -> None:
    """List the constraints that touch a pinned particle: what they have by the list's names."""
    found = np.flatnonzero((inv_mass[constraints.particles] == 0.0).any(1))
    held.count[0] = len(found)
    for name in held._fields[1:]:
        getattr(held, name)[:len(found)] = getattr(constraints, name)[found]
