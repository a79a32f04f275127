"""
Near pairs: the listed pairs that may touch or pass through each other in a substep, in groups.

A pair is near if at the substep's start it is closer than it has to keep plus the travel of both
sides. A group holds PACK near pairs from places of the list that are far apart, since neighbours
in the list share particles. Pairs of a group that share a particle nevertheless are projected in
different rounds, so that the pairs of a round can be projected side by side, in the lanes of
vectors, and the result does not depend on the number of lanes.

The groups stay while they hold all near pairs. To that end they also hold pairs up to SPARE
further apart, and keep pairs of edges whose closest points come to include an end.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    any_lane,
    bits,
    both,
    either,
    lanes,
    larger,
    load,
    lowest_bit,
    root,
    select,
    smaller,
    store,
)
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import alone, share, wait_uneven
from xpbd_ros.sim.geometry.closest_points_simd import dot, on_edges, on_triangle
from xpbd_ros.sim.self_collision.neighbour_list import EDGES, POINTS, told, TRIANGLES
from xpbd_ros.sim.self_collision.pair_contacts import load_corners, NEVER

CLOTH = 3
"""last column of the records at rest"""
SPARE = 0.05
"""further distance of pairs in groups, relative to the thickness"""
REST_SHARE = 0.5
"""largest distance to be kept, relative to a pair's distance at rest"""


@jit
def choose_near(team, near, pairs, thickness):
    """Choose and group the near pairs; return the number of those beyond the capacity."""
    find_near(team, near, POINTS, thickness)
    find_near(team, near, TRIANGLES, thickness)
    find_near(team, near, EDGES, thickness)
    wait_uneven(team)
    lost = 0
    if alone(team) and near.regroup[0]:
        pairs.end[0] = 0
        pairs.touched[:] = 0
        for kind in range(3):
            lost += group_pairs(near, pairs, kind, collect(near, pairs, kind))
        pairs.count[1] += lost
        near.regroup[0] = lost > 0
    return told(team, near, lost)


@jit(inline=True)
def find_near(team, near, kind, thickness):
    """
    Set ``hits`` for this thread's part of a kind's pairs: what groups made now would hold.

    Set ``regroup`` if a near pair is in no group.
    """
    end, missing = near.kind_front[kind], 0
    first, last = part_of(team, near.kind_begin[kind], end)
    for pack in range(first, last, PACK):
        found = wider = with_ends = 0
        for q in range(pack, pack + PACK, lanes(near.start)):
            a, b, c = hits_of(near, kind, q, thickness)
            found |= a << (q - pack)
            wider |= b << (q - pack)
            with_ends |= c << (q - pack)
        listed, grouped = (1 << min(PACK, end - pack)) - 1, near.grouped[pack // PACK]
        near.hits[pack // PACK] = (wider | with_ends & grouped) & listed
        missing |= found & listed & ~grouped
    if missing:
        near.regroup[0] = True


@jit(inline=True)
def part_of(team, begin, end):
    """Return the begin and the end of this thread's part of some pairs, whole packs."""
    first, last = share(team, (end - begin + PACK - 1) // PACK)
    return begin + PACK * first, begin + PACK * last


@jit(inline=True)
def hits_of(near, kind, q, thickness):
    """
    Return bits of the near pairs of a vector of listed pairs, and of those within SPARE more.

    Returns
    -------
    near pairs; those within SPARE more; the latter with edges whose closest points include an end

    """
    spare = SPARE * thickness
    close, square, reach, travel, weight = within(near, kind, q, thickness, spare)
    with_ends = bits(close)
    if with_ends == 0:
        return 0, 0, 0
    reach -= spare
    if kind == EDGES:    # others only where they may pass through each other
        close = both(close, either(is_inside(kind, weight), square <= travel * travel))
    return bits(both(close, square <= reach * reach)), bits(close), with_ends


@jit(inline=True)
def within(near, kind, q, thickness, spare):
    """
    Return which of a vector of listed pairs are closer than they have to keep + travel + spare.

    Returns
    -------
    mask; squares of their distances [m²], those sums and travels [m], weights of closest points

    """
    a, b, c, d = load_corners(near.start, near.corners, q)
    v, weight = closest(kind, a, b, c, d)
    square, travel = dot(v, v), travel_of(kind, a, b, c, d)
    reach = (thickness + spare) + travel
    close = square <= reach * reach
    if any_lane(close):
        reach = (kept_distance(near, kind, q, thickness) + spare) + travel
        close = both(close, square <= reach * reach)
    return close, square, reach, travel, weight


@jit
def collect(near, pairs, kind):
    """Copy a kind's near pairs to ``found`` and ``found_keep``; return their number."""
    found, keep, count, room = pairs.found, pairs.found_keep, 0, len(pairs.found_keep)
    for pack in range(near.kind_begin[kind], near.kind_front[kind], PACK):
        hit = near.hits[pack // PACK]
        near.grouped[pack // PACK] = hit
        while hit:
            k = pack + lowest_bit(hit)
            hit &= hit - 1
            if count < room:
                for p in range(4):
                    found[count, p] = near.corners[p, k]
                keep[count] = near.keep[k]
            count += 1
    return count


@jit
def group_pairs(near, pairs, kind, found):
    """
    Put the pairs in ``pairs.found`` into groups, each with pairs from PACK parts of it.

    Returns
    -------
    number of pairs beyond the capacity

    """
    count = max(0, min(found, len(pairs.push) - PACK - pairs.end[0]))
    groups = (count + PACK - 1) // PACK
    for g in range(groups):
        first, rounds = pairs.end[0], 1
        pairs.end[0] += PACK
        for lane in range(PACK):
            m = g + lane * groups
            if m < count:
                rounds = max(rounds, put_pair(near, pairs, kind, m, first, lane))
            else:
                clear_place(pairs, first + lane, len(near.slot))
        pairs.kind[first // PACK], pairs.rounds[first // PACK] = kind, rounds
    return found - count


@jit(inline=True)
def put_pair(near, pairs, kind, m, first, lane):
    """Copy pair m of those found to a lane of a group; return the number of its round, from 1."""
    place, touched, turn = first + lane, pairs.touched, 0
    found, particles, dummy = pairs.found, pairs.particles, len(near.slot)
    for p in range(4):
        i = found[m, p]
        particles[p, place] = i
        if i < dummy:
            turn = max(turn, touched[i] - PACK * first)    # less than 0 in earlier groups
    for p in range(4):
        touched[found[m, p]] = PACK * first + turn + 1
    pairs.turn[place] = turn
    pairs.keep[place] = pairs.found_keep[m]
    set_friction(pairs.friction, place, near.cloth[found[m, 0]],
                 near.cloth[found[m, 1 if kind == POINTS else 3]])
    return turn + 1


@jit(inline=True)
def set_friction(friction, place, one, other):
    """Copy the coefficients of friction of a pair of cloths."""
    if friction is not None:
        friction.slides[place] = friction.kinetic[one, other]
        friction.sticks[place] = friction.static[one, other]


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
