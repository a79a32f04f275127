"""
Batches of constraints on meshes: packs of PACK constraints that share no particle.

Greedy: each constraint, in mesh order, goes into the oldest open pack without a common particle.
With OPEN packs nearly all fill up, and neighbours on the mesh stay near each other in memory. A
sweep projects the constraints of a pack in vectors, of any width.
"""

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.particles.memory_layout import zeros

OPEN = 24
"""number of packs that are filled at a time"""
EMPTY = -1


def pack(particles: np.ndarray) -> np.ndarray:
    """
    Return the constraints ordered by pack.

    Parameters
    ----------
    particles : slots, shape (constraints, particles of a constraint)

    Returns
    -------
    indices of the constraints, EMPTY in unfilled packs, shape (packs * PACK,)

    """
    order = np.argsort(particles.min(1), kind='stable') if len(particles) else np.zeros(0, int)
    found = _fill(np.ascontiguousarray(particles[order], np.int64))
    return np.where(found >= 0, order[found] if len(order) else EMPTY, EMPTY)


@jit(allocates=True)
def _fill(particles):
    count = len(particles)
    found = np.full((count + OPEN, PACK), -1)    # worst case: one constraint per pack
    filled = np.zeros(count + OPEN, np.int64)
    is_open = np.arange(OPEN)    # oldest first
    packs = OPEN
    closed = np.empty(count + OPEN, np.int64)
    closed_count = 0
    for c in range(count):
        place = OPEN
        for a in range(OPEN):
            if not _conflicts(particles, found[is_open[a]], filled[is_open[a]], c):
                place = a
                break
        if place == OPEN:    # close the oldest pack
            closed[closed_count] = is_open[0]
            closed_count += 1
            is_open[:-1] = is_open[1:].copy()
            place = OPEN - 1
            is_open[place] = packs
            packs += 1
        p = is_open[place]
        found[p, filled[p]] = c
        filled[p] += 1
        if filled[p] == PACK:
            closed[closed_count] = p
            closed_count += 1
            is_open[place:-1] = is_open[place + 1:].copy()
            is_open[-1] = packs
            packs += 1
    for a in range(OPEN):
        if filled[is_open[a]]:
            closed[closed_count] = is_open[a]
            closed_count += 1
    return found[closed[:closed_count]].ravel()


@jit
def _conflicts(particles, members, count, c):
    for m in range(count):
        for a in particles[members[m]]:
            for b in particles[c]:
                if a == b:
                    return True
    return False


def padded(numbers: np.ndarray, order: np.ndarray, empty, dtype) -> np.ndarray:
    """Return values in the order of ``pack``, cache-aligned; ``empty`` where it is EMPTY."""
    found = zeros((len(order), *np.shape(numbers)[1:]), dtype)
    found[:] = empty
    found[order >= 0] = numbers[order[order >= 0]]
    return found
