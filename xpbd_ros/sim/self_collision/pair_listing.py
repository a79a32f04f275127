"""
List the pairs of two trees' items that are close, one pack of items of the first tree at a time.

The threads take packs in turn. Each writes the pairs that it finds to its own buffer, and what
they found is then put in the order of the packs, so that the list is that of one thread. Should a
buffer have no room, one thread lists all pairs.
"""

from numba import types

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import bits, count_bits, lanes, lowest_bit
from xpbd_ros.sim.backend.simd_integers import compress, equal_bits, fill
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import alone, count_up, wait_uneven, worker, workers
from xpbd_ros.sim.geometry.box_tree import box_of, find_packs, overlaps
from xpbd_ros.sim.geometry.closest_points_simd import dot
from xpbd_ros.sim.self_collision.near_pairs import closest, travel_of
from xpbd_ros.sim.self_collision.neighbour_list import (
    are_welded,
    CANDIDATES,
    EDGES,
    FULL,
    POINTS,
    TOLD,
    TRIANGLES,
    UNKNOWN,
)
from xpbd_ros.sim.self_collision.pair_contacts import load_corners

ALL, RENEWED, SWAPPED = range(3)
"""
which pairs: all; those of the marked items of the first tree; those of marked items, in a pair the
second side, with others that are not
"""
EVERY = (1 << PACK) - 1
"""bits of all items of a pack"""


def list_pairs_of(team, near, kind, tree, others, end, which, to_the_end):
    """
    List the pairs of items of two trees closer than their margins, from ``end`` on.

    Each pair of a tree with itself is listed once. Unless ``to_the_end``, the search ends soon
    after the first pair beyond the capacity.

    Parameters
    ----------
    team : threads that take part
    near, kind : neighbour list, and kind of its pairs
    tree, others : trees of the two sides
    end : end of the pairs so far
    which : ALL, RENEWED or SWAPPED
    to_the_end : False if it is enough to know that there is no room for all

    Returns
    -------
    end of the pairs; it may be beyond the capacity

    """


@inline(list_pairs_of)
def _list_pairs_of(team, near, kind, tree, others, end, which, to_the_end):
    if isinstance(team, types.NoneType):
        return lambda team, near, kind, tree, others, end, which, to_the_end: (
            list_alone(near, kind, tree, others, end, which, to_the_end))
    return lambda team, near, kind, tree, others, end, which, to_the_end: (
        list_together(team, near, kind, tree, others, end, which, to_the_end))


@jit
def list_alone(near, kind, tree, others, end, which, to_the_end):
    """Do so on one thread."""
    first, room = end, near.kind_room[kind]
    for pack in range(0, tree.corners.shape[1], PACK):
        if end > room and not to_the_end:
            break
        end = list_pack(near, near.corners, 0, kind, tree, others, pack, end, room, which)
    near.keep[first:min(end, room)] = UNKNOWN
    return end


@jit
def list_together(team, near, kind, tree, others, end, which, to_the_end):
    """Do so on all threads of a team."""
    if workers(team) > 1:
        me, found, pieces = worker(team), 0, near.pieces
        buffer = near.buffers[me]
        room = room_in(buffer)
        for p in range(me, packs_of(tree), workers(team)):
            pieces[0, p] = found
            if found <= room:
                found = list_pack(near, buffer, me, kind, tree, others, PACK * p, found,
                                  room, which)
            pieces[1, p] = found - pieces[0, p]
        if found > room:
            count_up(team, near.plan, FULL, 1)
        wait_uneven(team)
        if not near.plan[FULL]:
            return gather(team, near, kind, packs_of(tree), end)
    wait_uneven(team)
    if alone(team):
        near.plan[FULL] = 0
        near.plan[TOLD] = list_alone(near, kind, tree, others, end, which, to_the_end)
    wait_uneven(team)
    return near.plan[TOLD]


@jit
def gather(team, near, kind, packs, end):
    """Copy what the threads found to the list, in the order of the packs; return the end."""
    me, pieces, corners, room = worker(team), near.pieces, near.corners, near.kind_room[kind]
    buffer = near.buffers[me]
    for p in range(packs):
        if p % workers(team) == me:
            first = pieces[0, p]
            for k in range(min(pieces[1, p], room - end)):
                near.keep[end + k] = UNKNOWN
                for c in range(4):
                    corners[c, end + k] = buffer[c, first + k]
        end += pieces[1, p]
    wait_uneven(team)
    return end


@jit(inline=True)
def packs_of(tree):
    """Return the number of packs of a tree's items."""
    return (tree.corners.shape[1] + PACK - 1) // PACK


@jit(inline=True)
def room_in(corners):
    """Return the capacity of a list in pairs."""
    return corners.shape[1] - CANDIDATES


@jit
def list_pack(near, corners, me, kind, tree, others, pack, end, room, which):
    """
    Append the pairs of the items of a pack to a list of a thread.

    Parameters
    ----------
    corners, end, room : the list, its end, and its end at most
    me : number of the thread
    pack : first item
    near, kind, tree, others, which : as for ``list_pairs_of``

    Returns
    -------
    end of the pairs; it may be beyond the room

    """
    wanted, count = EVERY if which == ALL else tree.marked[pack // PACK], 0
    if wanted == 0:
        return end
    packs, reached = find_packs(others, bounds_of(tree, pack), me)
    for n in range(reached):
        other = packs[n]
        free = allowed(others, kind, pack, other, which)
        if free == 0 and other != pack:
            continue
        mine = wanted & overlaps(tree, pack, bounds_of(others, other))
        while mine:
            lane = lowest_bit(mine)
            mine &= mine - 1
            hit = overlaps(others, other, box_of(tree, pack + lane))
            hit &= free | -(2 << lane) if kind != TRIANGLES and other == pack else free
            if count + 2 * PACK > CANDIDATES:
                end, count = keep_close(near, corners, kind, end, room, count), 0
            if hit:
                count += add_candidates(near, near.kin, corners, kind, tree, others, pack + lane,
                                        other, hit, count, which)
    return keep_close(near, corners, kind, end, room, count)


@jit(inline=True)
def allowed(others, kind, pack, other, which):
    """
    Return bits of the items of another pack with which those of a pack may be in a pair.

    Of the pairs of a tree with itself that would be found twice, those with a later item count;
    within a pack, these are in addition to the bits returned.
    """
    if which == ALL:
        return EVERY if kind == TRIANGLES or other > pack else 0
    if which == RENEWED and (kind == TRIANGLES or other > pack):
        return EVERY
    return EVERY & ~others.marked[other // PACK]


@jit(inline=True)
def bounds_of(tree, pack):
    """Return the box around the items of a pack [m]."""
    if len(tree.begin) == 2:    # the only pack
        low, high = box_of(tree, pack)
        for k in range(pack + 1, pack + PACK):
            l, h = box_of(tree, k)
            low = min(low[0], l[0]), min(low[1], l[1]), min(low[2], l[2])
            high = max(high[0], h[0]), max(high[1], h[1]), max(high[2], h[2])
        return low, high
    return box_of(tree, tree.begin[1] + pack // PACK)


@jit(inline=True)
def add_candidates(near, kin, corners, kind, tree, others, c, other, hit, count, which):
    """
    Write the pairs of an item and the items of a pack that ``hit`` tells of behind a list.

    Pairs that are joined are left out. It may write to 2 PACK places.

    Returns
    -------
    number of pairs

    """
    mine, theirs, k, added = tree.corners, others.corners, room_in(corners) + count, 0
    if kin is None and kind != POINTS and other + PACK <= theirs.shape[1]:
        if kind == EDGES:
            return add_edges(corners, mine, theirs, c, other, hit, k)
        return add_triangles(corners, mine, theirs, c, other, hit, k, which)
    while hit:
        d = other + lowest_bit(hit)
        hit &= hit - 1
        added += add_candidate(near, corners, kind, tree, others, c, d, count + added, which)
    return added


@jit(inline=True)
def add_edges(corners, mine, theirs, c, other, hit, k):
    """Write the pairs of edge c and those of a pack, the earlier edge first, from place k on."""
    i, j = mine[0, c], mine[1, c]
    for row in range(2):
        hit &= ~(equal_bits(theirs[row], other, i) | equal_bits(theirs[row], other, j))
    earlier = hit & ((1 << min(max(c - other, 0), PACK)) - 1)
    if earlier:
        compress(theirs[0], other, earlier, corners[0], k)
        compress(theirs[1], other, earlier, corners[1], k)
        fill(corners[2], k, i)
        fill(corners[3], k, j)
    later = k + count_bits(earlier)
    if hit != earlier:
        fill(corners[0], later, i)
        fill(corners[1], later, j)
        compress(theirs[0], other, hit ^ earlier, corners[2], later)
        compress(theirs[1], other, hit ^ earlier, corners[3], later)
    return count_bits(hit)


@jit(inline=True)
def add_triangles(corners, mine, theirs, c, other, hit, k, which):
    """Write the pairs of triangle c and particles of a pack, or SWAPPED the converse."""
    i = mine[0, c]
    if which == SWAPPED:
        for row in range(3):
            hit &= ~equal_bits(theirs[row], other, i)
        fill(corners[0], k, i)
        for row in range(3):
            compress(theirs[row], other, hit, corners[1 + row], k)
    else:
        for row in range(3):
            hit &= ~equal_bits(theirs[0], other, mine[row, c])
            fill(corners[1 + row], k, mine[row, c])
        compress(theirs[0], other, hit, corners[0], k)
    return count_bits(hit)


@jit(inline=True)
def add_candidate(near, corners, kind, tree, others, c, d, count, which):
    """Write a pair of items behind a list; return True unless they are joined: it counts."""
    kin, dummy = near.kin, len(near.slot)
    k = room_in(corners) + count
    if kind == TRIANGLES:
        if which == SWAPPED:
            tree, others, c, d = others, tree, d, c
        i = others.corners[0, d]
        j, l, m = tree.corners[0, c], tree.corners[1, c], tree.corners[2, c]
        joined = are_welded(kin, i, j) | are_welded(kin, i, l) | are_welded(kin, i, m)
    elif kind == EDGES:
        c, d = min(c, d), max(c, d)
        i, j = tree.corners[0, c], tree.corners[1, c]
        l, m = others.corners[0, d], others.corners[1, d]
        joined = (are_welded(kin, i, l) | are_welded(kin, i, m) | are_welded(kin, j, l)
                  | are_welded(kin, j, m))
    else:
        i, j = tree.corners[0, c], others.corners[0, d]
        i, j, l, m = min(i, j), max(i, j), dummy, dummy
        joined = are_welded(kin, i, j)
    corners[0, k], corners[1, k], corners[2, k], corners[3, k] = i, j, l, m
    return not joined


@jit
def keep_close(near, corners, kind, end, room, count):
    """Append those of the candidates behind a list that are closer than their margins."""
    first = room_in(corners)
    for group in range(first, first + count, PACK):
        found = 0
        for q in range(group, group + PACK, lanes(near.start)):
            a, b, c, d = load_corners(near.start, corners, q)
            v, reach = closest(kind, a, b, c, d)[0], travel_of(kind, a, b, c, d)
            found |= bits(dot(v, v) < reach * reach) << (q - group)
        found &= (1 << min(PACK, first + count - group)) - 1
        if end + PACK <= room:    # it may write to PACK places
            for p in range(4):
                compress(corners[p], group, found, corners[p], end)
            end += count_bits(found)
        else:
            end = append(corners, group, found, end, room)
    return end


@jit
def append(corners, group, found, end, room):
    """Append those of PACK candidates that have a bit, as far as there is room; return the end."""
    while found:
        k = group + lowest_bit(found)
        found &= found - 1
        if end < room:
            for p in range(4):
                corners[p, end] = corners[p, k]
        end += 1
    return end
