"""
Separating planes between the two sides of close pairs, so that surfaces do not pass through.

Only the relative motion of a pair's sides matters: if one direction separates them at the
substep's start and end (``self_collision.separating_direction``), they do not cross in between;
cloth that falls or is carried as a whole is not restrained. A pair without such a direction is
pushed apart along the best direction found, which conserves momentum.
"""

from typing import NamedTuple

from numba import types
import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import lowest_bit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import (
    alone,
    is_on_device,
    turns,
    wait_uneven,
    worker,
    workers,
)
from xpbd_ros.sim.particles.history import invalidate_history
from xpbd_ros.sim.self_collision.inverse_mass import inverse_mass
from xpbd_ros.sim.self_collision.neighbour_list import any_thread, next_marked, told
from xpbd_ros.sim.self_collision.separating_direction import part, write_vectors

CLEAR = 0.1
"""least distance of a pair after a substep, relative to that at its start"""
AIM = 1.5
"""target of pushes, relative to the required distance: more than 1, so that alternating pushes of
pairs and colliders terminate"""
NONE = 2**62
"""number of no pair"""
LEAST = 0.02
"""least distance of a pair after a substep, relative to the distance to be kept"""


class Planes(NamedTuple):
    """The pairs that may pass through each other in this substep, at their places in groups."""

    end: np.ndarray
    """end of the places, shape (1,)"""
    found: np.ndarray
    """bits of the pairs of each PACK places, shape (capacity / PACK,)"""
    side: np.ndarray
    """number of particles on a pair's first side, shape (capacity,)"""
    number: np.ndarray
    """particles in natural order, the first side first, shape (capacity, 4)"""
    normal: np.ndarray
    """direction that separates the sides, shape (capacity, 3)"""
    need: np.ndarray
    """required distance along it [m], shape (capacity,)"""
    held: np.ndarray
    """True if the motion of a particle is limited, shape (slots,)"""
    stays: np.ndarray
    """True if it must not move relative to the planes, shape (slots,)"""
    share: np.ndarray
    """fraction of its displacement that a held particle may make, shape (particles,)"""
    points: np.ndarray
    """scratch: vectors between a pair's sides [m], by thread, shape (threads, 8, 3)"""
    shares: np.ndarray
    """scratch: their weights, shape (threads, 8)"""
    vectors: np.ndarray
    """scratch: vectors between closest points by lanes [m], shape (3, PACK)"""


def new_planes(room: int, particles: int, slots: int, threads: int) -> Planes:
    """Return an empty list with the capacity of ``room`` pairs, for as many threads."""
    return Planes(np.zeros(1, np.int64), np.zeros(-(-room // PACK), np.int32),
                  np.zeros(room, np.int64), np.zeros((room, 4), np.int64), np.zeros((room, 3)),
                  np.zeros(room), np.zeros(slots, np.bool_), np.zeros(slots, np.bool_),
                  np.zeros(particles), np.zeros((threads, 8, 3)), np.zeros((threads, 8)),
                  np.zeros((3, PACK), np.float32))


@jit(inline=True)
def end_planes(planes, end):
    """Set the end of the places."""
    if planes is not None:
        planes.end[0] = end


@jit(inline=True)
def forget_planes(planes, pack):
    """Drop the pairs of PACK places."""
    if planes is not None:
        planes.found[pack] = 0


@jit
def set_plane(planes, m, side, i, j, k, l, normal, distance, keep):
    """
    Enter a pair that may pass through each other in this substep at place m.

    Parameters
    ----------
    side : number of particles on the first side
    i, j, k, l : particles, the first side first
    normal, distance : direction between the closest points at the substep's start, distance [m]
    keep : distance to be kept [m]

    """
    planes.side[m] = side
    number = planes.number
    number[m, 0], number[m, 1], number[m, 2], number[m, 3] = i, j, k, l
    for a in range(3):
        planes.normal[m, a] = normal[a]
    planes.need[m] = max(CLEAR * distance, min(0.9 * distance, LEAST * keep))


@jit(inline=True)
def next_plane(planes, m):
    """Return the first place from m on that has a pair, or one behind the end."""
    return next_marked(planes.found, m, planes.end[0])


@jit(inline=True)
def apart_now(planes, m, near, x):
    """Return the distance of a pair's sides along its direction at the positions x [m]."""
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
    """Return True if a direction separates a pair's sides; update the pair's direction."""
    if apart_now(planes, m, near, x) >= planes.need[m]:
        return True
    points, n = planes.points[0], planes.normal
    count = write_vectors(points, planes.side[m], planes.number[m], near.x, near.slot, x)
    good, best = part(points, planes.shares[0], count, (n[m, 0], n[m, 1], n[m, 2]), planes.need[m])
    n[m, 0], n[m, 1], n[m, 2] = best
    return good


def part_all(team, planes, near, state):
    """
    Do what ``part_sides`` does on the main thread, and return the same on all.

    The threads look for the first pair that may cross before.
    """


@inline(part_all)
def _part_all(team, planes, near, state):
    if isinstance(team, types.NoneType):
        return lambda team, planes, near, state: part_sides(planes, near, state, 0)
    if not is_on_device(team):
        def part_from_first(team, planes, near, state):
            first = first_of_all(team, near, first_crossing(team, planes, near, state.x))
            if first == NONE:
                return 0
            return told(team, near, part_sides(planes, near, state, first) if alone(team) else 0)
        return part_from_first

    def part_where_needed(team, planes, near, state):
        if not any_thread(team, near, first_crossing(team, planes, near, state.x) != NONE):
            return 0
        return told(team, near, part_sides(planes, near, state, 0) if alone(team) else 0)
    return part_where_needed


@jit
def first_crossing(team, planes, near, x):
    """Return the first of this thread's pairs whose direction does not separate its sides."""
    if planes is not None:
        begin, end, turn = turns(team, (planes.end[0] + PACK - 1) // PACK)
        for pack in range(begin, end, turn):
            found = np.int64(planes.found[pack])
            while found:
                m = PACK * pack + lowest_bit(found)
                found &= found - 1
                if not apart_now(planes, m, near, x) >= planes.need[m]:
                    return m
    return NONE


@jit
def first_of_all(team, near, first):
    """Return the smallest of the threads' numbers on all of them."""
    near.parts[worker(team)] = first
    wait_uneven(team)
    for k in range(workers(team)):
        first = min(first, near.parts[k])
    return first


@jit
def part_sides(planes, near, state, first):
    """
    Push apart the sides of each pair that crosses once, from the pair ``first`` on.

    Return the number of such pairs.
    """
    count = 0
    if planes is not None:
        m = next_plane(planes, first)
        while m < planes.end[0]:
            if not parts(planes, m, near, state.x):
                count += 1
                push_sides(planes, m, near, state)
            m = next_plane(planes, m + 1)
    return count


@jit
def push_sides(planes, m, near, state):
    """Push apart the sides of pair m."""
    for p in range(planes.side[m]):
        for q in range(planes.side[m], 4):
            push_pair(planes, m, near, near.slot[planes.number[m, p]],
                      near.slot[planes.number[m, q]], state)


@jit
def push_pair(planes, m, near, i, j, state):
    """Push particles i and j, on either side of pair m, to AIM need apart along its direction."""
    x, n = state.x, planes.normal
    wi, wj = inverse_mass(near.h, state, i), inverse_mass(near.h, state, j)
    total = wi + wj
    missing = AIM * planes.need[m] - (n[m, 0] * (x[0, i] - x[0, j]) + n[m, 1] * (x[1, i] - x[1, j])
                                      + n[m, 2] * (x[2, i] - x[2, j]))
    if total > 0.0 and missing > 0.0:
        for a in range(3):
            x[a, i] += n[m, a] * missing * wi / total
            x[a, j] -= n[m, a] * missing * wj / total
        invalidate_history(state.history, i)
        invalidate_history(state.history, j)
