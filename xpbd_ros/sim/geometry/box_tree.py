"""
Tree of bounding boxes over points, edges or triangles, for overlap queries.

Items are ordered by recursive bisection of their positions at rest, so neighbours in the tree are
neighbours on the surface. A node bounds PACK neighbouring nodes or items; its members never
change, and ``update_boxes`` refits it to new positions. Queries compare a box with PACK
boxes side by side. Results are in tree order, so they depend on nothing but the boxes.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    bits,
    both,
    lanes,
    larger,
    load,
    lowest_bit,
    smaller,
    splat,
    store,
)
from xpbd_ros.sim.backend.simd_records import load_records, PACK
from xpbd_ros.sim.backend.threads import turns_on_device, wait_on_device

LARGEST = float(np.finfo(np.float32).max)
"""largest coordinate of a box [m]: a box of infinite size would overlap the empty boxes too"""


class BoxTree(NamedTuple):
    """Items and nodes."""

    corners: np.ndarray
    """particles of each item in tree order, shape (corners, items)"""
    low: np.ndarray
    """
    low corners of the boxes of items, then of each level of nodes [m], float32, shape (3, boxes)

    Each level begins at a multiple of PACK; boxes behind its end are empty.
    """
    high: np.ndarray
    """high corners [m], float32, shape (3, boxes)"""
    begin: np.ndarray
    """first box of each level, and the end, shape (levels + 1,)"""
    marked: np.ndarray
    """bits of the marked items of each pack, shape (packs,)"""
    found: np.ndarray
    """scratch of ``find_packs``: two lists of packs for each thread, shape (threads, 2, packs)"""


def new_box_tree(corners: np.ndarray, rest: np.ndarray, group: np.ndarray,
                 threads: int = 1) -> BoxTree:
    """
    Return the tree of some items; its boxes are empty.

    Parameters
    ----------
    corners : particles of each item, shape (items, corners)
    rest : positions at rest [m], shape (particles, 3)
    group : group of each particle; items of one group are neighbours in the tree
    threads : that query the tree at once

    """
    order = bisected(rest[corners].mean(1), group[corners[:, 0]])
    sizes = [len(corners)]
    while sizes[-1] > PACK:
        sizes.append(-(-sizes[-1] // PACK))
    begin = np.cumsum([0, *(-(-size // PACK) * PACK for size in sizes)])
    low = np.full((3, begin[-1]), np.inf, np.float32)
    return BoxTree(np.ascontiguousarray(corners[order].T.astype(np.int32)), low, -low, begin,
                   np.zeros(begin[1] // PACK, np.int64),
                   np.zeros((threads, 2, max(1, begin[1] // PACK)), np.int64))


def bisected(points: np.ndarray, group: np.ndarray) -> np.ndarray:
    """
    Return the order of points, shape (points, 3), group by group.

    Those of a group are divided across the longest side of the box around them, at the place that
    is a multiple of the largest node's size, until the places between are in one pack.
    """
    order = np.argsort(group, kind='stable')
    ends = [*(np.flatnonzero(np.diff(group[order])) + 1).tolist(), len(order)]
    parts = [(first, end) for first, end in zip([0, *ends], ends) if end > first]
    while parts:
        first, end = parts.pop()
        bit = (first ^ (end - 1)).bit_length() - 1    # the highest in which the places differ
        if 1 << max(bit, 0) >= PACK:
            part, middle = order[first:end], (end - 1) >> bit << bit
            side = np.ptp(points[part], axis=0).argmax()
            order[first:end] = part[np.argsort(points[part, side], kind='stable')]
            parts += [(first, middle), (middle, end)]
    return order


@jit
def update_boxes(team, tree, spheres):
    """Compute all boxes so that they bound the particles' spheres: records x, y, z, radius [m]."""
    corners, low, high, count = tree.corners, tree.low, tree.high, lanes(spheres)
    vectors = corners.shape[1] // count * count
    begin, end, turn = turns_on_device(team, vectors // count)
    for c in range(begin * count, end * count, turn * count):
        above, below = splat(spheres, np.inf), splat(spheres, -np.inf)
        least, most = (above, above, above), (below, below, below)
        for k in range(len(corners)):
            x, y, z, radius = load_records(spheres, corners[k], c)
            least = (smaller(x - radius, least[0]), smaller(y - radius, least[1]),
                     smaller(z - radius, least[2]))
            most = (larger(x + radius, most[0]), larger(y + radius, most[1]),
                    larger(z + radius, most[2]))
        for a in range(3):
            store(low[a], c, larger(-LARGEST, least[a]))
            store(high[a], c, smaller(LARGEST, most[a]))
    begin, end, turn = turns_on_device(team, corners.shape[1] - vectors)
    for c in range(vectors + begin, vectors + end, turn):
        for a in range(3):
            least, most = np.inf, -np.inf
            for k in range(len(corners)):
                i = corners[k, c]
                least = min(least, spheres[i, a] - spheres[i, 3])
                most = max(most, spheres[i, a] + spheres[i, 3])
            low[a, c], high[a, c] = max(-LARGEST, least), min(LARGEST, most)
    for level in range(1, len(tree.begin) - 1):
        wait_on_device(team)
        first, below = tree.begin[level], tree.begin[level - 1]
        begin, end, turn = turns_on_device(team, (first - below) // PACK)
        for pack in range(begin, end, turn):
            for a in range(3):
                least, most = np.inf, -np.inf
                for k in range(below + pack * PACK, below + (pack + 1) * PACK):
                    least, most = min(least, low[a, k]), max(most, high[a, k])
                low[a, first + pack], high[a, first + pack] = least, most


@jit
def mark_items(team, tree, marks):
    """Mark the items of which a particle is marked."""
    corners = tree.corners
    begin, end, turn = turns_on_device(team, len(tree.marked))
    for pack in range(begin, end, turn):
        found = 0
        for c in range(PACK * pack, min(PACK * (pack + 1), corners.shape[1])):
            marked = False
            for p in range(len(corners)):
                marked |= marks[corners[p, c]]
            found |= marked << (c - PACK * pack)
        tree.marked[pack] = found


@jit(inline=True)
def box_of(tree, k):
    """Return the low and high corner of box k [m]."""
    low, high = tree.low, tree.high
    return (low[0, k], low[1, k], low[2, k]), (high[0, k], high[1, k], high[2, k])


@jit(inline=True)
def overlaps(tree, begin, box):
    """Return bits of the PACK boxes from ``begin`` on that overlap a box."""
    found, low, high = 0, tree.low, tree.high
    for q in range(0, PACK, lanes(low)):
        k = begin + q
        x = both(load(low[0], k) <= box[1][0], load(high[0], k) >= box[0][0])
        y = both(load(low[1], k) <= box[1][1], load(high[1], k) >= box[0][1])
        z = both(load(low[2], k) <= box[1][2], load(high[2], k) >= box[0][2])
        found |= bits(both(x, both(y, z))) << q
    return found


@jit
def find_packs(tree, box, worker):
    """
    Return the packs of items, rising, in whose bounds are parts of a box.

    Parameters
    ----------
    tree : to be queried
    box : low and high corner [m]
    worker : number of the thread that asks

    Returns
    -------
    array with the first item of each pack, the thread's scratch; number of packs

    """
    level, found = len(tree.begin) - 2, tree.found[worker]
    now, count = found[level & 1], 1
    now[0] = tree.begin[level]
    while level > 0:
        below, then, further = tree.begin[level - 1], found[(level - 1) & 1], 0
        for n in range(count):
            hit = overlaps(tree, now[n], box)
            while hit:
                then[further] = below + PACK * (now[n] + lowest_bit(hit) - tree.begin[level])
                further += 1
                hit &= hit - 1
        level, now, count = level - 1, then, further
    return now, count
