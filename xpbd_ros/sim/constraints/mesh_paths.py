"""
Direct solution of paths along the edges of a mesh (doc/numerics.md 3.4).

Each edge of the mesh belongs to one path. At each vertex the edges that continue one another most
straightly become neighbours on a path, if the turn is less than a right angle. On an irregular
mesh of 5000 vertices paths have 11 edges on average, and half of the edges are on paths of 19 and
more. A path ends at least at each vertex with an odd number of edges, so no cover has longer ones
than 15 on average there. The system of a path is that of a line of a grid
(``constraints.line_solver``); neighbours on the path couple by the cosine of their turn.

A path passes each of its particles once: it is cut where it would come back. So only neighbours
share a particle, and the tridiagonal system is J M Jᵀ + α itself.

A path under tension zigzags, and alone it would straighten by C over its turns, before the other
edges at its particles have pulled. Where C is large, later paths do not undo this: a sheet of 2000
particles at a strain of 0.1 trembles at 0.2 m/s. Therefore α counts in the matrix as at least
(m_k + m_{k+1}) min(MOST, max(LEAST, PER_STRAIN C / l)), which moves no solution: C + α f = 0 is
still what a converged iteration meets.

Paths cross one another, so all paths of a pack share no particle. A pack has PACK lanes, with
paths one after another in each, and as many rows as its first path, the longest, has edges; a row
is a vector of edges, one of each lane. Rows are the packs of ``constraints.mesh_batches``, so that
the same arrays serve the sweeps.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    fma,
    lanes,
    larger,
    load,
    select,
    smaller,
    splat,
    store,
)
from xpbd_ros.sim.backend.simd_records import load_records, PACK
from xpbd_ros.sim.backend.simd_vector3 import vector3
from xpbd_ros.sim.constraints.line_solver import edge_vector
from xpbd_ros.sim.constraints.mesh_batches import EMPTY
from xpbd_ros.sim.constraints.pinned import listed_range_of
from xpbd_ros.sim.constraints.pinned_edges import EdgeStops, gather_reaction, note
from xpbd_ros.sim.particles.accumulators import record_moves
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.records import from_records, to_records
from xpbd_ros.sim.particles.rounding import store_moved_records

SHORT, SHARE = 4, 6
"""a path has at most SHORT edges, or one for every SHARE * PACK particles if these are more;
longer ones cross too many others for a pack to fill up"""
STRAIGHT = 0.0
"""cosine of the sharpest turn of a path"""
LEAST, PER_STRAIN, MOST = 0.03, 2.0, 0.2
"""least α in the matrix, relative to m_k + m_{k+1}, for slack edges, by strain, and at most"""


class Cover(NamedTuple):
    """Paths along all edges of some meshes, in packs."""

    particles: np.ndarray
    """slots of both ends of each edge, in the direction of its path, shape (edges, 2)"""
    order: np.ndarray
    """edge in each lane of each row, EMPTY where there is none, shape (rows * PACK,)"""
    begin: np.ndarray
    """first row of each pack, and the number of rows, shape (packs + 1,)"""
    follows: np.ndarray
    """True where the edge one row before is its neighbour on a path, shape (rows * PACK,)"""


class Paths(NamedTuple):
    """The paths of all meshes for the kernels."""

    begin: np.ndarray
    """first row of each pack, and the number of rows, shape (packs + 1,)"""
    starts: np.ndarray
    """True where a path starts in a lane after another one, shape (rows,)"""
    follows: np.ndarray
    """1 where the edge one row before is its neighbour on a path, else 0; shape (rows * PACK,)"""
    stops: EdgeStops | None
    """edges at pinned particles, by pack; None in a scene without pins"""
    axis: np.ndarray
    """direction of coincident particles, shape (3,)"""
    work: np.ndarray
    """scratch of the elimination: d (3 rows), l, off-diagonal / pivot, s; shape
    (6, rows of the longest pack * PACK)"""


def cover(particles: np.ndarray, x: np.ndarray) -> Cover:
    """
    Return paths along all edges.

    Parameters
    ----------
    particles : slots of both ends of each edge, shape (edges, 2)
    x : rest positions by slot [m], shape (slots, 3)

    """
    ends = np.ascontiguousarray(particles, np.int64).reshape(-1, 2)
    d = x[ends[:, 1]] - x[ends[:, 0]]
    length = np.sqrt(d[:, 0]**2 + d[:, 1]**2 + d[:, 2]**2)    # in one order on any CPU
    d = d / np.where(length > 0.0, length, 1.0)[:, None]
    at = np.argsort(ends.ravel(), kind='stable')
    first = np.searchsorted(ends.ravel()[at], np.arange(len(x) + 1))
    count, neighbour = len(ends), np.full(ends.shape, -1)
    _find_neighbours(d, first, at, neighbour)
    longest = max(SHORT, len(np.unique(ends)) // (SHARE * PACK))
    edges, path, row, lane = (np.empty(count, np.int64) for _ in range(4))
    flipped = np.zeros(count, bool)
    _walk(ends, neighbour, longest, edges, flipped, path, np.zeros(count, bool),
          np.full(len(x), -1))
    last = np.searchsorted(path, np.arange(path[-1] + 2 if len(path) else 1))
    longest_first = np.argsort(-np.diff(last), kind='stable')
    ends = np.where(flipped[:, None], ends[:, ::-1], ends)
    begin = np.zeros(len(longest_first) + 1, np.int64)
    packs = _fill_packs(ends, edges, last, longest_first, row, lane, begin,
                        np.empty(len(begin), np.int64), np.full(len(x), -1),
                        np.empty(PACK, np.int64))
    begin = begin[:packs + 1].copy()
    order = np.full((begin[-1], PACK), EMPTY)
    order[row, lane] = edges
    follows = np.zeros(order.shape, bool)
    follows[row, lane] = np.diff(path, prepend=-1) == 0
    return Cover(ends, order.ravel(), begin, follows.ravel())


@jit
def _find_neighbours(d, first, at, found):
    """
    Find the neighbour of each edge at both of its ends.

    Parameters
    ----------
    d : unit vectors along the edges, shape (edges, 3)
    first, at : 2 edge + end of the edges at particle i are at[first[i]:first[i + 1]]
    found : the neighbours, -1 where there is none and at first, shape (edges, 2)

    """
    for i in range(len(first) - 1):
        while True:
            best, one, other = -STRAIGHT, -1, -1
            for p in range(first[i], first[i + 1]):
                a = at[p]
                if found[a // 2, a % 2] >= 0:
                    continue
                for q in range(p + 1, first[i + 1]):
                    b = at[q]
                    if found[b // 2, b % 2] >= 0:
                        continue
                    cosine = (d[a // 2, 0] * d[b // 2, 0] + d[a // 2, 1] * d[b // 2, 1]
                              + d[a // 2, 2] * d[b // 2, 2])
                    if a % 2 != b % 2:    # one ends where the other begins
                        cosine = -cosine
                    if cosine < best:
                        best, one, other = cosine, a, b
            if one < 0:
                break
            found[one // 2, one % 2] = other // 2
            found[other // 2, other % 2] = one // 2


@jit
def _walk(ends, neighbour, longest, edges, flipped, path, seen, passed):
    """
    Order the edges by paths.

    Paths are cut where they come back to a particle, and after ``longest`` edges.

    Parameters
    ----------
    ends : slots of both ends of each edge, shape (edges, 2)
    neighbour : as from ``_find_neighbours``
    longest : number of edges
    edges, path : the edges in the order of paths, and the path of each, shape (edges,)
    flipped : whether each edge is passed from its second end, False at first, shape (edges,)
    seen : scratch, False at first, shape (edges,)
    passed : the last path through each particle, -1 at first, shape (slots,)

    """
    done, number = 0, -1
    for closed in (False, True):
        for c in range(len(ends)):
            for end in range(2):
                if seen[c] or not (closed or neighbour[c, end] < 0):
                    continue
                a, i, number, length = c, ends[c, end], number + 1, 0
                passed[i] = number
                while a >= 0 and not seen[a]:
                    flipped[a] = ends[a, 1] == i
                    j = ends[a, 0] if flipped[a] else ends[a, 1]
                    if passed[j] == number or length == longest:
                        number, length = number + 1, 0
                        passed[i] = number
                    passed[j] = number
                    seen[a] = True
                    edges[done], path[done] = a, number
                    done, length = done + 1, length + 1
                    a, i = neighbour[a, 0 if flipped[a] else 1], j


@jit
def _fill_packs(ends, edges, last, paths, row, lane, begin, after, pack_of, filled):
    """
    Fill the packs, and return how many there are.

    Parameters
    ----------
    ends : slots of both ends of each edge, shape (edges, 2)
    edges, last : the edges of path p are edges[last[p]:last[p + 1]]
    paths : the paths, longest first
    row, lane : of each edge, in the order of paths, shape (edges,)
    begin : the first row of each pack, 0 at first, shape (paths + 1,)
    after : of a path that waits, the next that does; the first in the end, shape (paths + 1,)
    pack_of : the last pack of each particle, -1 at first, shape (slots,)
    filled : scratch, the rows in use of each lane, shape (PACK,)

    """
    for n in range(len(paths)):
        after[n] = n + 1
    after[len(paths)] = 0
    none, pack = len(paths), 0
    while after[none] < none:
        rows, space = 0, 0
        filled[:] = 0
        before, n = none, after[none]
        while n < none and (rows == 0 or space > 0):
            p = paths[n]
            count = last[p + 1] - last[p]
            if rows == 0:
                rows, space = count, count * PACK
            best = -1
            for k in range(PACK):
                if filled[k] + count <= rows and (best < 0 or filled[k] > filled[best]):
                    best = k
            apart = best >= 0 and pack_of[_start(ends, edges, last[p])] != pack
            for c in range(last[p], last[p + 1]):
                apart = apart and pack_of[ends[edges[c], 1]] != pack
            if apart:
                pack_of[_start(ends, edges, last[p])] = pack
                for c in range(last[p], last[p + 1]):
                    pack_of[ends[edges[c], 1]] = pack
                    row[c], lane[c] = begin[pack] + filled[best] + c - last[p], best
                filled[best] += count
                space -= count
                after[before] = after[n]
            else:
                before = n
            n = after[n]
        begin[pack + 1] = begin[pack] + rows
        pack += 1
    return pack


@jit
def _start(ends, edges, first):
    return ends[edges[first], 0]


def paths_of(found: Cover, edges) -> Paths:
    """Return paths for the kernels; ``edges`` is the batch (``MeshEdges``) in their order."""
    follows = found.follows.reshape(-1, PACK)
    starts = ((found.order >= 0).reshape(-1, PACK) & ~follows).any(1)
    starts[found.begin[:-1]] = False
    dtype, most = edges.records.dtype, int(np.diff(found.begin).max(initial=0))
    stops = None
    if edges.held is not None:
        count = len(edges.held.index)
        stops = EdgeStops(edges.held, np.zeros(len(found.begin), np.int64),
                          np.zeros((count, 3)), np.zeros(count))
    follows_ = zeros(len(found.follows), dtype)
    follows_[:] = found.follows
    return Paths(found.begin, starts, follows_, stops, np.array((1.0, 0.0, 0.0), dtype),
                 zeros((6, most * PACK), dtype))


def packs_of(paths: Paths, index: np.ndarray) -> np.ndarray:
    """Return the number of the pack of each edge from the positions of the multipliers."""
    return np.searchsorted(paths.begin, index // PACK, side='right') - 1


def hold(paths: Paths) -> None:
    """Update the ranges of edges at pinned particles, after the list of them."""
    if paths.stops is not None:
        held = paths.stops.held
        paths.stops.first[:] = np.searchsorted(held.index[:held.count[0]], PACK * paths.begin)


@jit
def solve_paths(paths, edges, state, substep):
    """Solve every path, in order; called twice, as ``line_solver.solve_edges`` is."""
    records, begin, stops = edges.records, paths.begin, paths.stops
    errors = record_moves(state.rounding)
    part, (one, other) = substep.end - substep.begin, (edges.slots[0], edges.slots[1])
    to_records(state, records, one, other)
    for p in range(len(begin) - 1):
        first, last = listed_range_of(stops, p)
        if first < last:
            note(stops, first, last, records[:, 0], records[:, 1], records[:, 2], state.apart,
                 edges.force)
        for q in range(0, PACK, lanes(records)):
            _solve_pack(paths, edges, errors, begin[p], begin[p + 1], q)
        if first < last:
            gather_reaction(stops, first, last, state.mobility, edges.force, part, state.reaction)
    from_records(state, records, one, other)


@jit
def _solve_pack(paths, edges, errors, begin, end, q):
    """Solve the paths in the lanes of a vector, from lane q of a pack on (doc/numerics.md 3.4)."""
    records, force, axis, work = edges.records, edges.force, paths.axis, paths.work
    one, other = edges.particles[0], edges.particles[1]
    n, zero = lanes(records), splat(records, 0.0)
    ex, ey, ez, long, ratio, step = work[0], work[1], work[2], work[3], work[4], work[5]
    vx, vy, vz, pivot, right = zero, zero, zero, zero, zero
    xa, ya, za, ma = load_records(records, one, begin * PACK + q)
    for r in range(begin, end):
        c, o = r * PACK + q, (r - begin) * n
        if paths.starts[r]:
            xa, ya, za, ma = load_records(records, one, c)
            on = load(paths.follows, c)
            vx, vy, vz = on * vx, on * vy, on * vz
        xb, yb, zb, mb = load_records(records, other, c)
        alpha, rest = load(edges.compliance, c), load(edges.rest_length, c)
        (dx, dy, dz), square, l, l_or_1 = edge_vector(xb - xa, yb - ya, zb - za, axis)
        off = -ma * fma(dx, vx, fma(dy, vy, dz * vz))
        total = ma + mb
        link = off * pivot
        soft = smaller(MOST * l_or_1, larger(LEAST * l_or_1, PER_STRAIN * (l - rest)))
        bottom = fma(-link, off, fma(total, square, larger(alpha * square, total * l_or_1 * soft)))
        solvable = bottom > 0.0
        pivot = 1.0 / select(solvable, bottom, 1.0)
        residual = fma(alpha, load(force, c), l - rest)
        right = select(solvable, (-residual * l_or_1 - off * right) * pivot, 0.0)
        store(ex, o, dx)
        store(ey, o, dy)
        store(ez, o, dz)
        store(long, o, l_or_1)
        store(ratio, o, link)
        store(step, o, right)
        vx, vy, vz = dx, dy, dz
        xa, ya, za, ma = xb, yb, zb, mb
    s, above, wx, wy, wz = zero, zero, zero, zero, zero
    for r in range(end - 1, begin - 1, -1):
        c, o = r * PACK + q, (r - begin) * n
        s = load(step, o) - above * s
        store(force, c, fma(s, load(long, o), load(force, c)))
        gx, gy, gz = s * load(ex, o), s * load(ey, o), s * load(ez, o)
        xb, yb, zb, mb = load_records(records, other, c)
        store_moved_records(records, errors, other, c, vector3(xb, yb, zb), mb,
                            vector3(gx - wx, gy - wy, gz - wz), mb)
        above = load(ratio, o)
        wx, wy, wz = gx, gy, gz
        if paths.starts[r] or r == begin:
            xa, ya, za, ma = load_records(records, one, c)
            on = load(paths.follows, c)
            m = on * ma - ma
            store_moved_records(records, errors, one, c, vector3(xa, ya, za), m,
                                vector3(gx, gy, gz), ma)
            wx, wy, wz = on * gx, on * gy, on * gz
