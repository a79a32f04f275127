"""
Reordering of the neighbour list: near pairs first, pairs of renewed particles removed.

On a CPU one thread moves the pairs in place. On a GPU each thread takes a contiguous part of the
list, computes the new positions by a prefix sum over all parts (stream compaction), and copies the
pairs there. The order is the same.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import count_bits, lowest_bit
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
    earlier: np.ndarray
    """number of marked pairs before each PACK pairs of the list, shape (capacity / PACK,)"""


def new_moves(room: int) -> Moves:
    """Return scratch memory for a capacity in pairs."""
    return Moves(np.zeros((4, room), np.int32), np.zeros(room, np.float32),
                 np.zeros(room // PACK, np.int64))


def bring_forward(team, near, kind):
    """Swap the pairs marked in ``hits``, in their order, with the first ones of a kind."""


def bring_new_forward(team, near, kind):
    """Swap the pairs that a search has found with the first ones behind those in front."""


def drop_renewed(team, near, kind):
    """Remove a kind's pairs of renewed particles; set ``plan`` to the end of the others."""


@inline(bring_forward)
def _bring_forward(team, near, kind):
    if is_on_device(team):
        return lambda team, near, kind: bring_forward_in_parallel(team, near, kind)
    return lambda team, near, kind: bring_forward_serially(near, kind)


@inline(bring_new_forward)
def _bring_new_forward(team, near, kind):
    if is_on_device(team):
        return lambda team, near, kind: bring_new_forward_in_parallel(team, near, kind)
    return lambda team, near, kind: bring_new_forward_serially(near, kind)


@inline(drop_renewed)
def _drop_renewed(team, near, kind):
    if is_on_device(team):
        return lambda team, near, kind: drop_renewed_in_parallel(team, near, kind)
    return lambda team, near, kind: drop_renewed_serially(near, kind)


@jit
def bring_forward_serially(near, kind):
    """Do ``bring_forward`` on one thread."""
    front = near.kind_begin[kind]
    for pack in range(near.kind_begin[kind], near.kind_end[kind], PACK):
        hit = near.hits[pack // PACK]
        while hit:
            k = pack + lowest_bit(hit)
            hit &= hit - 1
            if front < k:
                exchange(near, front, k)
            front += 1
    near.kind_front[kind] = front


@jit
def bring_new_forward_serially(near, kind):
    """Do ``bring_new_forward`` on one thread."""
    front = near.kind_front[kind]
    for k in range(near.plan[kind], near.kind_end[kind]):
        exchange(near, front, k)
        front += 1
    near.unpruned[0] += front - near.kind_front[kind]
    near.kind_front[kind] = front


@jit
def drop_renewed_serially(near, kind):
    """Do ``drop_renewed`` on one thread."""
    begin, front = near.kind_begin[kind], near.kind_front[kind]
    near.kind_front[kind] = keep_others(near, begin, front, begin)
    near.plan[kind] = keep_others(near, front, near.kind_end[kind], near.kind_front[kind])


@jit
def keep_others(near, first, last, end):
    """Move the pairs first … last without renewed particles to ``end``; return their end."""
    for k in range(first, last):
        if not has_marked(near.renewed, near.corners, k):
            if end < k:
                copy(near, k, near, end)
            end += 1
    return end


@jit
def bring_forward_in_parallel(team, near, kind):
    """Do ``bring_forward`` on all threads of a GPU."""
    front = move_to_front(team, near, near.kind_begin[kind], near.kind_end[kind])
    if alone(team):
        near.kind_front[kind] = front


@jit
def bring_new_forward_in_parallel(team, near, kind):
    """Do ``bring_new_forward`` on all threads of a GPU."""
    front, new, end = near.kind_front[kind], near.plan[kind], near.kind_end[kind]
    first, last, step = turns(team, (end + PACK - 1) // PACK - front // PACK)
    for pack in range(front // PACK + first, front // PACK + last, step):
        before, there = max(0, new - PACK * pack), min(PACK, end - PACK * pack)
        near.hits[pack] = ((1 << there) - 1) & ~((1 << min(before, PACK)) - 1)
    wait(team)
    found = move_to_front(team, near, front, end)
    if alone(team):
        near.unpruned[0] += found - front
        near.kind_front[kind] = found


@jit
def move_to_front(team, near, front, end):
    """
    Swap the pairs marked in ``hits``, none before ``front``, with those from ``front`` on.

    The n-th marked pair moves to front + n. The pair displaced from there moves to the marked
    pair's old position, unless that is in front too. If front + n was itself the old position of
    an earlier marked pair, it holds what that one displaced (``displaced_by``).

    Returns
    -------
    end of the pairs in front

    """
    hits, earlier, base = near.hits, near.moves.earlier, front // PACK
    first, last = share(team, (end + PACK - 1) // PACK - base)
    first, last, count = base + first, base + last, 0
    for pack in range(first, last):
        count += count_bits(np.int64(hits[pack]))
    place, total = prefix_sum(team, near, count)
    for pack in range(first, last):
        earlier[pack] = place
        hit = hits[pack]
        while hit:
            copy(near, PACK * pack + lowest_bit(hit), near.moves, place)
            hit &= hit - 1
            place += 1
    wait(team)
    for pack in range(first, last):
        hit, n = hits[pack], earlier[pack]
        while hit:
            k = PACK * pack + lowest_bit(hit)
            if k >= front + total:
                copy(near, displaced_by(near, front, n), near, k)
            hit &= hit - 1
            n += 1
    wait(team)
    if first < last:
        for n in range(earlier[first], place):
            copy(near.moves, n, near, front + n)
    wait(team)
    return front + total


@jit(inline=True)
def displaced_by(near, front, n):
    """Return the original position of the pair that the n-th marked one displaces."""
    hits, k = near.hits, front + n
    while hits[k // PACK] >> k % PACK & 1:
        before = hits[k // PACK] & ((1 << k % PACK) - 1)
        k = front + near.moves.earlier[k // PACK] + count_bits(np.int64(before))
    return k


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
