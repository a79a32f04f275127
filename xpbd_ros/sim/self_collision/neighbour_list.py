"""
Nearby: pairs of particles, or of triangles and edges, that can get close before the next search.

Sought at positions y, listed if nearer than thickness + margin. Later, with U the way that all
have gone together and s_i = |x_i - y_i - U|, a pair is no nearer than its distance then less its
two largest s; so while s ≤ margin / 2 everywhere, what is not listed is further than the
thickness. Pairs come in rising order, particles counted in natural order, so that neither the
cells nor the layout in memory decide about bits.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.closest_points import dot, minus, on_edges, on_triangle
from xpbd_ros.sim.self_collision.spatial_hash import Cells, fill, in_order, look_up, new_cells

REST_SHARE = 0.5
"""of the distance at rest: nearer than that, cloth touches what it is joined to"""
POINTS, TRIANGLES, EDGES = range(3)
"""a pair of particles, of a particle and a triangle, of two edges"""
CELL = 0.5
"""size of a cell, over that of the longest edge with what is sought round it"""
HALVINGS = 8
"""of a margin that finds more pairs than there is room for"""


class Surface(NamedTuple):
    """What particles span, all cloths together; particles in natural order."""

    triangles: np.ndarray
    """shape (triangles, 3)"""
    edges: np.ndarray
    """shape (edges, 2)"""
    outer: np.ndarray
    """whether a particle is a corner of any, shape (particles,)"""
    middle: np.ndarray
    """of the edges [m], shape (edges, 3)"""
    cells: Cells
    """of the middles"""


class NeighbourList(NamedTuple):
    """The list, and what it was made from; particles in natural order."""

    slot: np.ndarray
    """where each particle lies, shape (particles,)"""
    cloth: np.ndarray
    """index of each particle's cloth, shape (particles,)"""
    rest: np.ndarray
    """unstressed positions [m], shape (particles, 3)"""
    reach: float
    """margin that saves searching again, as far as that is worth it [m]"""
    x: np.ndarray
    """where the substep starts [m], shape (particles, 3)"""
    seen: np.ndarray
    """y: where particles were when pairs were sought [m], shape (particles, 3)"""
    drift: np.ndarray
    """U: the way that all have gone together since [m], shape (3,)"""
    step: np.ndarray
    """the same of this substep: of what is pinned, or of all; [m], shape (3,)"""
    drift_since_build: np.ndarray
    """s at the substep's start [m], shape (particles,)"""
    travel: np.ndarray
    """how far each may get from x + step in this substep [m], shape (particles,)"""
    margin: np.ndarray
    """[m]; 0: not sought; shape (1,)"""
    count: np.ndarray
    """of this frame: searches; pairs that found no room; particles held back; particles and pairs
    for which that was not enough; shape (4,)"""
    kind_end: np.ndarray
    """where each kind's pairs end, shape (3,)"""
    first: np.ndarray
    """particle or edge, shape (room,)"""
    second: np.ndarray
    """particle, triangle or edge, shape (room,)"""
    distance: np.ndarray
    """when they were sought [m], shape (room,)"""
    keep: np.ndarray
    """distance to be kept [m], -1 while not known; shape (room,)"""
    cells: Cells
    """of the particles"""
    surface: Surface | None
    """None where only particles are looked at"""
    kin: np.ndarray | None
    """the same number for particles that are sewn together, shape (particles,); None: none are"""


def new_neighbour_list(cloths, room: int, surface: bool,
                       kin: np.ndarray | None = None) -> NeighbourList:
    """Return room for that many pairs of particles, or of what they span."""
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
def same(kin, a, b):
    """Tell whether two particles are one, or sewn together."""
    if kin is None:
        return a == b
    else:    # Numba prunes the branch that is not taken
        return kin[a] == kin[b]


@jit(inline=True)
def corners(surface, kind, a, b):
    """Return the particles of a pair, those of the one side first; a pair of particles has two."""
    if surface is None:
        return a, b, b, b
    else:    # Numba prunes the branch that is not taken
        t, e = surface.triangles, surface.edges
        if kind == TRIANGLES:
            return a, t[b, 0], t[b, 1], t[b, 2]
        return e[a, 0], e[a, 1], e[b, 0], e[b, 1]


@jit
def weights(kind, p, q, r, s):
    """Return the weights of a pair's particles whose sum is the way between its closest points."""
    if kind == POINTS:
        return 1.0, -1.0, 0.0, 0.0
    if kind == TRIANGLES:
        u, v, w = on_triangle(p, q, r, s)
        return 1.0, -u, -v, -w
    u, v = on_edges(p, q, r, s)
    return 1.0 - u, u, v - 1.0, -v


@jit(inline=True)
def way(kind, x, i, j, k, l):
    """Return the vector between a pair's closest points, and the weights that make it."""
    return between(kind, at(x, i), at(x, j), at(x, k), at(x, l))


@jit(inline=True)
def way_now(kind, x, i, j, k, l):
    """Return the same of particles in these slots; x of shape (3, slots)."""
    return between(kind, (x[0, i], x[1, i], x[2, i]), (x[0, j], x[1, j], x[2, j]),
                   (x[0, k], x[1, k], x[2, k]), (x[0, l], x[1, l], x[2, l]))


@jit(inline=True)
def between(kind, p, q, r, s):
    """Return the vector between the closest points of a pair in these places, and the weights."""
    b = weights(kind, p, q, r, s)
    # differences first, so that a place far from the origin costs no digits
    q, r, s = minus(q, p), minus(r, p), minus(s, p)
    return (b[1] * q[0] + b[2] * r[0] + b[3] * s[0], b[1] * q[1] + b[2] * r[1] + b[3] * s[1],
            b[1] * q[2] + b[2] * r[2] + b[3] * s[2]), b


@jit(inline=True)
def length(v):
    """Return |v|."""
    return sqrt(dot(v, v))


@jit
def common_step(near, state):
    """Note where the substep starts, and how far what is pinned moves in it; or else all."""
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
    """Note how far each may get, apart from what all do; return the most, and a side's most."""
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
    """Return how far a particle has moved in this substep, apart from what all have [m]."""
    return length((x[0, j] - start[i, 0] - step[0], x[1, j] - start[i, 1] - step[1],
                   x[2, j] - start[i, 2] - step[2]))


@jit
def seek(near, thickness, left):
    """Rebuild the list of all pairs; ``left`` is how many substeps the list should last."""
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
    List what is nearer than thickness + margin; return how many found no room.

    Unless it is to go on ``to_the_end``, that is where the first finds none.
    """
    if surface is None:
        return list_particles(near, thickness, margin, to_the_end)
    else:
        return list_surface(near, surface, thickness, margin, to_the_end)


@jit(inline=True)
def put(near, end, first, second, distance, keep):
    """Write a pair where there is room; return the end of the list."""
    if end < len(near.first):
        near.first[end], near.second[end] = first, second
        near.distance[end], near.keep[end] = distance, keep
    return end + 1


@jit
def closed(near, end, kind):
    """End the list of a kind; return how many found no room."""
    room = len(near.first)
    for k in range(kind, 3):
        near.kind_end[k] = min(end, room)
    return max(0, end - room)


@jit
def list_particles(near, thickness, margin, to_the_end):
    """List pairs of particles."""
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
            if length(minus(at(x, i), at(x, j))) < size and not same(near.kin, i, j):
                found[close] = j
                close += 1
        in_order(found, close)
        for f in range(close):
            j = found[f]
            keep = kept(near.cloth, near.rest, POINTS, thickness, i, j, j, j)
            distance = length(minus(at(x, i), at(x, j)))
            if distance < keep + margin:
                end = put(near, end, i, j, distance, keep)
    return closed(near, end, POINTS)


@jit
def kept(cloth, rest, kind, thickness, i, j, k, l):
    """Return the distance that a pair has to keep: not more than a share of that at rest."""
    if cloth[i] != cloth[l]:
        return thickness
    return min(thickness, REST_SHARE * length(way(kind, rest, i, j, k, l)[0]))


@jit
def list_surface(near, surface, thickness, margin, to_the_end):
    """List pairs of particle and triangle, then of edges; none that share a particle."""
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
            if (surface.outer[v] and not (same(near.kin, v, i) or same(near.kin, v, j)
                                          or same(near.kin, v, k))
                    and length(way(TRIANGLES, x, v, i, j, k)[0]) < size):
                found[close] = v
                close += 1
        in_order(found, close)
        for f in range(close):
            distance = length(way(TRIANGLES, x, found[f], i, j, k)[0])
            end = put(near, end, found[f], t, distance, -1.0)
    closed(near, end, TRIANGLES)
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
                    same(near.kin, i, k) or same(near.kin, i, l)
                    or same(near.kin, j, k) or same(near.kin, j, l)):
                continue
            if length(way(EDGES, x, i, j, k, l)[0]) < size:
                found[close] = other
                close += 1
        in_order(found, close)
        for f in range(close):
            other = found[f]
            k, l = edges[other, 0], edges[other, 1]
            distance = length(way(EDGES, x, i, j, k, l)[0])
            end = put(near, end, e, other, distance, -1.0)
    return closed(near, end, EDGES)


@jit(inline=True)
def apart(p, q, r, s, size):
    """Tell whether the boxes round two edges are further apart than this along an axis."""
    return (max(p[0], q[0]) + size < min(r[0], s[0]) or max(r[0], s[0]) + size < min(p[0], q[0])
            or max(p[1], q[1]) + size < min(r[1], s[1]) or max(r[1], s[1]) + size < min(p[1], q[1])
            or max(p[2], q[2]) + size < min(r[2], s[2])
            or max(r[2], s[2]) + size < min(p[2], q[2]))
