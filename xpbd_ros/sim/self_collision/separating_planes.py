"""
Planes: what parts the two sides of a near pair of surfaces, so that neither gets past the other.

What matters is how a pair's sides move against each other: they must be apart along one direction
where the substep starts and where it ends (``self_collision.separating_direction``); then nothing
crosses in between, and cloth that falls or is carried as a whole is not held. A pair that does not
part is pushed apart along the direction that asks for least, which keeps momentum.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.particles.history import invalidate_history
from xpbd_ros.sim.self_collision.separating_direction import part, write_vectors

CLEAR = 0.1
"""of a pair's distance: what is left of it after a substep"""
AIM = 1.5
"""of what is left: what pushes aim at, so that pushes in turn with colliders' come to an end"""
LEAST = 0.02
"""of the distance that a pair has to keep: nearer than that nothing is pressed"""


class Planes(NamedTuple):
    """The pairs that can get through one another in this substep."""

    count: np.ndarray
    """how many, shape (1,)"""
    side: np.ndarray
    """how many of a pair's particles are on the one side, shape (room,)"""
    number: np.ndarray
    """particles in natural order, those of that side first; shape (room, 4)"""
    normal: np.ndarray
    """direction along which its sides part, shape (room, 3)"""
    need: np.ndarray
    """how far they stay apart [m], shape (room,)"""
    held: np.ndarray
    """whether a particle is held back, shape (slots,)"""
    stays: np.ndarray
    """whether it goes no way at all, shape (slots,)"""
    share: np.ndarray
    """of its way, that a particle may go if it is; shape (particles,)"""
    points: np.ndarray
    """room for the vectors between a pair's sides [m], shape (8, 3)"""
    shares: np.ndarray
    """room for their weights, shape (8,)"""


def new_planes(room: int, particles: int, slots: int) -> Planes:
    """Return room for that many pairs, and none of them."""
    return Planes(np.zeros(1, np.int64), np.zeros(room, np.int64), np.zeros((room, 4), np.int64),
                  np.zeros((room, 3)), np.zeros(room), np.zeros(slots, np.bool_),
                  np.zeros(slots, np.bool_), np.zeros(particles), np.zeros((8, 3)), np.zeros(8))


@jit
def add_plane(planes, side, i, j, k, l, normal, distance, keep):
    """List a pair that can get through in this substep; normal: from where it starts."""
    m = planes.count[0]
    planes.count[0] = m + 1
    planes.side[m] = side
    number = planes.number
    number[m, 0], number[m, 1], number[m, 2], number[m, 3] = i, j, k, l
    for a in range(3):
        planes.normal[m, a] = normal[a]
    planes.need[m] = max(CLEAR * distance, min(0.9 * distance, LEAST * keep))


@jit(inline=True)
def apart_now(planes, m, near, x):
    """Return how far a pair's sides are apart along its direction where particles are now [m]."""
    number, n, start, slot = planes.number, planes.normal, near.x, near.slot
    first, above, below = number[m, 0], np.inf, -np.inf
    for p in range(4):
        i = number[m, p]
        j, along = slot[i], 0.0
        for a in range(3):
            along += n[m, a] * ((start[i, a] - start[first, a]) + (x[a, j] - start[i, a]))
        if p < planes.side[m]:
            above = min(above, along)
        else:
            below = max(below, along)
    return above - below


@jit
def parts(planes, m, near, x):
    """Tell whether a pair's sides part, if need be along another direction than before."""
    if apart_now(planes, m, near, x) >= planes.need[m]:
        return True
    points, n = planes.points, planes.normal
    count = write_vectors(points, planes.side[m], planes.number[m], near.x, near.slot, x)
    good, best = part(points, planes.shares, count, (n[m, 0], n[m, 1], n[m, 2]), planes.need[m])
    n[m, 0], n[m, 1], n[m, 2] = best
    return good


@jit
def part_sides(planes, near, state):
    """Push apart the sides of each pair that does not part; return how many there are."""
    count = 0
    if planes is not None:
        for m in range(planes.count[0]):
            if parts(planes, m, near, state.x):
                continue
            count += 1
            for p in range(planes.side[m]):
                for q in range(planes.side[m], 4):
                    push_pair(planes, m, near.slot[planes.number[m, p]],
                              near.slot[planes.number[m, q]], state)
    return count


@jit
def push_pair(planes, m, i, j, state):
    """Push two particles of a pair's two sides apart along its direction."""
    x, w, n = state.x, state.inv_mass, planes.normal
    total = w[i] + w[j]
    missing = AIM * planes.need[m] - (n[m, 0] * (x[0, i] - x[0, j]) + n[m, 1] * (x[1, i] - x[1, j])
                                      + n[m, 2] * (x[2, i] - x[2, j]))
    if total > 0.0 and missing > 0.0:
        for a in range(3):
            x[a, i] += n[m, a] * missing * w[i] / total
            x[a, j] -= n[m, a] * missing * w[j] / total
        invalidate_history(state.history, i)
        invalidate_history(state.history, j)
