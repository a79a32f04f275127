"""
Close pairs: near pairs about pads that touch, or nearly so, at the substep's start.

Their normals, weights and deficits are computed by lanes, for the pairs about pads alone: these
are few, and spread over all groups of near pairs.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    bits,
    both,
    lanes,
    load,
    root,
    select,
    smaller,
    store,
)
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import alone, turns, wait_uneven
from xpbd_ros.sim.geometry.closest_points_simd import dot
from xpbd_ros.sim.self_collision.near_pairs import closest, is_inside
from xpbd_ros.sim.self_collision.neighbour_list import INV_MASS, next_marked
from xpbd_ros.sim.self_collision.pair_contacts import (
    load_corners,
    NEVER,
    store_vector,
    store_weights,
)


class ClosePairs(NamedTuple):
    """The pairs about pads, by kind; each kind begins at a multiple of PACK."""

    count: np.ndarray
    """end of the pairs about pads, and number of close ones among them; shape (2,)"""
    found: np.ndarray
    """places of the close ones, shape (capacity,)"""
    number: np.ndarray
    """number of each pair among the near pairs, shape (capacity,)"""
    kind: np.ndarray
    """kind of the pairs of each PACK places, shape (capacity / PACK,)"""
    particles: np.ndarray
    """as in ``PairContacts``, shape (4, capacity)"""
    keep: np.ndarray
    """the same, shape (capacity,)"""
    normal: np.ndarray
    """n at the substep's start, shape (3, capacity)"""
    weight: np.ndarray
    """b there, shape (4, capacity)"""
    deficit: np.ndarray
    """-C there [m], shape (capacity,)"""


def new_close_pairs(room: int) -> ClosePairs:
    """Return no pairs, with the capacity of ``room``, a multiple of PACK."""
    def rows(*shape):
        return np.zeros((*shape, room), np.float32)
    return ClosePairs(np.zeros(2, np.int64), np.zeros(room, np.int64), np.zeros(room, np.int64),
                      np.zeros(room // PACK, np.int64), np.zeros((4, room), np.int32), rows(),
                      rows(3), rows(4), rows())


@jit
def find_close(team, close, about, near, pairs, least, apart):
    """
    Find the pairs with -C above ``least`` whose first particle is about pads.

    Those that overlap keep the distance at which they are, plus ``apart`` [m].
    """
    mark_about_pads(team, about, near, pairs)
    wait_uneven(team)
    if alone(team):
        list_about_pads(close, near, pairs)
    wait_uneven(team)
    first, end, step = turns(team, close.count[0] // PACK)
    for pack in range(first, end, step):
        found = 0
        for q in range(PACK * pack, PACK * (pack + 1), lanes(near.start)):
            found |= place_at_start(close, near, close.kind[pack], q, least, apart) << (
                q - PACK * pack)
        near.hits[pack] = found
    wait_uneven(team)
    if alone(team):
        list_close(close, near)


@jit
def mark_about_pads(team, about, near, pairs):
    """Set ``hits`` for the pairs whose first particle is about pads."""
    first, end, step = turns(team, pairs.end[0] // PACK)
    for pack in range(first, end, step):
        found = 0
        for lane in range(PACK):
            found |= about[np.uint32(pairs.particles[0, PACK * pack + lane])] << lane
        near.hits[pack] = found


@jit
def list_about_pads(close, near, pairs):
    """Copy the pairs with a bit in ``hits``."""
    end, kind, k = 0, -1, next_marked(near.hits, 0, pairs.end[0])
    while k < pairs.end[0]:
        if pairs.kind[k // PACK] != kind:
            end, kind = fill_up(close, near, end), pairs.kind[k // PACK]
        close.kind[end // PACK], close.number[end], close.keep[end] = kind, k, pairs.keep[k]
        for p in range(4):
            close.particles[p, end] = pairs.particles[p, k]
        end += 1
        k = next_marked(near.hits, k + 1, pairs.end[0])
    close.count[0] = fill_up(close, near, end)


@jit(inline=True)
def fill_up(close, near, end):
    """Leave the places up to the next multiple of PACK empty; return it."""
    while end % PACK:
        close.keep[end] = NEVER
        for p in range(4):
            close.particles[p, end] = len(near.slot)
        end += 1
    return end


@jit(inline=True)
def place_at_start(close, near, kind, q, least, apart):
    """Set normals, weights and deficits of a vector of pairs; return bits of those to list."""
    a, b, c, d = load_corners(near.start, close.particles, q)
    v, weight = closest(kind, a, b, c, d)
    distance = root(dot(v, v))
    there, keep = distance > 0.0, load(close.keep, q)
    per, deficit = 1.0 / select(there, distance, 1.0), smaller(keep, distance + apart) - distance
    store_vector(close.normal, q, (per * v[0], per * v[1], per * v[2]))
    store_weights(close, q, weight)
    store(close.deficit, q, deficit)
    return bits(both(both(is_inside(kind, weight), there), deficit > least))


@jit
def list_close(close, near):
    """List the pairs with a bit in ``hits`` and a particle of finite mass."""
    found, m = 0, next_marked(near.hits, 0, close.count[0])
    while m < close.count[0]:
        if is_movable(close, near, m):
            close.found[found] = m
            found += 1
        m = next_marked(near.hits, m + 1, close.count[0])
    close.count[1] = found


@jit(inline=True)
def is_movable(close, near, m):
    """Return True if a particle of a pair has a finite mass."""
    total = 0.0
    for p in range(4):
        total += near.precise_move[close.particles[p, m], INV_MASS]
    return total > 0.0
