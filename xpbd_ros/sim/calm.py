"""
Whether a frame was calm: what an explicit step must show before it counts.

Beyond its stability limit a leapfrog grows by a factor in every substep, so one frame is enough to
tell: an edge is strained by far more than before or than is safe, or there is more energy than
there was and than gravity and the pins can have given.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.jit import jit

STRAIN = 0.25
"""by which an edge may be strained further in a frame"""
LARGEST = 0.5
"""to which it may be strained at all: one that is pressed to half its length is stiffer across
than along, which the number of substeps does not reckon with"""
GROWTH = 2.0
"""by which the energy may be more than can be told"""


class Calm(NamedTuple):
    """The edges to look at."""

    particles: np.ndarray
    """slots, shape (edges, 2)"""
    rest_length: np.ndarray
    """[m], shape (edges,)"""
    compliance: np.ndarray
    """[m/N], shape (edges,)"""


@jit
def look(calm, x, v, mass, inv_mass):
    """Return largest strain, energy of free particles and edges [J], of pinned particles [J]."""
    strain, energy, pinned = 0.0, 0.0, 0.0
    for e in range(len(calm.rest_length)):
        i, j, rest = calm.particles[e, 0], calm.particles[e, 1], calm.rest_length[e]
        dx, dy, dz = x[0, i] - x[0, j], x[1, i] - x[1, j], x[2, i] - x[2, j]
        residual = np.sqrt(dx * dx + dy * dy + dz * dz) - rest
        if rest > 0.0 and not abs(residual) <= strain * rest:    # not a number is more than any
            strain = abs(residual) / rest
        energy += 0.5 * residual * residual / calm.compliance[e]
    for i in range(len(mass)):
        kinetic = 0.5 * mass[i] * (v[0, i]**2 + v[1, i]**2 + v[2, i]**2)
        if inv_mass[i] > 0.0:
            energy += kinetic
        else:
            pinned += kinetic
    return strain, energy, pinned


def was_calm(before, after, *, mass: float, gravity: float, dt: float) -> bool:
    """Tell whether what ``look`` saw after a frame can come of what it saw before it."""
    speed = np.sqrt(2.0 * before[1] / mass) + gravity * dt
    given = mass * gravity * dt * speed + max(before[2], after[2])
    return bool(after[0] <= min(before[0] + STRAIN, LARGEST)
                and after[1] <= GROWTH * (before[1] + given))
