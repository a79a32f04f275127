"""
Search for the pairs of the neighbour list, over trees of bounding boxes (``geometry.box_tree``).

It happens when a particle's motion since the search for its pairs exceeds its margin. While these
are few, only pairs of such particles are sought; the list is then that of a search for all pairs
with the same y and margins, in another order. Boxes are compared by lanes, and so are the closest
points of the candidates.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import bits, lanes, lowest_bit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.geometry.box_tree import box_of, find_packs, overlaps, update_boxes
from xpbd_ros.sim.geometry.closest_points_simd import dot
from xpbd_ros.sim.self_collision.near_pairs import closest, kept_distance, travel_of
from xpbd_ros.sim.self_collision.neighbour_list import (
    are_welded,
    CANDIDATES,
    EDGES,
    gone_since,
    has_marked,
    POINTS,
    room_of,
    TRAVEL,
    TRIANGLES,
    UNKNOWN,
    UP,
)
from xpbd_ros.sim.self_collision.pair_contacts import load_corners

FEW = 0.25
"""largest part of the particles whose pairs alone are sought"""
SOON = 0.5
"""part of the margin beyond the travel from which on a particle is about to leave it"""
MORE = 0.25
"""room for further pairs of particle and triangle, relative to their number in a full search"""
HALVINGS = 8
"""most halvings of margins that yield more pairs than the capacity"""
MARGIN = TRAVEL
"""column of ``NeighbourList.start`` that holds the margins during a search"""
ROUNDING = 4e-7
"""bound of the rounding errors of float32 distances, relative to the largest coordinate"""


@jit
def seek(near, thickness, left):
    """
    Seek pairs, with margins for ``left`` substeps of each particle's present motion.

    Where few particles are about to leave their margins, only the pairs of these are sought.
    """
    near.count[0] += 1
    if not near.complete[0] or not seek_some(near, near.surface, thickness, left):
        seek_all(near, thickness, left)


@jit(inline=True)
def set_margin(near, i, left):
    """Set a particle's margin, from its present position on."""
    travel = near.x[i, TRAVEL]
    near.margin[i] = min(left * travel, max(2.0 * travel, near.reach))
    for a in range(3):
        near.seen[i, a] = near.x[i, a] - near.drift[a]


@jit
def seek_some(near, surface, thickness, left):
    """Seek the pairs of particles about to leave their margins; return False if too many."""
    count, renewed = 0, near.renewed
    for i in range(len(near.slot)):
        travel, moved = near.x[i, TRAVEL], gone_since(near.x, near.seen, near.drift, i)
        renewed[i] = moved > SOON * (near.margin[i] - travel)
        count += renewed[i]
    if count > FEW * len(near.slot):
        return False
    for i in range(len(near.slot)):
        if renewed[i]:
            set_margin(near, i, left)
    rounding = begin_search(near, surface)
    size = thickness + rounding
    if surface is None:
        first = drop_renewed(near, POINTS)
        end = list_renewed(near, POINTS, near.points, near.points, size, first, False)
        return end_kind(near, POINTS, drop_far(near, first, end, thickness, rounding)) == 0
    else:    # Numba prunes the branch that is not taken
        triangles, edges, points = surface.triangles, surface.edges, near.points
        end = drop_renewed(near, TRIANGLES)
        end = list_renewed(near, TRIANGLES, triangles, points, size, end, False)
        end = list_renewed(near, TRIANGLES, points, triangles, size, end, True)
        lost = end_kind(near, TRIANGLES, end)
        end = drop_renewed(near, EDGES)
        end = list_renewed(near, EDGES, edges, edges, size, end, False)
        return lost + end_kind(near, EDGES, end) == 0


@jit
def drop_renewed(near, kind):
    """Drop a kind's pairs of renewed particles from the list; return the end of the others."""
    corners, renewed, end = near.corners, near.renewed, near.kind_begin[kind]
    for k in range(near.kind_begin[kind], near.kind_end[kind]):
        if not has_marked(renewed, corners, k):
            if end < k:
                near.keep[end] = near.keep[k]
                for p in range(4):
                    corners[p, end] = corners[p, k]
            end += 1
    return end


@jit(inline=True)
def is_renewed(near, tree, c):
    """Return True if an item of a tree has a renewed particle."""
    found = False
    for p in range(len(tree.corners)):
        found |= near.renewed[tree.corners[p, c]]
    return found


@jit
def list_renewed(near, kind, tree, others, size, end, swapped):
    """
    List the pairs of the renewed items of a tree closer than ``size`` + margins, from ``end`` on.

    Parameters
    ----------
    near, kind : neighbour list, and kind of its pairs
    tree, others : trees of the two sides; if they are one, each pair is listed once
    size : distance [m]
    end : end of the pairs so far
    swapped : True if ``tree`` is that of the second side of a pair; then only pairs of items that
        are not renewed on the first side

    Returns
    -------
    end of the pairs; it may be beyond the capacity

    """
    count = 0
    for c in range(tree.corners.shape[1]):
        if not is_renewed(near, tree, c):
            continue
        box = box_of(tree, c, size)
        packs, reached = find_packs(others, box)
        for n in range(reached):
            other = packs[n]
            hit = overlaps(others, other, box)
            if count + PACK > CANDIDATES:
                end, count = keep_close(near, kind, size, end, count), 0
            while hit:
                d = other + lowest_bit(hit)
                hit &= hit - 1
                if (swapped or (kind != TRIANGLES and d <= c)) and is_renewed(near, others, d):
                    continue
                if swapped or (kind != TRIANGLES and d < c):
                    count += add_candidate(near, kind, others, tree, d, c, count)
                else:
                    count += add_candidate(near, kind, tree, others, c, d, count)
    return keep_close(near, kind, size, end, count)


@jit
def seek_all(near, thickness, left):
    """Seek all pairs."""
    near.count[4] += 1
    near.drift[:] = 0.0
    for a in range(3):
        near.origin[a] = near.x[0, a]
    for i in range(len(near.slot)):
        set_margin(near, i, left)
    lost = list_pairs(near, near.surface, thickness, False)
    for halving in range(HALVINGS):
        if lost == 0:
            break
        for i in range(len(near.slot)):
            near.margin[i] *= 0.5
        lost = list_pairs(near, near.surface, thickness, halving == HALVINGS - 1)
    near.count[1] += lost
    near.complete[0] = lost == 0
    for i in range(len(near.slot)):
        near.x[i, TRAVEL] = min(near.x[i, TRAVEL], near.margin[i])


@jit
def list_pairs(near, surface, thickness, to_the_end):
    """
    List the pairs closer than thickness + margins; return the number beyond the capacity.

    Unless ``to_the_end``, the search ends soon after the first pair beyond the capacity.
    """
    rounding = begin_search(near, surface)
    size = thickness + rounding
    near.kind_begin[:] = near.kind_end[:] = 0
    if surface is None:
        end = begin_kind(near, POINTS, 0)
        end = list_kind(near, POINTS, near.points, near.points, size, end, to_the_end)
        return end_kind(near, POINTS, drop_far(near, 0, end, thickness, rounding))
    else:    # Numba prunes the branch that is not taken
        end = begin_kind(near, TRIANGLES, 0)
        end = list_kind(near, TRIANGLES, surface.triangles, near.points, size, end, to_the_end)
        lost = end_kind(near, TRIANGLES, end)
        end = begin_kind(near, EDGES, end + int(MORE * end))
        near.kind_room[TRIANGLES] = end
        end = list_kind(near, EDGES, surface.edges, surface.edges, size, end, to_the_end)
        return lost + end_kind(near, EDGES, end)


@jit
def begin_search(near, surface):
    """Load y and the margins, and compute the boxes; return a bound of rounding errors [m]."""
    start, y = near.start, near.seen
    for i in range(len(near.slot)):
        for a in range(3):
            start[i, a] = y[i, a] + near.drift[a] - near.origin[a]
        start[i, MARGIN] = UP * near.margin[i]
    update_boxes(near.points, start)
    if surface is not None:    # Numba prunes the branch that is not taken
        update_boxes(surface.triangles, start)
        update_boxes(surface.edges, start)
    return ROUNDING * extent(near)


@jit
def extent(near):
    """Return the largest coordinate of ``near.start`` [m]."""
    most = 0.0
    for i in range(len(near.slot)):
        most = max(most, abs(near.start[i, 0]), abs(near.start[i, 1]), abs(near.start[i, 2]))
    return most


@jit
def list_kind(near, kind, tree, others, size, end, to_the_end):
    """
    List the pairs of items of two trees closer than ``size`` + margins, from ``end`` on.

    Each pair of a tree with itself is listed once.

    Returns
    -------
    end of the pairs; it may be beyond the capacity

    """
    places, count = tree.corners.shape[1], 0
    for pack in range(0, places, PACK):
        if end > near.kind_room[kind] and not to_the_end:
            break
        packs, reached = find_packs(others, bounds_of(tree, pack, size))
        for n in range(reached):
            other = packs[n]
            if kind != TRIANGLES and other < pack:    # only pairs with a later item
                continue
            mine = overlaps(tree, pack, bounds_of(others, other, size))
            while mine:
                c = pack + lowest_bit(mine)
                mine &= mine - 1
                hit = overlaps(others, other, box_of(tree, c, size))
                if kind != TRIANGLES and other == pack:
                    hit &= -(2 << (c - pack))
                if count + PACK > CANDIDATES:
                    end, count = keep_close(near, kind, size, end, count), 0
                while hit:
                    d = other + lowest_bit(hit)
                    hit &= hit - 1
                    count += add_candidate(near, kind, tree, others, c, d, count)
    return keep_close(near, kind, size, end, count)


@jit(inline=True)
def bounds_of(tree, pack, size):
    """Return the box around the items of a pack, ``size`` larger on each side [m]."""
    if len(tree.begin) == 2:    # the only pack
        low, high = box_of(tree, pack, size)
        for k in range(pack + 1, pack + PACK):
            l, h = box_of(tree, k, size)
            low = min(low[0], l[0]), min(low[1], l[1]), min(low[2], l[2])
            high = max(high[0], h[0]), max(high[1], h[1]), max(high[2], h[2])
        return low, high
    return box_of(tree, tree.begin[1] + pack // PACK, size)


@jit(inline=True)
def add_candidate(near, kind, tree, others, c, d, count):
    """Write a pair of items behind the list unless they are joined; return True if written."""
    kin, corners, dummy = near.kin, near.corners, len(near.slot)
    k = room_of(near) + count
    if kind == TRIANGLES:
        i = others.corners[0, d]
        j, l, m = tree.corners[0, c], tree.corners[1, c], tree.corners[2, c]
        if are_welded(kin, i, j) or are_welded(kin, i, l) or are_welded(kin, i, m):
            return False
    elif kind == EDGES:
        i, j = tree.corners[0, c], tree.corners[1, c]
        l, m = others.corners[0, d], others.corners[1, d]
        if (are_welded(kin, i, l) or are_welded(kin, i, m) or are_welded(kin, j, l)
                or are_welded(kin, j, m)):
            return False
    else:
        i, j = tree.corners[0, c], others.corners[0, d]
        i, j, l, m = min(i, j), max(i, j), dummy, dummy
        if are_welded(kin, i, j):
            return False
    corners[0, k], corners[1, k], corners[2, k], corners[3, k] = i, j, l, m
    return True


@jit
def keep_close(near, kind, size, end, count):
    """Append those of the candidates behind the list that are closer than ``size`` + margins."""
    room, first, corners = near.kind_room[kind], room_of(near), near.corners
    for q in range(first, first + count, lanes(near.start)):
        a, b, c, d = load_corners(near.start, corners, q)
        v, reach = closest(kind, a, b, c, d)[0], size + travel_of(kind, a, b, c, d)
        found = bits(dot(v, v) < reach * reach) & ((1 << min(PACK, first + count - q)) - 1)
        while found:
            k = q + lowest_bit(found)
            found &= found - 1
            if end < room:
                for p in range(4):
                    corners[p, end] = corners[p, k]
                near.keep[end] = UNKNOWN
            end += 1
    return end


@jit
def drop_far(near, first, end, thickness, rounding):
    """Drop pairs further apart than they have to keep + margins from ``first`` on."""
    corners, x, left = near.corners, near.start, first
    for q in range(first // PACK * PACK, min(end, room_of(near)), lanes(x)):
        kept_distance(near, POINTS, q, thickness)
    for k in range(first, min(end, room_of(near))):
        i, j, square = corners[0, k], corners[1, k], 0.0
        for a in range(3):
            square += (x[i, a] - x[j, a])**2
        if square < (near.keep[k] + x[i, MARGIN] + x[j, MARGIN] + rounding)**2:
            corners[0, left], corners[1, left], near.keep[left] = i, j, near.keep[k]
            left += 1
    return left + max(0, end - room_of(near))


@jit
def begin_kind(near, kind, end):
    """Begin the pairs of a kind where the others end, at a multiple of PACK; return it."""
    near.kind_room[kind] = room_of(near)
    near.kind_begin[kind] = near.kind_end[kind] = min(
        (end + PACK - 1) // PACK * PACK, room_of(near))
    return near.kind_begin[kind]


@jit
def end_kind(near, kind, end):
    """End the pairs of a kind, fill up the last pack; return the number beyond the capacity."""
    room, dummy = near.kind_room[kind], len(near.slot)
    near.kind_end[kind] = min(end, room)
    for c in range(min(end, room), min((end + PACK - 1) // PACK * PACK, room)):
        for p in range(4):
            near.corners[p, c] = dummy
    return max(0, end - room)
