"""
Neighbour list (Verlet list): pairs of particles, or of triangles and edges, that may come close.

A pair is listed if it is closer than thickness + margin at the positions y of the build. Later,
with the common displacement U and s_i = |x_i - y_i - U|, its distance has decreased by at most the
sum of its two largest s; so while s ≤ margin / 2 for all particles, pairs that are not listed are
further apart than the thickness. Pairs are in rising order of particles in natural order, so that
neither hash cells nor memory layout affect the bits.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.closest_points import dot, minus, on_edges, on_triangle
from xpbd_ros.sim.self_collision.spatial_hash import Cells, fill, in_order, look_up, new_cells

REST_SHARE = 0.5
"""largest distance to be kept, relative to a pair's distance at rest"""
POINTS, TRIANGLES, EDGES = range(3)
"""kinds of pairs: two particles, particle and triangle, two edges"""
CELL = 0.5
"""size of a hash cell, relative to the longest edge plus the search distance"""
HALVINGS = 8
"""most halvings of a margin that yields more pairs than the capacity"""


class Surface(NamedTuple):
    """Triangles and edges of all cloths; particles in natural order."""

    triangles: np.ndarray
    """shape (triangles, 3)"""
    edges: np.ndarray
    """shape (edges, 2)"""
    outer: np.ndarray
    """True if a particle is a corner of a triangle, shape (particles,)"""
    middle: np.ndarray
    """midpoints of the edges [m], shape (edges, 3)"""
    cells: Cells
    """spatial hash of the midpoints"""


class NeighbourList(NamedTuple):
    """The list, the positions of its build, and motion since; particles in natural order."""

    slot: np.ndarray
    """slot of each particle, shape (particles,)"""
    cloth: np.ndarray
    """index of each particle's cloth, shape (particles,)"""
    rest: np.ndarray
    """rest positions [m], shape (particles, 3)"""
    reach: float
    """largest margin, unless two substeps' motion needs more [m]"""
    x: np.ndarray
    """positions at the substep's start [m], shape (particles, 3)"""
    seen: np.ndarray
    """y: positions at the build [m], shape (particles, 3)"""
    drift: np.ndarray
    """U: common displacement since the build [m], shape (3,)"""
    step: np.ndarray
    """common displacement in this substep: mean of the pinned particles, or of all without pinned
    ones [m], shape (3,)"""
    drift_since_build: np.ndarray
    """s at the substep's start [m], shape (particles,)"""
    travel: np.ndarray
    """bound of each particle's distance from x + step in this substep [m], shape (particles,)"""
    margin: np.ndarray
    """[m]; 0: the list is not built; shape (1,)"""
    count: np.ndarray
    """in this frame: builds; pairs beyond the capacity; particles held back; particles and pairs
    that penetrate nevertheless; shape (4,)"""
    kind_end: np.ndarray
    """end of the pairs of each kind in the list, shape (3,)"""
    first: np.ndarray
    """particle or edge, shape (capacity,)"""
    second: np.ndarray
    """particle, triangle or edge, shape (capacity,)"""
    distance: np.ndarray
    """distance at the build [m], shape (capacity,)"""
    keep: np.ndarray
    """distance to be kept [m], -1: not computed yet; shape (capacity,)"""
    cells: Cells
    """spatial hash of the particles"""
    surface: Surface | None
    """None if only particles collide"""
    kin: np.ndarray | None
    """weld group: equal for particles that a seam joins, shape (particles,); None without seams"""


def new_neighbour_list(cloths, room: int, surface: bool,
                       kin: np.ndarray | None = None) -> NeighbourList:
    """
    Return an empty list.

    Parameters
    ----------
    cloths : all cloths
    room : capacity in pairs
    surface : True for pairs of triangles and edges, False for pairs of particles
    kin : weld groups, shape (particles,), or None

    """
    rest = np.concatenate([cloth.mesh.positions for cloth in cloths])
    count, span = len(rest), None
    edges = [cloth.mesh.edges + cloth.first for cloth in cloths]
    if surface:
        triangles = np.concatenate([cloth.mesh.triangles + cloth.first for cloth in cloths])
        sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
        sides = np.unique(sides, axis=0).reshape(-1, 2)
        outer = np.zeros(count, np.bool_)
        outer[triangles] = True
        span = Surface(triangles, sides, outer, np.zeros((len(sides), 3)), new_cells(len(sides)))
    lengths = [np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1).mean()
               for pairs in edges if len(pairs)]
    return NeighbourList(
        np.concatenate([cloth.slots for cloth in cloths]),
        np.repeat(np.arange(len(cloths)), [len(cloth.mesh.positions) for cloth in cloths]),
        rest, float(0.5 * min(lengths, default=0.0)), np.zeros((count, 3)), np.zeros((count, 3)),
        np.zeros(3), np.zeros(3), np.zeros(count), np.zeros(count), np.zeros(1),
        np.zeros(4, np.int64), np.zeros(3, np.int64), np.zeros(room, np.int64),
        np.zeros(room, np.int64), np.zeros(room), np.zeros(room), new_cells(count), span,
        kin)


@jit(inline=True)
def at(x, i):
    """Return row i of an array."""
    return x[i, 0], x[i, 1], x[i, 2]


@jit(inline=True)
def are_welded(kin, a, b):
    """Return True if two particles are the same or in one weld group."""
    if kin is None:
        return a == b
    else:    # Numba prunes the branch that is not taken
        return kin[a] == kin[b]


@jit(inline=True)
def corners(surface, kind, a, b):
    """Return the four particles of a pair, one side first; (a, b, b, b) for two particles."""
    if surface is None:
        return a, b, b, b
    else:    # Numba prunes the branch that is not taken
        t, e = surface.triangles, surface.edges
        if kind == TRIANGLES:
            return a, t[b, 0], t[b, 1], t[b, 2]
        return e[a, 0], e[a, 1], e[b, 0], e[b, 1]


@jit
def weights(kind, p, q, r, s):
    """Return weights b of a pair's particles: Σ b x is the vector between the closest points."""
    if kind == POINTS:
        return 1.0, -1.0, 0.0, 0.0
    if kind == TRIANGLES:
        u, v, w = on_triangle(p, q, r, s)
        return 1.0, -u, -v, -w
    u, v = on_edges(p, q, r, s)
    return 1.0 - u, u, v - 1.0, -v


@jit(inline=True)
def closest_vector(kind, x, i, j, k, l):
    """Return the vector between a pair's closest points [m] and its weights; x: (particles, 3)."""
    return between(kind, at(x, i), at(x, j), at(x, k), at(x, l))


@jit(inline=True)
def closest_vector_of_slots(kind, x, i, j, k, l):
    """Return the same for particles by slot; x: positions [m], shape (3, slots)."""
    return between(kind, (x[0, i], x[1, i], x[2, i]), (x[0, j], x[1, j], x[2, j]),
                   (x[0, k], x[1, k], x[2, k]), (x[0, l], x[1, l], x[2, l]))


@jit(inline=True)
def between(kind, p, q, r, s):
    """Return the vector between the closest points of a pair at these points, and its weights."""
    b = weights(kind, p, q, r, s)
    # differences first: no loss of digits far from the origin
    q, r, s = minus(q, p), minus(r, p), minus(s, p)
    return (b[1] * q[0] + b[2] * r[0] + b[3] * s[0], b[1] * q[1] + b[2] * r[1] + b[3] * s[1],
            b[1] * q[2] + b[2] * r[2] + b[3] * s[2]), b


@jit(inline=True)
def length(v):
    """Return |v|."""
    return sqrt(dot(v, v))


@jit
def common_step(near, state):
    """Store the positions at the substep's start and the common displacement in the substep."""
    before, x, n = state.x_prev, state.x, len(near.slot)
    held = 0
    near.step[:] = 0.0
    for i in range(n):
        j = near.slot[i]
        pinned = state.inv_mass[j] == 0.0
        if pinned and held == 0:
            near.step[:] = 0.0
        held += pinned
        for a in range(3):
            near.x[i, a] = before[a, j]
            if pinned or held == 0:
                near.step[a] += x[a, j] - before[a, j]
    for a in range(3):
        near.step[a] /= held if held > 0 else n


@jit
def track_motion(near, x, slack):
    """
    Update the bounds of the particles' motion, ``travel`` and ``drift_since_build``.

    Parameters
    ----------
    x : predicted positions [m], shape (3, slots)
    slack : least motion that projections are assumed to add [m]

    Returns
    -------
    largest travel; largest sum of travel and s

    """
    most, side = 0.0, 0.0
    for i in range(len(near.slot)):
        moved = gone(x, near.x, near.step, near.slot[i], i)
        near.travel[i] = moved + max(moved, slack)
        near.drift_since_build[i] = length((near.x[i, 0] - near.seen[i, 0] - near.drift[0],
                                            near.x[i, 1] - near.seen[i, 1] - near.drift[1],
                                            near.x[i, 2] - near.seen[i, 2] - near.drift[2]))
        most = max(most, near.travel[i])
        side = max(side, near.travel[i] + near.drift_since_build[i])
    return most, side


@jit(inline=True)
def gone(x, start, step, j, i):
    """Return |x_j - start_i - step|: a particle's motion relative to the common one [m]."""
    return length((x[0, j] - start[i, 0] - step[0], x[1, j] - start[i, 1] - step[1],
                   x[2, j] - start[i, 2] - step[2]))


@jit
def seek(near, thickness, left):
    """Build the list, with a margin for ``left`` substeps of the present motion."""
    top = 0.0
    for i in range(len(near.slot)):
        top = max(top, near.travel[i])
        near.drift_since_build[i] = 0.0
        for a in range(3):
            near.seen[i, a] = near.x[i, a]
    near.drift[:] = 0.0
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
        near.travel[i] = min(near.travel[i], 0.5 * margin)


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
def append_pair(near, end, first, second, distance, keep):
    """Append a pair if the capacity allows; return the new end of the list."""
    if end < len(near.first):
        near.first[end], near.second[end] = first, second
        near.distance[end], near.keep[end] = distance, keep
    return end + 1


@jit
def end_kind(near, end, kind):
    """Store the end of a kind's pairs; return the number of pairs beyond the capacity."""
    room = len(near.first)
    for k in range(kind, 3):
        near.kind_end[k] = min(end, room)
    return max(0, end - room)


@jit
def list_particles(near, thickness, margin, to_the_end):
    """List pairs of particles (see ``list_pairs``)."""
    x, size, end = near.x, thickness + margin, 0
    fill(near.cells, x, size)
    for i in range(len(x)):
        if end > len(near.first) and not to_the_end:
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
            distance = length(minus(at(x, i), at(x, j)))
            if distance < keep + margin:
                end = append_pair(near, end, i, j, distance, keep)
    return end_kind(near, end, POINTS)


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
    end = 0
    for t in range(len(triangles)):
        if end > len(near.first) and not to_the_end:
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
            distance = length(closest_vector(TRIANGLES, x, found[f], i, j, k)[0])
            end = append_pair(near, end, found[f], t, distance, -1.0)
    end_kind(near, end, TRIANGLES)
    near.kind_end[POINTS] = 0
    for e in range(len(edges)):
        if end > len(near.first) and not to_the_end:
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
            other = found[f]
            k, l = edges[other, 0], edges[other, 1]
            distance = length(closest_vector(EDGES, x, i, j, k, l)[0])
            end = append_pair(near, end, e, other, distance, -1.0)
    return end_kind(near, end, EDGES)


@jit(inline=True)
def apart(p, q, r, s, size):
    """Return True if the bounding boxes of the edges pq and rs are further apart than ``size``."""
    return (max(p[0], q[0]) + size < min(r[0], s[0]) or max(r[0], s[0]) + size < min(p[0], q[0])
            or max(p[1], q[1]) + size < min(r[1], s[1]) or max(r[1], s[1]) + size < min(p[1], q[1])
            or max(p[2], q[2]) + size < min(r[2], s[2])
            or max(r[2], s[2]) + size < min(p[2], q[2]))
