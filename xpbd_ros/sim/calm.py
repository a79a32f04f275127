"""
Whether a frame was calm: what an explicit step must show before it counts.

Beyond its stability limit a leapfrog grows by a factor in every substep, so one frame is enough to
tell: an edge is strained by far more than before or than is safe, or there is more energy than
there was and than gravity and the pins can have given.

What an edge adds to the stiffness that the substeps reckon with goes by its strain and its own
stiffness. So the strain of one that is softer than others at its particles counts for less: soft
diagonals may well be pressed together while warp and weft keep their length.
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
    share: np.ndarray
    """stiffness as part of the stiffest edge's at its particles, 0 … 1; shape (edges,)"""


def calm_edges(lists: list) -> Calm:
    """Return the edges of several lists (``distance.Edges``) to look at."""
    def of(name, empty):
        return np.concatenate([empty, *(getattr(edges, name) for edges in lists)])

    particles = of('particles', np.zeros((0, 2), np.int64))
    compliance = of('compliance', np.zeros(0))
    least = np.full(particles.max(initial=-1) + 1, np.inf)    # compliance
    np.minimum.at(least, particles, compliance[:, None])
    share = least[particles].min(axis=1) / compliance
    return Calm(particles, of('rest_length', np.zeros(0)), compliance, share)


@jit
def look(calm, x, v, mass, inv_mass):
    """
    Return the largest strain, as it counts, and energies [J].

    These are of free particles and edges, and of pinned particles.
    """
    strain, energy, pinned = 0.0, 0.0, 0.0
    for e in range(len(calm.rest_length)):
        i, j, rest = calm.particles[e, 0], calm.particles[e, 1], calm.rest_length[e]
        dx, dy, dz = x[0, i] - x[0, j], x[1, i] - x[1, j], x[2, i] - x[2, j]
        residual = np.sqrt(dx * dx + dy * dy + dz * dz) - rest
        felt = calm.share[e] * abs(residual)
        if rest > 0.0 and not felt <= strain * rest:    # not a number is more than any
            strain = felt / rest
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
