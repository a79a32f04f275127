"""
Packs: the pairs of the neighbour list that may come close in the next substeps, ready for lanes.

A pack holds PACK pairs that share no particle. Pairs are put into the first open pack that has
none of their particles. The list is read at STREAMS places in turn, since neighbours in the list
share particles; pairs of particles in its order, with which an overlap comes apart more gently.

A pair is packed if it is closer than it has to keep plus what both sides are allowed to move. The
packs are complete while each particle's motion since its pairs were packed, plus its travel, is
less than it is allowed to. Where few particles exceed it, only the pairs of these are packed
again, in further packs. A search leaves the packs complete: particles are allowed to move only
where the list is complete (``stay_within_margin``), so pairs that are listed later are apart.
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
    has_marked,
    length,
    load_starts,
    POINTS,
    TRAVEL,
    UP,
)
from xpbd_ros.sim.self_collision.pair_contacts import load_corners, NEVER, OPEN

CLOTH = 3
"""last column of the records at rest"""
REST_SHARE = 0.5
"""largest distance to be kept, relative to a pair's distance at rest"""
STREAMS = 8
"""places of the neighbour list that are read in turn"""
AHEAD = 3.0
"""motion that is allowed, relative to the travel in one substep"""
FEW = 0.25
"""largest part of the particles whose pairs alone are packed again"""
SOON = 0.7
"""part of what is allowed beyond the travel, from which on a particle's pairs are packed again"""
MORE = 1.25
"""largest growth of the packs, relative to all when they were filled, before all are again"""
COMPLETE, INCOMPLETE = 1, 2
"""state of the packs; 0: to be filled"""
AT_REST = 0.125
"""motion that is allowed beyond the travel at rest, relative to the thickness"""


@jit
def complete_packs(near, pairs, thickness, slack):
    """Pack what particles in their present motion may touch; ``slack`` is the least travel [m]."""
    spare, count, leaves = AT_REST * thickness - (AHEAD - 1.0) * slack, 0, False
    if pairs.count[2] == COMPLETE:
        for i in range(len(near.slot)):
            stay_within_margin(near, pairs, i)
            left = pairs.allowed[i] - near.x[i, TRAVEL]
            moved = gone_since(near.x, pairs.seen, pairs.drift, i)
            leaves |= moved > left
            pairs.renewed[i] = moved > SOON * left
            count += pairs.renewed[i]
    if pairs.count[2] != COMPLETE or leaves and (
            count > FEW * len(near.slot) or pairs.end[0] > MORE * pairs.end[1]
            or not pack_some(near, pairs, thickness, spare)):
        fill_packs(near, pairs, thickness, slack)


@jit
def pack_some(near, pairs, thickness, spare):
    """Pack the pairs of renewed particles again; return False if there is no room."""
    start, origin, dummy = near.start, near.origin, len(near.slot)
    for i in range(len(near.slot)):
        if pairs.renewed[i]:
            allow(near, pairs, i, AHEAD, spare)
        for a in range(3):
            start[i, a] = pairs.seen[i, a] + pairs.drift[a] - origin[a]
        start[i, TRAVEL] = UP * pairs.allowed[i]
    for k in range(pairs.end[0]):
        if has_marked(pairs.renewed, pairs.particles, k):
            clear_place(pairs, k, dummy)
    lost = 0
    for kind in range(3):
        lost += fill_kind(near, pairs, kind, thickness, True)
    load_starts(near)
    return lost == 0


@jit(inline=True)
def allow(near, pairs, i, ahead, spare):
    """Allow a particle to move by ``ahead`` travel + spare from its present position."""
    pairs.allowed[i] = ahead * near.x[i, TRAVEL] + spare
    for a in range(3):
        pairs.seen[i, a] = near.x[i, a] - pairs.drift[a]
    stay_within_margin(near, pairs, i)


@jit(inline=True)
def stay_within_margin(near, pairs, i):
    """Bound the motion that is allowed to that for which the list is complete."""
    y, z, u, w = near.seen, pairs.seen, near.drift, pairs.drift
    apart = length((y[i, 0] + u[0] - z[i, 0] - w[0], y[i, 1] + u[1] - z[i, 1] - w[1],
                    y[i, 2] + u[2] - z[i, 2] - w[2]))
    pairs.allowed[i] = min(pairs.allowed[i], near.margin[i] - apart)


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
    pairs.drift[:] = 0.0
    for i in range(len(near.slot)):
        allow(near, pairs, i, ahead, spare)
        near.start[i, TRAVEL] = UP * pairs.allowed[i]
    pairs.end[0] = lost = 0
    for kind in range(3):
        lost += fill_kind(near, pairs, kind, thickness, False)
    pairs.end[1] = pairs.end[0]
    load_starts(near)
    return lost


@jit
def fill_kind(near, pairs, kind, thickness, some):
    """Pack the pairs of one kind, if ``some`` those of renewed particles; return how many lack."""
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
        close = (1 << min(PACK, last - begin)) - 1
        if some:
            close &= renewed_pairs(near, pairs, begin)
            if close == 0:
                continue
        close &= close_pairs(near, kind, begin, thickness)
        while close:
            k = begin + lowest_bit(close)
            close &= close - 1
            o = open_pack(near, pairs, k)
            if o < 0:
                o = turn
                turn = (turn + 1) % OPEN
                close_pack(near, pairs, o)
            if places[o] < 0:
                if pairs.end[0] + PACK > len(pairs.gap):
                    lost += 1
                    continue
                places[o] = pairs.end[0]
                pairs.kind[pairs.end[0] // PACK] = kind
                pairs.end[0] += PACK
            append(near, pairs, kind, k, o)
            if fill[o] == PACK:
                close_pack(near, pairs, o)
    for o in range(OPEN):
        close_pack(near, pairs, o)
    return lost


@jit(inline=True)
def renewed_pairs(near, pairs, begin):
    """Return bits of the PACK listed pairs from ``begin`` on that have a renewed particle."""
    found = 0
    for k in range(PACK):
        found |= int(has_marked(pairs.renewed, near.corners, begin + k)) << k
    return found


@jit(inline=True)
def close_pairs(near, kind, begin, thickness):
    """Return bits of the PACK pairs from ``begin`` on closer than they have to keep + may move."""
    found = 0
    for q in range(begin, begin + PACK, lanes(near.start)):
        a, b, c, d = load_corners(near.start, near.corners, q)
        v = closest(kind, a, b, c, d)[0]
        motion = travel_of(kind, a, b, c, d)
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
def clear_place(pairs, k, dummy):
    """Leave place k of the packs empty."""
    pairs.keep[k] = NEVER
    for p in range(4):
        pairs.particles[p, k] = dummy


@jit(inline=True)
def close_pack(near, pairs, o):
    """Fill up the open pack o with pairs of the dummy particle."""
    place, dummy = pairs.open[0, o], len(near.slot)
    if place >= 0:
        for k in range(place, place + pairs.open[1, o]):
            for p in range(4):
                pairs.busy[pairs.particles[p, k]] &= ~(1 << o)
        for k in range(place + pairs.open[1, o], place + PACK):
            clear_place(pairs, k, dummy)
        pairs.open[0, o] = -1
        pairs.open[1, o] = 0
