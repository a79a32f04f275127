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
    most = len(order) + OPEN    # one constraint per pack
    packs, closed = np.full((most, PACK), -1), np.empty(most, np.int64)
    count = _fill(np.ascontiguousarray(particles[order], np.int64), packs,
                  np.zeros(most, np.int64), np.arange(OPEN), closed)
    found = packs[closed[:count]].ravel()
    return np.where(found >= 0, order[found] if len(order) else EMPTY, EMPTY)


@jit
def _fill(particles, found, filled, is_open, closed):
    """
    Fill the packs, and return how many there are.

    Parameters
    ----------
    particles : slots, shape (constraints, particles of a constraint)
    found : the constraints of each pack, -1 at first, shape (packs, PACK)
    filled : how many each has, 0 at first, shape (packs,)
    is_open : the packs that are open, oldest first, shape (OPEN,)
    closed : the others and then the open ones that are not empty, shape (packs,)

    """
    packs, closed_count = OPEN, 0
    for c in range(len(particles)):
        place = OPEN
        for a in range(OPEN):
            if not _conflicts(particles, found[is_open[a]], filled[is_open[a]], c):
                place = a
                break
        if place == OPEN:    # close the oldest pack
            closed[closed_count] = is_open[0]
            closed_count += 1
            place = OPEN - 1
            _open_instead(is_open, 0, packs)
            packs += 1
        p = is_open[place]
        found[p, filled[p]] = c
        filled[p] += 1
        if filled[p] == PACK:
            closed[closed_count] = p
            closed_count += 1
            _open_instead(is_open, place, packs)
            packs += 1
    for a in range(OPEN):
        if filled[is_open[a]]:
            closed[closed_count] = is_open[a]
            closed_count += 1
    return closed_count


@jit
def _open_instead(is_open, place, new):
    """Remove an open pack, and add a new one at the end."""
    for a in range(place, OPEN - 1):
        is_open[a] = is_open[a + 1]
    is_open[OPEN - 1] = new


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
