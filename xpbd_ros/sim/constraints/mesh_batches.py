"""
Batches of constraints on meshes: packs of PACK constraints that share no particle.

Greedy: each constraint, in mesh order, goes into the oldest open pack without a common particle.
With OPEN packs nearly all fill up, and neighbours on the mesh stay near each other in memory. A
sweep projects the constraints of a pack in vectors, of any width.
"""

from collections.abc import Callable

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.constraints.pinned import room_for
from xpbd_ros.sim.constraints.projection import max_compliance
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


class Packing:
    """
    Constraints of meshes in the order of ``pack``, and the arrays of their batch.

    Parameters
    ----------
    particles : slots of the constraints of each cloth, shapes (constraints, particles of each)
    world : build context

    """

    def __init__(self, particles: list[np.ndarray], world):
        self.particles = np.concatenate(particles)
        self._world, self._dtype = world, world.state.x.dtype
        self._order = pack(self.particles)

    def column(self, numbers: np.ndarray | list[np.ndarray], empty=0.0) -> np.ndarray:
        """
        Return numbers of the constraints as an array of the batch, with the constraints last.

        ``numbers`` are those of all constraints or of each cloth's; ``empty`` is in the padding.
        """
        if isinstance(numbers, list):
            numbers = np.concatenate(numbers)
        found = padded(numbers, self._order, empty, self._dtype)
        return found if found.ndim == 1 else found.T.copy()

    def compliance(self, numbers: list[np.ndarray]) -> np.ndarray:
        """Return compliances as an array of the batch, none above ``max_compliance``."""
        most = max_compliance(self._dtype)
        return self.column(np.minimum(np.concatenate(numbers), most), most)

    def common(self, multipliers: tuple[int, ...] = (), room: Callable = room_for) -> dict:
        """
        Return the fields that all batches have.

        Parameters
        ----------
        multipliers : () for one multiplier each, or (number of multipliers,)
        room : function of the number of constraints, padding included, and of the particles of
            each: returns an empty list for those at pinned particles

        """
        world, (count, width) = self._world, (len(self._order), self.particles.shape[1])
        return {
            'records': world.records,
            'slots': np.array([self.particles.min(initial=world.slots),
                               self.particles.max(initial=-1) + 1]),
            'particles': padded(self.particles, self._order, world.slots - 1, np.int32).T.copy(),
            'force': zeros((*multipliers, count), self._dtype) if world.forces else None,
            'held': room(count, width) if world.pins else None}


def padded(numbers: np.ndarray, order: np.ndarray, empty, dtype) -> np.ndarray:
    """Return values in the order of ``pack``, cache-aligned; ``empty`` where it is EMPTY."""
    found = zeros((len(order), *np.shape(numbers)[1:]), dtype)
    found[:] = empty
    found[order >= 0] = numbers[order[order >= 0]]
    return found
