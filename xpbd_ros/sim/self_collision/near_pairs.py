"""
Near pairs: the listed pairs that may touch or pass through each other in a substep, in groups.

A pair is near if at the substep's start it is closer than it has to keep plus the travel of both
sides. A group holds PACK near pairs from places of the list that are far apart, since neighbours
in the list share particles. Pairs of a group that share a particle nevertheless are projected in
different rounds, so that the pairs of a round can be projected side by side, in the lanes of
vectors, and the result does not depend on the number of lanes.

The groups stay while they hold all near pairs. To that end they also hold pairs up to SPARE
further apart, and keep pairs of edges whose closest points come to include an end. Other pairs are
not read until a particle's travel and motion since exceed its margin, its travel then + SPARE / 2;
so pairs of edges whose closest points come to be inside may join that much later.
"""

import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import (
    any_lane,
    bits,
    both,
    count_bits,
    either,
    lanes,
    larger,
    load,
    lowest_bit,
    root,
    select,
    smaller,
    splat,
    store,
)
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import (
    alone,
    is_on_device,
    share,
    turns,
    wait_uneven,
    worker,
)
from xpbd_ros.sim.geometry.closest_points_simd import dot, on_edges, on_triangle
from xpbd_ros.sim.self_collision.list_order import prefix_sum
from xpbd_ros.sim.self_collision.neighbour_list import (
    any_thread,
    EDGES,
    gone_since,
    POINTS,
    rounding_of,
    TRAVEL,
    TRIANGLES,
)
from xpbd_ros.sim.self_collision.pair_contacts import load_corners, NEVER

CLOTH = 3
"""last column of the records at rest"""
FRONT = 2.0
"""travels within which pairs are in front, and inner margin of a particle in travels"""
SPARE = 0.15
"""further distance of pairs in groups, relative to the thickness"""
REST_SHARE = 0.5
"""largest distance to be kept, relative to a pair's distance at rest"""


@jit
def choose_near(team, near, pairs, thickness, found):
    """
    Choose and group the near pairs; return the number of those beyond the capacity.

    ``found`` is True if a pruning has just set ``hits`` to these.
    """
    missing = found or near.regroup[0]
    if not (missing or has_left_margins(team, near, pairs.seen, pairs.margin)):
        return 0
    if not found:
        missing |= find_near(team, near, POINTS, thickness)
        missing |= find_near(team, near, TRIANGLES, thickness)
        missing |= find_near(team, near, EDGES, thickness)
    set_margins(team, near, pairs, 0.5 * SPARE * thickness)
    if any_thread(team, near, missing):
        return regroup(team, near, pairs)
    return 0


@jit
def has_left_margins(team, near, seen, margin):
    """Return True if a particle's travel and motion since it was seen exceed its margin."""
    found = False
    first, end, step = turns(team, len(near.slot))
    for i in range(first, end, step):
        if near.x[i, TRAVEL] + gone_since(near.x, seen, near.drift, i) > margin[i]:
            found = True
            break
    return any_thread(team, near, found)


@jit
def set_margins(team, near, pairs, spare):
    """Set the margins of the groups, from the positions at the substep's start on."""
    rounding = rounding_of(near)
    first, end, step = turns(team, len(near.slot))
    for i in range(first, end, step):
        pairs.margin[i] = near.x[i, TRAVEL] + spare - rounding
        for a in range(3):
            pairs.seen[i, a] = near.x[i, a] - near.drift[a]


@jit(inline=True)
def find_near(team, near, kind, thickness):
    """
    Set ``hits`` for this thread's part of a kind's pairs: what groups made now would hold.

    Return True if one of these pairs is in no group.
    """
    end, missing = near.kind_front[kind], 0
    first, last, step = packs_of(team, near.kind_begin[kind], end)
    for pack in range(first, last, step):
        found = with_ends = 0
        for q in range(pack, pack + PACK, lanes(near.start)):
            a, b = hits_of(near, kind, q, thickness)
            found |= a << (q - pack)
            with_ends |= b << (q - pack)
        listed, grouped = (1 << min(PACK, end - pack)) - 1, near.grouped[pack // PACK]
        near.hits[pack // PACK] = (found | with_ends & grouped) & listed
        missing |= found & listed & ~grouped
    return missing != 0


@jit(inline=True)
def find_front(team, near, kind, thickness):
    """
    Mark this thread's part of a kind's pairs closer than they have to keep + FRONT travels.

    ``hits`` is set to those of them that groups made now would hold.
    """
    end, spare = near.kind_end[kind], SPARE * thickness
    first, last, step = packs_of(team, near.kind_begin[kind], end)
    for pack in range(first, last, step):
        front = found = 0
        for q in range(pack, pack + PACK, lanes(near.start)):
            close, square, keep, travel, weight = within(near, kind, q, thickness, FRONT, 0.0)
            if any_lane(close):
                reach = (keep + spare) + travel
                front |= bits(close) << (q - pack)
                close = both(close, square <= reach * reach)
                found |= bits(may_touch(kind, close, square, travel + spare, weight)) << (q - pack)
        listed = (1 << min(PACK, end - pack)) - 1
        near.marks[pack // PACK], near.hits[pack // PACK] = front & listed, found & listed


@jit(inline=True)
def packs_of(team, begin, end):
    """Return the first of this thread's packs of some pairs, their end, and the stride."""
    first, last, step = turns(team, (end - begin + PACK - 1) // PACK)
    return begin + PACK * first, begin + PACK * last, PACK * step


@jit(inline=True)
def hits_of(near, kind, q, thickness):
    """
    Return bits of a vector of listed pairs: those for groups made now, and these with all pairs of
    edges.
    """
    spare = SPARE * thickness
    close, square, _, travel, weight = within(near, kind, q, thickness, 1.0, spare)
    with_ends = bits(close)
    if with_ends == 0:
        return 0, 0
    return bits(may_touch(kind, close, square, travel + spare, weight)), with_ends


@jit(inline=True)
def may_touch(kind, close, square, travel, weight):
    """Return which close pairs may touch: of edges, those inside or with room to pass through."""
    if kind == EDGES:
        return both(close, either(is_inside(kind, weight), square <= travel * travel))
    return close


@jit(inline=True)
def within(near, kind, q, thickness, travels, spare):
    """
    Return which of a vector of listed pairs are closer than they have to keep + travels + spare.

    Returns
    -------
    mask; squares of their distances [m²], distances to be kept [m] if one is so close, the two
    sides' travels [m], weights of the closest points

    """
    a, b, c, d = load_corners(near.start, near.corners, q)
    v, weight = closest(kind, a, b, c, d)
    square, travel = dot(v, v), travel_of(kind, a, b, c, d)
    further = travels * travel + spare
    keep = splat(near.start, thickness)
    reach = keep + further
    close = square <= reach * reach
    if any_lane(close):
        keep = kept_distance(near, kind, q, thickness)
        reach = keep + further
        close = both(close, square <= reach * reach)
    return close, square, keep, travel, weight


@jit
def regroup(team, near, pairs):
    """Group the pairs that ``hits`` tells of; return the number of those beyond the capacity."""
    end, lost = 0, 0
    forget_touched(team, pairs)
    for kind in range(3):
        found = collect(team, near, pairs, kind, end)
        count = max(0, min(found, len(pairs.push) - PACK - end))
        group_pairs(team, near, pairs, kind, end, count)
        end += (count + PACK - 1) // PACK * PACK
        lost += found - count
    wait_uneven(team)
    if alone(team):
        pairs.end[0] = end
        pairs.count[1] += lost
        near.regroup[0] = lost > 0
    wait_uneven(team)
    return lost


@jit
def forget_touched(team, pairs):
    """Zero this thread's row of ``touched``, which a GPU has not."""
    if worker(team) < len(pairs.touched):
        pairs.touched[worker(team)][:] = 0


@jit
def collect(team, near, pairs, kind, end):
    """
    Copy a kind's near pairs to ``found`` and ``found_keep``, from ``end`` on.

    Returns
    -------
    their number, those beyond the capacity included

    """
    begin, count = near.kind_begin[kind], 0
    first, last = share(team, (near.kind_front[kind] - begin + PACK - 1) // PACK)
    for pack in range(begin // PACK + first, begin // PACK + last):
        count += count_bits(np.int64(near.hits[pack]))
    before, total = prefix_sum(team, near, count)
    copy_found(near, pairs, begin + PACK * first, begin + PACK * last, end + before)
    wait_uneven(team)
    return total


@jit(inline=True)
def copy_found(near, pairs, first, last, place):
    """Copy the near pairs from ``first`` to ``last`` in the list, from a place on."""
    found, keep, room = pairs.found, pairs.found_keep, len(pairs.found_keep)
    for pack in range(first, last, PACK):
        hit = near.hits[pack // PACK]
        near.grouped[pack // PACK] = hit
        while hit:
            k = pack + lowest_bit(hit)
            hit &= hit - 1
            if place < room:
                for p in range(4):
                    found[place, p] = near.corners[p, k]
                keep[place] = near.keep[k]
            place += 1


@jit
def group_pairs(team, near, pairs, kind, end, count):
    """Put ``count`` of those found, from ``end`` on, into groups: each has pairs of PACK parts."""
    groups = (count + PACK - 1) // PACK
    first, last, step = turns(team, groups)
    for g in range(first, last, step):
        place, rounds = end + PACK * g, 1
        for lane in range(PACK):
            m = g + lane * groups
            if m < count:
                rounds = max(rounds, put_pair(team, near, pairs, kind, end + m, place, lane))
            else:
                clear_place(pairs, place + lane, len(near.slot))
        pairs.kind[place // PACK], pairs.rounds[place // PACK] = kind, rounds


@jit(inline=True)
def put_pair(team, near, pairs, kind, m, first, lane):
    """Copy pair m of those found to a lane of a group; return the number of its round, from 1."""
    place, found, particles = first + lane, pairs.found, pairs.particles
    for p in range(4):
        particles[p, place] = found[m, p]
    turn = turn_of(team, pairs, place, first, len(near.slot))
    pairs.turn[place] = turn
    pairs.keep[place] = pairs.found_keep[m]
    set_friction(pairs.friction, place, near.cloth, found[m, 0],
                 found[m, 1 if kind == POINTS else 3])
    return turn + 1


def turn_of(team, pairs, place, first, dummy):
    """
    Return the round of the pair at a place, from 0.

    It follows those of the earlier pairs of its group, from ``first`` on, that share a particle.
    """


@inline(turn_of)
def _turn_of(team, pairs, place, first, dummy):
    if is_on_device(team):    # memory for all particles by thread would be too much
        return lambda team, pairs, place, first, dummy: turn_by_comparison(pairs, place, first,
                                                                           dummy)
    return lambda team, pairs, place, first, dummy: turn_by_marks(
        pairs.touched[worker(team)], pairs.particles, place, first, dummy)


@jit(inline=True)
def turn_by_marks(touched, particles, place, first, dummy):
    """Return it by ``touched``, and mark the pair's particles there."""
    turn = 0
    for p in range(4):
        i = particles[p, place]
        if i < dummy:
            turn = max(turn, touched[i] - first)    # not more than 0 in earlier groups
    for p in range(4):
        touched[particles[p, place]] = first + turn + 1
    return turn


@jit(inline=True)
def turn_by_comparison(pairs, place, first, dummy):
    """Return it by comparing each particle with those of the earlier pairs."""
    turn, particles = 0, pairs.particles
    for k in range(first, place):
        for p in range(4):
            i = particles[p, k]
            if i < dummy and (i == particles[0, place] or i == particles[1, place]
                              or i == particles[2, place] or i == particles[3, place]):
                turn = max(turn, int(pairs.turn[k]) + 1)
    return turn


@jit(inline=True)
def set_friction(friction, place, cloth, i, j):
    """Copy μ of the cloths of particles i and j, and reset the creep."""
    if friction is not None:
        one, other = (cloth[i], cloth[j]) if len(friction.kinetic) > 1 else (0, 0)
        friction.slides[place] = friction.kinetic[one, other]
        for a in range(3):
            friction.creep[a, place] = 0.0


@jit(inline=True)
def clear_place(pairs, k, dummy):
    """Leave place k of the groups empty."""
    pairs.keep[k] = NEVER
    pairs.turn[k] = 0
    for p in range(4):
        pairs.particles[p, k] = dummy


@jit(inline=True)
def kept_distance(near, kind, q, thickness):
    """
    Return the distances that a vector of listed pairs have to keep [m], computed once.

    That is the thickness, and within a cloth at most REST_SHARE of the pair's distance at rest.
    """
    keep = load(near.keep, q)
    if any_lane(keep < 0.0):
        a, b, c, d = load_corners(near.rest, near.corners, q)
        v, one, other = closest(kind, a, b, c, d)[0], a[CLOTH], d[CLOTH]
        if kind == POINTS:
            other = b[CLOTH]
        keep = select(either(one < other, one > other), thickness,
                      smaller(REST_SHARE * root(dot(v, v)), thickness))
        store(near.keep, q, keep)
    return keep


@jit(inline=True)
def travel_of(kind, a, b, c, d):
    """Return the largest approach of the two sides of pairs in this substep [m]."""
    if kind == EDGES:
        return larger(a[3], b[3]) + larger(c[3], d[3])
    return a[3] + larger(b[3], larger(c[3], d[3]))


@jit(inline=True)
def closest(kind, a, b, c, d):
    """Return the vectors between the closest points of pairs [m], and their weights b."""
    one = a[3] - a[3] + 1.0
    if kind == EDGES:
        s, t, v = on_edges(a, b, c, d)
        return v, (one - s, s, t - 1.0, -t)
    if kind == POINTS:
        return (a[0] - b[0], a[1] - b[1], a[2] - b[2]), (one, -one, one - one, one - one)
    s, t, v = on_triangle(a, b, c, d)
    return v, (one, s + t - 1.0, -s, -t)


@jit(inline=True)
def is_inside(kind, b):
    """
    Return True unless the closest points of two edges include an end point.

    Pairs of a particle and a triangle cover those.
    """
    inside = both(both(b[0] > 0.0, b[1] > 0.0), both(b[2] < 0.0, b[3] < 0.0))
    if kind == EDGES:
        return inside
    return either(inside, b[0] > -1.0)
