"""
Search for the pairs of the neighbour list, over trees of bounding boxes (``geometry.box_tree``).

It happens when a particle's motion since the search for its pairs exceeds its margin. While these
are few, only pairs of such particles are sought; the list is then that of a search for all pairs
with the same y and margins, in another order. Boxes are compared by lanes, and so are the closest
points of the candidates (``self_collision.pair_listing``).
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lanes
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import alone, assigned, turns, wait_uneven
from xpbd_ros.sim.geometry.box_tree import mark_items, update_boxes
from xpbd_ros.sim.self_collision.list_order import bring_new_forward, drop_renewed
from xpbd_ros.sim.self_collision.near_pairs import kept_distance
from xpbd_ros.sim.self_collision.neighbour_list import (
    EDGES,
    empty_groups,
    gone_since,
    POINTS,
    room_of,
    rounding_of,
    sum_of,
    told,
    TRAVEL,
    TRIANGLES,
    UP,
)
from xpbd_ros.sim.self_collision.pair_listing import ALL, list_pairs_of, RENEWED, SWAPPED

FEW = 0.25
"""largest part of the particles whose pairs alone are sought"""
SOON = 0.5
"""part of the margin beyond the travel from which on a particle is about to leave it"""
MORE = 0.25
"""room for further pairs of particle and triangle, relative to their number in a full search"""
HALVINGS = 8
"""most halvings of margins that yield more pairs than the capacity"""
WORD = 4
"""flags in a word of memory"""
MARGIN = TRAVEL
"""
column of ``NeighbourList.start`` that holds the margins during a search, each with half of the
thickness and of the rounding errors
"""


@jit
def seek(team, near, thickness, left):
    """
    Seek pairs, with margins for ``left`` substeps of each particle's present motion.

    Where few particles are about to leave their margins, only the pairs of these are sought.
    """
    if alone(team):
        near.count[0] += 1
    some = near.complete[0] and renew_some(team, near, left)
    if not some or not seek_some(team, near, near.surface, thickness):
        seek_all(team, near, thickness, left)
    empty_groups(team, near)
    wait_uneven(team)


@jit(inline=True)
def set_margin(near, i, left):
    """Set a particle's margin, from its present position on."""
    travel = near.x[i, TRAVEL]
    near.margin[i] = near.inner[i] = min(left * travel, max(2.0 * travel, near.reach))
    for a in range(3):
        near.seen[i, a] = near.pruned[i, a] = near.x[i, a] - near.drift[a]


@jit
def renew_some(team, near, left):
    """Renew particles about to leave their margins; return False and do nothing if too many."""
    count, renewed, particles = 0, near.renewed, len(near.slot)
    first, end, step = turns(team, (particles + WORD - 1) // WORD)
    for word in range(first, end, step):    # each has the flags of one thread
        for i in range(WORD * word, min(WORD * (word + 1), particles)):
            travel, moved = near.x[i, TRAVEL], gone_since(near.x, near.seen, near.drift, i)
            renewed[i] = moved > SOON * (near.margin[i] - travel)
            count += renewed[i]
    if sum_of(team, near, count) > FEW * particles:
        return False
    first, end, step = turns(team, particles)
    for i in range(first, end, step):
        if renewed[i]:
            set_margin(near, i, left)
    return True


@jit
def seek_some(team, near, surface, thickness):
    """Seek the pairs of the renewed particles; return False if there is no room for all."""
    begin_search(team, near, surface, thickness)
    drop_all_renewed(team, near, surface)
    if surface is None:
        points, end = near.points, near.plan[POINTS]
        end = list_pairs_of(team, near, POINTS, points, points, end, RENEWED, True)
        lost = end_points(team, near, near.plan[POINTS], end, thickness)
        bring_new_forward(team, near, POINTS)
        return lost == 0
    else:    # Numba prunes the branch that is not taken
        triangles, edges, points = surface.triangles, surface.edges, near.points
        end = near.plan[TRIANGLES]
        end = list_pairs_of(team, near, TRIANGLES, triangles, points, end, RENEWED, True)
        end = list_pairs_of(team, near, TRIANGLES, points, triangles, end, SWAPPED, True)
        lost = end_kind(team, near, TRIANGLES, end)
        end = near.plan[EDGES]
        end = list_pairs_of(team, near, EDGES, edges, edges, end, RENEWED, True)
        lost += end_kind(team, near, EDGES, end)
        bring_new_forward(team, near, TRIANGLES)
        bring_new_forward(team, near, EDGES)
        return lost == 0


@jit
def drop_all_renewed(team, near, surface):
    """Drop the pairs of renewed particles, plan where the others end, and mark renewed items."""
    if assigned(team, 0):
        mark_items(team, near.points, near.renewed)
    if surface is None:
        if assigned(team, 0):
            drop_renewed(team, near, POINTS)
    else:    # Numba prunes the branch that is not taken
        if assigned(team, 0):
            drop_renewed(team, near, TRIANGLES)
            mark_items(team, surface.triangles, near.renewed)
        if assigned(team, -1):
            drop_renewed(team, near, EDGES)
            mark_items(team, surface.edges, near.renewed)
    wait_uneven(team)


@jit
def seek_all(team, near, thickness, left):
    """Seek all pairs."""
    if alone(team):
        near.count[4] += 1
        near.drift[:] = 0.0
        for a in range(3):
            near.origin[a] = near.x[0, a]
    wait_uneven(team)
    first, last, step = turns(team, len(near.slot))
    for i in range(first, last, step):
        set_margin(near, i, left)
    lost = 0
    for halvings in range(HALVINGS + 1):
        if halvings > 0:
            for i in range(first, last, step):
                near.margin[i] *= 0.5
                near.inner[i] = near.margin[i]
        lost = list_pairs(team, near, near.surface, thickness, halvings == HALVINGS)
        if lost == 0:
            break
    if alone(team):
        near.count[1] += lost
        near.unpruned[0] = 0
        for kind in range(3):
            near.kind_front[kind] = near.kind_end[kind]
            near.unpruned[0] += near.kind_end[kind] - near.kind_begin[kind]
        near.complete[0] = lost == 0
    for i in range(first, last, step):
        near.x[i, TRAVEL] = min(near.x[i, TRAVEL], near.margin[i])


@jit
def list_pairs(team, near, surface, thickness, to_the_end):
    """
    List the pairs closer than thickness + margins; return the number beyond the capacity.

    Unless ``to_the_end``, the search ends soon after the first pair beyond the capacity.
    """
    begin_search(team, near, surface, thickness)
    if surface is None:
        points, first = near.points, begin_kind(team, near, POINTS, 0)
        end = list_pairs_of(team, near, POINTS, points, points, first, ALL, to_the_end)
        return end_points(team, near, first, end, thickness)
    else:    # Numba prunes the branch that is not taken
        triangles, edges, points = surface.triangles, surface.edges, near.points
        end = begin_kind(team, near, TRIANGLES, 0)
        end = list_pairs_of(team, near, TRIANGLES, triangles, points, end, ALL, to_the_end)
        lost = end_kind(team, near, TRIANGLES, end)
        end = begin_kind(team, near, EDGES, end + int(MORE * end))
        end = list_pairs_of(team, near, EDGES, edges, edges, end, ALL, to_the_end)
        return lost + end_kind(team, near, EDGES, end)


@jit
def begin_search(team, near, surface, thickness):
    """Load y and the margins, and compute the boxes."""
    start, y = near.start, near.seen
    wait_uneven(team)
    first, end, step = turns(team, len(near.slot))
    for i in range(first, end, step):
        for a in range(3):
            start[i, a] = y[i, a] + near.drift[a] - near.origin[a]
    wait_uneven(team)
    half = 0.5 * (thickness + rounding_of(near))
    for i in range(first, end, step):
        start[i, MARGIN] = UP * (near.margin[i] + half)
    wait_uneven(team)
    if assigned(team, 0):
        update_boxes(team, near.points, start)
    if surface is not None:    # Numba prunes the branch that is not taken
        if assigned(team, 0):
            update_boxes(team, surface.triangles, start)
        if assigned(team, -1):
            update_boxes(team, surface.edges, start)
    wait_uneven(team)


@jit
def drop_far(near, first, end, thickness):
    """Drop pairs further apart than they have to keep + margins from ``first`` on."""
    corners, x, left = near.corners, near.start, first
    for q in range(first // PACK * PACK, min(end, room_of(near)), lanes(x)):
        kept_distance(near, POINTS, q, thickness)
    for k in range(first, min(end, room_of(near))):
        i, j, square = corners[0, k], corners[1, k], 0.0
        for a in range(3):
            square += (x[i, a] - x[j, a])**2
        if square < (near.keep[k] - thickness + x[i, MARGIN] + x[j, MARGIN])**2:
            corners[0, left], corners[1, left], near.keep[left] = i, j, near.keep[k]
            left += 1
    return left + max(0, end - room_of(near))


@jit
def end_points(team, near, first, end, thickness):
    """Do what ``end_kind`` does for pairs of particles, without those that are too far apart."""
    if alone(team):
        end = drop_far(near, first, end, thickness)
    return end_kind(team, near, POINTS, told(team, near, end))


@jit
def begin_kind(team, near, kind, end):
    """Begin the pairs of a kind, and end those before, at a multiple of PACK; return it."""
    begin = min((end + PACK - 1) // PACK * PACK, room_of(near))
    if alone(team):
        near.kind_room[kind] = room_of(near)
        near.kind_begin[kind] = near.kind_end[kind] = begin
        if kind == EDGES:
            near.kind_room[TRIANGLES] = begin
    wait_uneven(team)
    return begin


@jit
def end_kind(team, near, kind, end):
    """End the pairs of a kind, fill up the last pack; return the number beyond the capacity."""
    room, dummy = near.kind_room[kind], len(near.slot)
    if alone(team):
        near.kind_end[kind] = min(end, room)
        for c in range(min(end, room), min((end + PACK - 1) // PACK * PACK, room)):
            for p in range(4):
                near.corners[p, c] = dummy
    wait_uneven(team)
    return max(0, end - room)
