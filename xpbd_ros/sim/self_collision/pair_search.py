"""
Search for the pairs of the neighbour list, over spatial hashes of particles and of edges.

It happens when the motion since the last search exceeds the list's margin.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.geometry.closest_points import minus
from xpbd_ros.sim.self_collision.neighbour_list import (
    are_welded,
    at,
    closest_vector,
    EDGES,
    length,
    POINTS,
    TRAVEL,
    TRIANGLES,
    UNKNOWN,
)
from xpbd_ros.sim.self_collision.spatial_hash import fill, in_order, look_up

REST_SHARE = 0.5
"""largest distance to be kept, relative to a pair's distance at rest"""
CELL = 0.5
"""size of a hash cell, relative to the longest edge plus the search distance"""
HALVINGS = 8
"""most halvings of a margin that yields more pairs than the capacity"""


@jit
def seek(near, thickness, left):
    """Build the list, with a margin for ``left`` substeps of the present motion."""
    top = 0.0
    for i in range(len(near.slot)):
        top = max(top, near.x[i, TRAVEL])
        for a in range(3):
            near.seen[i, a] = near.x[i, a]
    near.drift[:] = 0.0
    for a in range(3):
        near.origin[a] = near.x[0, a]
    near.count[0] += 1
    margin = 2.0 * top * min(left, max(2.0, near.reach / (2.0 * top)))
    lost = list_pairs(near, near.surface, thickness, margin, False)
    for halving in range(HALVINGS):
        if lost == 0:
            break
        margin *= 0.5
        lost = list_pairs(near, near.surface, thickness, margin, halving == HALVINGS - 1)
    near.count[1] += lost
    near.margin[0] = margin
    for i in range(len(near.slot)):
        near.x[i, TRAVEL] = min(near.x[i, TRAVEL], 0.5 * margin)


@jit
def list_pairs(near, surface, thickness, margin, to_the_end):
    """
    List the pairs closer than thickness + margin; return the number beyond the capacity.

    Unless ``to_the_end``, the search ends at the first pair beyond the capacity.
    """
    if surface is None:
        return list_particles(near, thickness, margin, to_the_end)
    else:
        return list_surface(near, surface, thickness, margin, to_the_end)


@jit(inline=True)
def append_pair(near, end, i, j, k, l):
    """Append a pair if the capacity allows; return the new end of the list."""
    if end < len(near.keep):
        corners = near.corners
        corners[0, end], corners[1, end], corners[2, end], corners[3, end] = i, j, k, l
        near.keep[end] = UNKNOWN
    return end + 1


@jit
def begin_kind(near, kind, end):
    """Begin the pairs of a kind where the others end, at a multiple of PACK; return it."""
    near.kind_begin[kind] = near.kind_end[kind] = min(
        (end + PACK - 1) // PACK * PACK, len(near.keep))
    return near.kind_begin[kind]


@jit
def end_kind(near, kind, end):
    """End the pairs of a kind, fill up the last pack; return the number beyond the capacity."""
    room, dummy = len(near.keep), len(near.slot)
    near.kind_end[kind] = min(end, room)
    for c in range(min(end, room), min((end + PACK - 1) // PACK * PACK, room)):
        for p in range(4):
            near.corners[p, c] = dummy
    return max(0, end - room)


@jit
def list_particles(near, thickness, margin, to_the_end):
    """List pairs of particles (see ``list_pairs``)."""
    x, size, dummy = near.x, thickness + margin, len(near.slot)
    near.kind_begin[:] = near.kind_end[:] = 0
    end = begin_kind(near, POINTS, 0)
    fill(near.cells, x, size)
    for i in range(dummy):
        if end > len(near.keep) and not to_the_end:
            break
        low = x[i, 0] - size, x[i, 1] - size, x[i, 2] - size
        high = x[i, 0] + size, x[i, 1] + size, x[i, 2] + size
        found, close = near.cells.found, 0
        for f in range(look_up(near.cells, x, size, low, high, i + 1)):
            j = found[f]
            if length(minus(at(x, i), at(x, j))) < size and not are_welded(near.kin, i, j):
                found[close] = j
                close += 1
        in_order(found, close)
        for f in range(close):
            j = found[f]
            keep = required_distance(near.cloth, near.rest, POINTS, thickness, i, j, j, j)
            if length(minus(at(x, i), at(x, j))) < keep + margin:
                end = append_pair(near, end, i, j, dummy, dummy)
    return end_kind(near, POINTS, end)


@jit
def required_distance(cloth, rest, kind, thickness, i, j, k, l):
    """
    Return the distance that a pair has to keep [m].

    It is the thickness, and within a cloth at most REST_SHARE of the pair's distance at rest.
    """
    if cloth[i] != cloth[l]:
        return thickness
    return min(thickness, REST_SHARE * length(closest_vector(kind, rest, i, j, k, l)[0]))


@jit
def list_surface(near, surface, thickness, margin, to_the_end):
    """List pairs of particle and triangle, then of edges, that share no particle or weld group."""
    x, size, longest = near.x, thickness + margin, 0.0
    edges, triangles, middle = surface.edges, surface.triangles, surface.middle
    for e in range(len(edges)):
        p, q = at(x, edges[e, 0]), at(x, edges[e, 1])
        longest = max(longest, length(minus(p, q)))
        for a in range(3):
            middle[e, a] = 0.5 * (p[a] + q[a])
    cell = CELL * (size + longest)
    fill(near.cells, x, cell)
    fill(surface.cells, middle, cell)
    near.kind_begin[:] = near.kind_end[:] = 0
    end = begin_kind(near, TRIANGLES, 0)
    for t in range(len(triangles)):
        if end > len(near.keep) and not to_the_end:
            break
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        p, q, r = at(x, i), at(x, j), at(x, k)
        low = (min(p[0], q[0], r[0]) - size, min(p[1], q[1], r[1]) - size,
               min(p[2], q[2], r[2]) - size)
        high = (max(p[0], q[0], r[0]) + size, max(p[1], q[1], r[1]) + size,
                max(p[2], q[2], r[2]) + size)
        found, close = near.cells.found, 0
        for f in range(look_up(near.cells, x, cell, low, high, 0)):
            v = found[f]
            if (surface.outer[v] and not (are_welded(near.kin, v, i) or are_welded(near.kin, v, j)
                                          or are_welded(near.kin, v, k))
                    and length(closest_vector(TRIANGLES, x, v, i, j, k)[0]) < size):
                found[close] = v
                close += 1
        in_order(found, close)
        for f in range(close):
            end = append_pair(near, end, found[f], i, j, k)
    lost = end_kind(near, TRIANGLES, end)
    end = begin_kind(near, EDGES, end)
    for e in range(len(edges)):
        if end > len(near.keep) and not to_the_end:
            break
        i, j = edges[e, 0], edges[e, 1]
        p, q, half = at(x, i), at(x, j), size + 0.5 * longest
        low = (min(p[0], q[0]) - half, min(p[1], q[1]) - half, min(p[2], q[2]) - half)
        high = (max(p[0], q[0]) + half, max(p[1], q[1]) + half, max(p[2], q[2]) + half)
        found, close = surface.cells.found, 0
        for f in range(look_up(surface.cells, middle, cell, low, high, e + 1)):
            other = found[f]
            k, l = edges[other, 0], edges[other, 1]
            if apart(p, q, at(x, k), at(x, l), size) or (
                    are_welded(near.kin, i, k) or are_welded(near.kin, i, l)
                    or are_welded(near.kin, j, k) or are_welded(near.kin, j, l)):
                continue
            if length(closest_vector(EDGES, x, i, j, k, l)[0]) < size:
                found[close] = other
                close += 1
        in_order(found, close)
        for f in range(close):
            end = append_pair(near, end, i, j, edges[found[f], 0], edges[found[f], 1])
    return lost + end_kind(near, EDGES, end)


@jit(inline=True)
def apart(p, q, r, s, size):
    """Return True if the bounding boxes of the edges pq and rs are further apart than ``size``."""
    return (max(p[0], q[0]) + size < min(r[0], s[0]) or max(r[0], s[0]) + size < min(p[0], q[0])
            or max(p[1], q[1]) + size < min(r[1], s[1]) or max(r[1], s[1]) + size < min(p[1], q[1])
            or max(p[2], q[2]) + size < min(r[2], s[2])
            or max(r[2], s[2]) + size < min(p[2], q[2]))
