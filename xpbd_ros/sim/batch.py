"""Constraint batches: colours whose members share no particle, laid out as contiguous spans."""

import numpy as np

from xpbd_ros.sim.jit import jit

SOFTEST = 1e300
"""largest compliance of a constraint: finite, so that times no force it is nothing"""


def colour_order(particles: np.ndarray, particle_count: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Sort constraints by colour; greedy, in the order given, so the result is always the same.

    Parameters
    ----------
    particles : particles of each constraint, shape (constraints, k)
    particle_count : particles in the scene

    Returns
    -------
    order : constraint indices, colour after colour, shape (constraints,)
    starts : where each colour starts in ``order``, and its end, shape (colours + 1,)

    """
    particles = np.ascontiguousarray(particles, dtype=np.int64)
    words = 1
    while True:
        colour, full = _greedy(particles, particle_count, words)
        if not full:
            break
        words *= 2
    order = np.argsort(colour, kind='stable')
    starts = np.searchsorted(colour[order], np.arange(colour.max(initial=-1) + 2))
    return order, starts


@jit
def _greedy(particles, particle_count, words):
    """Give each constraint the lowest colour that none of its particles has yet."""
    taken = np.zeros((particle_count, words), np.uint64)
    colour = np.empty(len(particles), np.int64)
    for c in range(len(particles)):
        found = -1
        for word in range(words):
            mask = np.uint64(0)
            for i in particles[c]:
                mask |= taken[i, word]
            for bit in range(64):
                if (mask >> np.uint64(bit)) & np.uint64(1) == np.uint64(0):
                    found = bit
                    break
            if found >= 0:
                for i in particles[c]:
                    taken[i, word] |= np.uint64(1) << np.uint64(found)
                colour[c] = 64 * word + found
                break
        if found < 0:
            return colour, True
    return colour, False


def hold(particles: np.ndarray, inv_mass: np.ndarray, held: np.ndarray) -> None:
    """
    List the constraints that touch a pinned particle: those whose force somebody will ask for.

    Parameters
    ----------
    particles : particles of each constraint, shape (constraints, k)
    inv_mass : [1/kg], shape (particles,)
    held : written: the count, then constraint indices, shape (constraints + 1,)

    """
    found = np.flatnonzero((inv_mass[particles] == 0.0).any(1))
    held[0] = len(found)
    held[1:len(found) + 1] = found
