"""
The constraints at pinned particles, and the impulses that they exert there.

A constraint's impulse on each of its particles is ∇C Δf, along the gradient that it was projected
with; the gradient at the substep's end is another one, and with it momentum would not balance. So
a sweep stops before the constraints in question: their gradients are noted (``…_gradients`` of
each effect), they are projected like all others, and what their multipliers changed by goes to
``state.reaction`` along what was noted (``collect``). Constraints that are projected side by side
share no particle, so it makes no difference how many there are.
"""

from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.constraints.projection import at_the_end


class Held(NamedTuple):
    """Which they are; an effect that needs more of them has a list of its own, with this first."""

    count: np.ndarray
    """shape (1,)"""
    particles: np.ndarray
    """slots, shape (room, particles of a constraint)"""
    index: np.ndarray
    """where each keeps its force, shape (room,)"""


class Packs(NamedTuple):
    """Where a sweep over packs stops, and what is noted of one pack."""

    held: NamedTuple
    """the constraints in question, in sweep order"""
    segments: np.ndarray
    """how many there are, shape (1,)"""
    segment: np.ndarray
    """of the sweep: first constraint, last + 1, and first, last + 1 among those held; (…, 4)"""
    gradient: np.ndarray
    """of each multiplier by each particle, shape (PACK, multipliers, particles, 3)"""
    before: np.ndarray
    """multipliers, shape (PACK, multipliers)"""


def room_for(count: int, width: int) -> Held:
    """Return a list for so many constraints of so many particles."""
    return Held(np.zeros(1, np.int64), np.zeros((count, width), np.int64),
                np.zeros(count, np.int64))


def packs_for(held: NamedTuple, multipliers: int = 1) -> Packs:
    """Return the stops of a sweep over packs of constraints with so many multipliers each."""
    count, width = held.particles.shape
    return Packs(held, np.zeros(1, np.int64), np.zeros((2 * (count // PACK) + 1, 4), np.int64),
                 np.zeros((PACK, multipliers, width, 3)), np.zeros((PACK, multipliers)))


def hold(held: NamedTuple, constraints: Any, inv_mass: np.ndarray) -> np.ndarray:
    """
    List the constraints that touch a pinned particle: what they have by the list's names.

    Returns their numbers, in sweep order.
    """
    found = np.flatnonzero((inv_mass[constraints.particles] == 0.0).any(1))
    held.count[0] = len(found)
    for name in held._fields[1:]:
        if hasattr(constraints, name):
            getattr(held, name)[:len(found)] = getattr(constraints, name)[found]
    return found


def hold_packs(packs: Packs, constraints: Any, inv_mass: np.ndarray, count: int) -> None:
    """List them, and where a sweep over ``count`` constraints, packs filled up, stops."""
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
    """Return in how many parts a sweep goes over all packs."""
    if packs is None:
        return 1
    else:
        return packs.segments[0]


@jit(inline=True)
def segment(packs, number, count, reverse):
    """Return a part of a sweep: first constraint, last + 1, and the same among those held."""
    if packs is None:
        return 0, count, 0, 0
    else:
        k = packs.segments[0] - 1 - number if reverse else number
        row = packs.segment[k]
        return row[0], row[1], row[2], row[3]


def multiplier(force, m, c):
    """Return the m-th multiplier of a constraint."""


@inline(multiplier)
def _multiplier(force, m, c):
    if force.ndim == 1:
        return lambda force, m, c: force[c]
    return lambda force, m, c: force[m, c]


@jit
def remember(packs, first, last, apart, force):
    """Note the multipliers of the held constraints ``first`` to ``last``, all of one pack."""
    for k in range(first, last):
        for m in range(packs.before.shape[1]):
            packs.before[k - first, m] = (multiplier(force, m, packs.held.index[k])
                                          if at_the_end(apart) else 0.0)


@jit
def collect(packs, first, last, force, part, reaction):
    """Add what they exerted since, ∇C Δf, as ``part`` of the mean over the frame."""
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
