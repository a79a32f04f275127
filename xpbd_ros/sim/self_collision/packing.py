"""
Packs: the pairs of the neighbour list that may come close in the next substeps, ready for lanes.

A pack holds PACK pairs that share no particle. Pairs are put into the first open pack that has
none of their particles. The list is read at STREAMS places in turn, since neighbours in the list
share particles; pairs of particles in its order, with which an overlap comes apart more gently.

A pair is packed if it is closer than it has to keep plus what both sides are allowed to move. The
packs are complete while each particle's motion since they were filled, plus its travel, is less
than it is allowed to.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    any_lane,
    bits,
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
from xpbd_ros.sim.geometry.closest_points_simd import dot, on_edges, on_triangle
from xpbd_ros.sim.self_collision.neighbour_list import (
    EDGES,
    gone_since,
    POINTS,
    TRAVEL,
)
from xpbd_ros.sim.self_collision.pair_contacts import load_corners, OPEN

CLOTH = 3
"""last column of the records at rest"""
REST_SHARE = 0.5
"""largest distance to be kept, relative to a pair's distance at rest"""
STREAMS = 8
"""places of the neighbour list that are read in turn"""
AHEAD = 4.0
"""motion that is allowed, relative to the travel in one substep"""
COMPLETE, INCOMPLETE = 1, 2
"""state of the packs; 0: to be filled"""
AT_REST = 0.0625
"""motion that is allowed beyond the travel at rest, relative to the thickness"""


@jit
def are_packs_complete(pairs, near):
    """Return True if no particle may leave the range for which the packs were filled."""
    if pairs.count[2] != COMPLETE:
        return False
    for i in range(len(near.slot)):
        if (gone_since(near.x, pairs.seen, pairs.drift, i) + near.x[i, TRAVEL]
                > pairs.allowed[i]):
            return False
    return True


@jit
def fill_packs(near, pairs, thickness, slack):
    """
    Fill the packs from the neighbour list; ``slack`` is the least travel [m].

    Where the capacity does not allow all pairs of the next substeps, only those of this one.
    """
    lost = fill_for(near, pairs, thickness, AHEAD, AT_REST * thickness - (AHEAD - 1.0) * slack)
    if lost > 0:
        lost = fill_for(near, pairs, thickness, 1.0, 0.0)
    pairs.count[1] += lost
    pairs.count[2] = COMPLETE if lost == 0 else INCOMPLETE


@jit
def fill_for(near, pairs, thickness, ahead, spare):
    """Fill the packs for a motion of ``ahead`` travel + spare; return the number of pairs lost."""
    for i in range(len(near.slot)):
        pairs.allowed[i] = ahead * near.x[i, TRAVEL] + spare
        for a in range(3):
            pairs.seen[i, a] = near.x[i, a]
    pairs.drift[:] = 0.0
    end, all_lost = 0, 0
    for kind in range(3):
        end, lost = fill_kind(near, pairs, kind, thickness, ahead, spare, end)
        pairs.end[kind] = end
        all_lost += lost
    return all_lost


@jit
def fill_kind(near, pairs, kind, thickness, ahead, spare, end):
    """Pack the pairs of one kind from ``end`` on; return their end, and the number lost."""
    first, last = near.kind_begin[kind], near.kind_end[kind]
    places, fill = pairs.open[0], pairs.open[1]
    places[:] = -1
    fill[:] = 0
    turn, lost, chunks = 0, 0, (last - first + PACK - 1) // PACK
    streams = 1 if kind == POINTS else STREAMS
    rows = (chunks + streams - 1) // streams
    for chunk in range(rows * streams):
        begin = first + ((chunk % streams) * rows + chunk // streams) * PACK
        if begin >= last:
            continue
        close = close_pairs(near, kind, begin, thickness, ahead, spare)
        close &= (1 << min(PACK, last - begin)) - 1
        while close:
            k = begin + lowest_bit(close)
            close &= close - 1
            o = open_pack(near, pairs, k)
            if o < 0:
                o = turn
                turn = (turn + 1) % OPEN
                close_pack(near, pairs, o)
            if places[o] < 0:
                if end + PACK > len(pairs.gap):
                    lost += 1
                    continue
                places[o] = end
                end += PACK
            append(near, pairs, kind, k, o)
            if fill[o] == PACK:
                close_pack(near, pairs, o)
    for o in range(OPEN):
        close_pack(near, pairs, o)
    return end, lost


@jit(inline=True)
def close_pairs(near, kind, begin, thickness, ahead, spare):
    """
    Return bits of the PACK pairs from ``begin`` on closer than they have to keep + their motion.

    The motion is ``ahead`` travel + spare on each side.
    """
    found = 0
    for q in range(begin, begin + PACK, lanes(near.start)):
        a, b, c, d = load_corners(near.start, near.corners, q)
        v = closest(kind, a, b, c, d)[0]
        motion = 2.0 * spare + ahead * travel_of(kind, a, b, c, d)
        reach = thickness + motion
        close = bits(dot(v, v) < reach * reach)
        if close:
            reach = kept_distance(near, kind, q, thickness) + motion
            found |= bits(dot(v, v) < reach * reach) << (q - begin)
    return found


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


@jit
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
def open_pack(near, pairs, k):
    """Return the first open pack without the particles of pair k, or -1."""
    taken, busy = 0, pairs.busy
    for p in range(4):
        taken |= busy[near.corners[p, k]]
    free = ~taken & ((1 << OPEN) - 1)
    return lowest_bit(free) if free else -1


@jit(inline=True)
def append(near, pairs, kind, k, o):
    """Append pair k of the neighbour list to the open pack o."""
    dummy = len(near.slot)
    place = pairs.open[0, o] + pairs.open[1, o]
    pairs.open[1, o] += 1
    pairs.keep[place] = near.keep[k]
    set_friction(pairs.friction, place, near.cloth[near.corners[0, k]],
                 near.cloth[near.corners[1 if kind == POINTS else 3, k]])
    for p in range(4):
        i = near.corners[p, k]
        pairs.particles[p, place] = i
        if i != dummy:
            pairs.busy[i] |= 1 << o


@jit(inline=True)
def set_friction(friction, place, one, other):
    """Copy the coefficients of friction of a pair of cloths."""
    if friction is not None:
        friction.slides[place] = friction.kinetic[one, other]
        friction.sticks[place] = friction.static[one, other]


@jit(inline=True)
def close_pack(near, pairs, o):
    """Fill up the open pack o with pairs of the dummy particle."""
    place, dummy = pairs.open[0, o], len(near.slot)
    if place >= 0:
        for k in range(place, place + pairs.open[1, o]):
            for p in range(4):
                pairs.busy[pairs.particles[p, k]] &= ~(1 << o)
        for k in range(place + pairs.open[1, o], place + PACK):
            pairs.keep[k] = 0.0
            for p in range(4):
                pairs.particles[p, k] = dummy
        pairs.open[0, o] = -1
        pairs.open[1, o] = 0
