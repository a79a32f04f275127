"""
Reaction forces of constraints on pinned particles.

A constraint's impulse on each of its particles is ∇C Δf, with the gradient of its projection; the
gradient at the substep's end differs, and would violate the balance of momentum. A sweep therefore
stops before each pack with constraints at pinned particles: their gradients and multipliers are
recorded (``remember``, ``…_gradients`` of each effect), the pack is projected like any other, and
the changes of the multipliers times the recorded gradients are added to ``state.reaction``
(``collect``). Constraints of a pack share no particle, so the vector width makes no difference.
"""

from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.constraints.projection import at_the_end


class Held(NamedTuple):
    """
    List of constraints at pinned particles.

    Effects that need more data of them define a list of their own that begins with these fields.
    """

    count: np.ndarray
    """length of the list, shape (1,)"""
    particles: np.ndarray
    """slots, shape (capacity, particles of a constraint)"""
    index: np.ndarray
    """position of each multiplier in ``force``, shape (capacity,)"""


class Packs(NamedTuple):
    """Segments of a sweep over packs, and the record of one pack."""

    held: Any
    """constraints at pinned particles, in sweep order"""
    segments: np.ndarray
    """number of segments, shape (1,)"""
    segment: np.ndarray
    """first constraint, last + 1, and the same as positions in ``held``, shape (capacity, 4)"""
    gradient: np.ndarray
    """∇C of each multiplier, shape (PACK, multipliers, particles, 3)"""
    before: np.ndarray
    """multipliers before the projection, shape (PACK, multipliers)"""


def room_for(count: int, width: int) -> Held:
    """Return an empty list for ``count`` constraints of ``width`` particles each."""
    return Held(np.zeros(1, np.int64), np.zeros((count, width), np.int64),
                np.zeros(count, np.int64))


def packs_for(held: Any, multipliers: int = 1) -> Packs:
    """Return the segments of a sweep over packs, for constraints with so many multipliers each."""
    count, width = held.particles.shape
    return Packs(held, np.zeros(1, np.int64), np.zeros((2 * (count // PACK) + 1, 4), np.int64),
                 np.zeros((PACK, multipliers, width, 3)), np.zeros((PACK, multipliers)))


def hold(held: Any, constraints: Any, inv_mass: np.ndarray) -> np.ndarray:
    """
    Update a list of constraints at pinned particles.

    Parameters
    ----------
    held : the list; every field that ``constraints`` has as well is copied
    constraints : all constraints as arrays, in sweep order
    inv_mass : 0 where pinned, shape (slots,)

    Returns
    -------
    indices of the listed constraints, in sweep order

    """
    found = np.flatnonzero((inv_mass[constraints.particles] == 0.0).any(1))
    held.count[0] = len(found)
    for name in held._fields[1:]:
        if hasattr(constraints, name):
            getattr(held, name)[:len(found)] = getattr(constraints, name)[found]
    return found


def hold_packs(packs: Packs, constraints: Any, inv_mass: np.ndarray, count: int) -> None:
    """
    Update the list and the segments of a sweep over packs.

    Parameters as of ``hold``; ``count`` is the number of constraints including the packs' padding.
    """
    hold(packs.held, constraints, inv_mass)
    held = packs.held.index[:packs.held.count[0]]
    numbers, first = np.unique(held // PACK, return_index=True)
    found, begin = [], 0
    for number, a, b in zip((PACK * numbers).tolist(), first.tolist(),
                            [*first[1:].tolist(), len(held)]):
        if begin < number:
            found.append((begin, number, a, a))
        found.append((number, number + PACK, a, b))
        begin = number + PACK
    if begin < count:
        found.append((begin, count, 0, 0))
    packs.segments[0] = len(found)
    packs.segment[:len(found)] = np.reshape(found, (-1, 4))


@jit(inline=True)
def segment_count(packs):
    """Return the number of segments of a sweep over all packs."""
    if packs is None:
        return 1
    else:
        return packs.segments[0]


@jit(inline=True)
def segment(packs, number, count, reverse):
    """Return a segment: first constraint, last + 1, and the same as positions in ``held``."""
    if packs is None:
        return 0, count, 0, 0
    else:
        k = packs.segments[0] - 1 - number if reverse else number
        row = packs.segment[k]
        return row[0], row[1], row[2], row[3]


def multiplier(force, m, c):
    """Return multiplier m of constraint c; ``force`` has the shape (n,) or (multipliers, n)."""


@inline(multiplier)
def _multiplier(force, m, c):
    if force.ndim == 1:
        return lambda force, m, c: force[c]
    return lambda force, m, c: force[m, c]


@jit
def remember(packs, first, last, apart, force):
    """Record the multipliers of the listed constraints first:last, all of one pack."""
    for k in range(first, last):
        for m in range(packs.before.shape[1]):
            packs.before[k - first, m] = (multiplier(force, m, packs.held.index[k])
                                          if at_the_end(apart) else 0.0)


@jit
def collect(packs, first, last, force, part, reaction):
    """
    Add the forces ∇C Δf that the listed constraints first:last exerted since ``remember``.

    ``part`` is the substep's fraction of the frame: ``reaction`` is the mean over the frame [N],
    shape (3, slots).
    """
    if packs is not None:
        gradient = packs.gradient
        for k in range(first, last):
            for m in range(packs.before.shape[1]):
                df = part * (multiplier(force, m, packs.held.index[k])
                             - packs.before[k - first, m])
                for p in range(gradient.shape[2]):
                    for a in range(3):
                        reaction[a, packs.held.particles[k, p]] += (
                            df * gradient[k - first, m, p, a])
