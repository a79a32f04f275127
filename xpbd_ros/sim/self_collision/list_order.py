"""
Reordering of the neighbour list: near pairs first, pairs of renewed particles removed.

Each thread takes a contiguous part of the list, and a prefix sum over all parts tells where its
pairs go; the order does not depend on the number of threads. On a CPU one thread removes pairs, in
place.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import count_bits, lowest_bit
from xpbd_ros.sim.backend.simd_integers import compress
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import (
    alone,
    is_on_device,
    share,
    turns,
    wait,
    wait_uneven,
    worker,
    workers,
)


class Moves(NamedTuple):
    """Scratch memory of a GPU: pairs between their old and new positions."""

    corners: np.ndarray
    """as in ``NeighbourList``, shape (4, capacity)"""
    keep: np.ndarray
    """the same, shape (capacity,)"""


def new_moves(room: int) -> Moves:
    """Return scratch memory for a capacity in pairs."""
    return Moves(np.zeros((4, room), np.int32), np.zeros(room, np.float32))


@jit
def bring_forward(team, near, kind):
    """
    Let the marked pairs of a kind be the first ones: exchange others there with those behind.

    ``hits`` goes with the pairs, and is zero behind.
    """
    marks, hits, movers, base = near.marks, near.hits, near.movers, near.kind_begin[kind]
    first, last = share(team, (near.kind_end[kind] - base + PACK - 1) // PACK)
    first, last, count = base // PACK + first, base // PACK + last, 0
    for pack in range(first, last):
        count += count_bits(np.int64(marks[pack]))
    before, total = prefix_sum(team, near, count)
    front, count = base + total, 0
    wait_uneven(team)
    for pack in range(first, last):
        count += count_bits(np.int64(marks[pack] & ~first_bits(front - PACK * pack)))
    m = prefix_sum(team, near, count)[0]
    for pack in range(first, last):
        behind = marks[pack] & ~first_bits(front - PACK * pack)
        while behind:
            lane = lowest_bit(np.int64(behind))
            movers[m] = PACK * pack + lane << 1 | hits[pack] >> lane & 1
            behind &= behind - 1
            m += 1
    wait_uneven(team)
    m = PACK * first - base - before    # others before this thread's part
    for pack in range(first, last):
        there = first_bits(front - PACK * pack)
        others, hit = there & ~marks[pack], hits[pack] & there
        while others:
            lane = lowest_bit(np.int64(others))
            exchange(near, PACK * pack + lane, movers[m] >> 1)
            hit |= (movers[m] & 1) << lane
            others &= others - 1
            m += 1
        hits[pack] = hit
    if alone(team):
        near.kind_front[kind] = front
    wait_uneven(team)


@jit(inline=True)
def first_bits(count):
    """Return the lowest bits of a pack, at most PACK of them."""
    return (1 << min(max(count, 0), PACK)) - 1


@jit
def bring_new_forward(team, near, kind):
    """Exchange the pairs that a search has found with the first ones behind those in front."""
    front, new, end = near.kind_front[kind], near.plan[kind], near.kind_end[kind]
    count = min(new - front, end - new)
    first, last, step = turns(team, count)
    for m in range(first, last, step):
        exchange(near, front + m, end - count + m)
    wait_uneven(team)    # all have read the ends
    if alone(team):
        near.unpruned[0] += end - new
        near.kind_front[kind] = front + end - new
    wait_uneven(team)


def drop_renewed(team, near, kind):
    """Remove a kind's pairs of renewed particles; set ``plan`` to the end of the others."""


@inline(drop_renewed)
def _drop_renewed(team, near, kind):
    if is_on_device(team):
        return lambda team, near, kind: drop_renewed_in_parallel(team, near, kind)
    return lambda team, near, kind: drop_renewed_serially(near, kind)


@jit
def drop_renewed_serially(near, kind):
    """Do ``drop_renewed`` on one thread."""
    begin, front = near.kind_begin[kind], near.kind_front[kind]
    near.kind_front[kind] = keep_others(near, begin, front, begin)
    near.plan[kind] = keep_others(near, front, near.kind_end[kind], near.kind_front[kind])


@jit
def keep_others(near, first, last, end):
    """Move the pairs first … last without renewed particles to ``end``; return their end."""
    k = first
    while k + PACK <= last:
        kept = 0
        for lane in range(PACK):
            kept |= (not has_marked(near.renewed, near.corners, k + lane)) << lane
        for p in range(4):
            compress(near.corners[p], k, kept, near.corners[p], end)
        compress(near.keep, k, kept, near.keep, end)
        end += count_bits(kept)
        k += PACK
    while k < last:
        if not has_marked(near.renewed, near.corners, k):
            copy(near, k, near, end)
            end += 1
        k += 1
    return end


@jit
def drop_renewed_in_parallel(team, near, kind):
    """Do ``drop_renewed`` on all threads of a GPU."""
    begin, front = near.kind_begin[kind], near.kind_front[kind]
    kept = compact(team, near, begin, front, begin)
    end = compact(team, near, front, near.kind_end[kind], kept)
    if alone(team):
        near.kind_front[kind], near.plan[kind] = kept, end


@jit
def compact(team, near, first, last, end):
    """Do ``keep_others`` on all threads of a GPU."""
    one, past = share(team, last - first)
    count = 0
    for k in range(first + one, first + past):
        count += not has_marked(near.renewed, near.corners, k)
    place, total = prefix_sum(team, near, count)
    n = place
    for k in range(first + one, first + past):
        if not has_marked(near.renewed, near.corners, k):
            copy(near, k, near.moves, n)
            n += 1
    wait(team)
    for m in range(place, n):
        copy(near.moves, m, near, end + m)
    wait(team)
    return end + total


@jit
def prefix_sum(team, near, count):
    """Return the sum of the counts of the threads before this one, and of all."""
    near.parts[worker(team)] = count
    wait_uneven(team)
    before = total = 0
    for k in range(workers(team)):
        if k < worker(team):
            before += near.parts[k]
        total += near.parts[k]
    return before, total


@jit(inline=True)
def has_marked(marks, corners, k):
    """Return True if pair k has a particle that is marked; unsigned, an index is not negative."""
    return (marks[np.uint32(corners[0, k])] | marks[np.uint32(corners[1, k])]
            | marks[np.uint32(corners[2, k])] | marks[np.uint32(corners[3, k])])


@jit(inline=True)
def copy(source, k, target, l):
    """Copy pair k to place l of the same list or another one."""
    target.keep[l] = source.keep[k]
    for p in range(4):
        target.corners[p, l] = source.corners[p, k]


@jit(inline=True)
def exchange(near, k, l):
    """Exchange two listed pairs."""
    corners, keep = near.corners, near.keep
    keep[k], keep[l] = keep[l], keep[k]
    for p in range(4):
        corners[p, k], corners[p, l] = corners[p, l], corners[p, k]
