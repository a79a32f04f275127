"""
Reaction forces of constraints on pinned particles.

A constraint's impulse on each of its particles is ∇C Δf, with the gradient of its projection; the
gradient at the substep's end differs, and would violate the balance of momentum. So sweeps
(``constraints.sweeps``) add the impulses of the constraints at pinned particles, which are listed
here, to ``state.reaction`` as they project them. Constraints of a vector share no particle, so its
width makes no difference.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_vector3 import lane_of
from xpbd_ros.sim.constraints.grid_batches import first_of_runs, listed, Runs


class Held(NamedTuple):
    """
    List of constraints at pinned particles, in sweep order.

    Kinds that need more data of them define a list of their own that begins with these fields.
    """

    count: np.ndarray
    """length of the list, shape (1,)"""
    particles: np.ndarray
    """slots, shape (capacity, particles of a constraint)"""
    index: np.ndarray
    """position of each multiplier in ``force``, shape (capacity,)"""


class Stops(NamedTuple):
    """List of constraints at pinned particles, by run."""

    held: Any
    """``Held``"""
    first: np.ndarray
    """position in ``held`` of each run's first constraint, and their number; shape (runs + 1,)"""


def room_for(count: int, width: int) -> Held:
    """Return an empty list for ``count`` constraints of ``width`` particles each."""
    return Held(np.zeros(1, np.int64), np.zeros((count, width), np.int64),
                np.zeros(count, np.int64))


def stops_for(runs: Runs, room: Callable = room_for) -> Stops:
    """Return an empty list for all constraints of some runs."""
    return Stops(room(len(listed(runs)[1]), runs.offset.shape[1]),
                 np.zeros(len(runs.start) + 1, np.int64))


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


def hold_batch(data: Any, constraints: Any, inv_mass: np.ndarray) -> None:
    """Update the list of an effect's batch, if it has one; parameters as of ``hold``."""
    batch = getattr(data, 'edges', data)
    held, stops = (getattr(batch, name, None) for name in ('held', 'stops'))
    if stops is not None:
        found = hold(stops.held, constraints, inv_mass)
        stops.first[:] = np.searchsorted(found, first_of_runs(batch.runs))
    elif held is not None:
        hold(held, constraints, inv_mass)


@jit(inline=True)
def listed_range(held):
    """Return the range (first, last + 1) of all listed constraints at pinned particles."""
    if held is None:
        return 0, 0
    else:
        return 0, held.count[0]


@jit(inline=True)
def listed_range_of(stops, run):
    """Return the range (first, last + 1) of a run's constraints at pinned particles."""
    if stops is None:
        return 0, 0
    else:
        return stops.first[run], stops.first[run + 1]


@jit
def listed_between(held, first, last, begin, end, reverse):
    """
    Return the part of the range first:last of a list whose multipliers are in force[begin:end].

    A sweep calls it vector by vector: the part begins at ``first``, or ends at ``last`` if
    ``reverse``.
    """
    if held is None:
        return first, first
    index = held.index
    if reverse:
        k = last
        while k > first and index[k - 1] >= begin:
            k -= 1
        return k, last
    k = first
    while k < last and index[k] < end:
        k += 1
    return first, k


@jit
def add_reactions(particles, index, p, first, last, start, part, impulse, reaction):
    """
    Add the impulses of the listed constraints first:last on their particle p.

    Parameters
    ----------
    particles, index : of the list
    start : index of the multiplier in lane 0
    part : the substep's fraction of the frame: ``reaction`` is the mean over the frame
    impulse : ∇C_p Δf [N], a Vector3
    reaction : [N], shape (3, slots)

    """
    for k in range(first, last):
        i, lane = particles[k, p], index[k] - start
        reaction[0, i] += part * lane_of(impulse.x, lane)
        reaction[1, i] += part * lane_of(impulse.y, lane)
        reaction[2, i] += part * lane_of(impulse.z, lane)
