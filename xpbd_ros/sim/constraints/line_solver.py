"""
Direct solution of whole lines of distance constraints (doc/numerics.md 3.3; Deul et al. 2018).

The constraints of a line, linearised at the current positions, give a tridiagonal system:

    (J M Jᵀ + α) Δf = -(C + α f),   diagonal m_k + m_{k+1} + α,   off-diagonal -m_k u_k·u_{k-1}

with M the mobilities m = w H² and unit vectors u_k from particle k to k + 1. With edges
d_k = l_k u_k and steps s_k = Δf_k / l_k, row k is multiplied by l_k, which saves a division:

    diagonal (m_k + m_{k+1} + α) l_k²,   off-diagonal -m_k d_k·d_{k-1},   right side -(C + α f) l_k

It is solved by one forward elimination and one back substitution (Thomas). The matrix is positive
semi-definite for any shape, since each off-diagonal of the first form is at most m_k; it is
singular only for a rigid straight line between two pins. The matrix therefore uses an α of at
least TINY (m_k + m_{k+1}), far below the artificial compliance of a Gauss-Seidel pass.

A rigid line between two pins that are further apart than it is long has no solution: see
``constraints.overextended_lines``.

Meshes have paths along their edges in place of lines (``constraints.mesh_paths``).

Lines of one family share no particle, so each lane of a vector solves one line. Weft lines cross
the rows, whose slots are contiguous. Warp lines run along the rows, so as many rows as there are
lanes are transposed into scratch memory, solved in the same way, and transposed back.
"""

from typing import NamedTuple

from numba import types
import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import (
    after,
    both,
    fma,
    lane_count,
    lanes,
    larger,
    load,
    root,
    select,
    splat,
    store,
    transpose,
)
from xpbd_ros.sim.backend.threads import turns_of_few, wait, worker
from xpbd_ros.sim.constraints.pinned_edges import gather_line_reaction, note_line
from xpbd_ros.sim.constraints.projection import max_compliance
from xpbd_ros.sim.particles.accumulators import moves, row
from xpbd_ros.sim.particles.memory_layout import Block, zeros
from xpbd_ros.sim.particles.rounding import store_moved, store_sum

TINY = 1e-4
"""least α in the matrix, relative to m_k + m_{k+1}"""


class Lines(NamedTuple):
    """The warp and weft lines of all grids."""

    first: np.ndarray
    """slot of each grid's first particle, shape (grids,)"""
    rows: np.ndarray
    """number of rows, shape (grids,)"""
    columns: np.ndarray
    """number of columns, shape (grids,)"""
    parts: np.ndarray
    """number of parts of a row (``particles.memory_layout``), shape (grids,)"""
    part: np.ndarray
    """slots of one part of a row, shape (grids,)"""
    stride: np.ndarray
    """slots from row to row, shape (grids,)"""
    force: np.ndarray
    """start of the multipliers of each grid's warp and weft edges, shape (grids, 2)"""
    rest_length: np.ndarray
    """of warp and weft edges [m], shape (grids, 2)"""
    warp: np.ndarray
    """compliance of the warp edges of each row [m/N], shape (grids, rows)"""
    weft: np.ndarray
    """compliance of the weft edges at each place of a row [m/N], shape (grids, places)"""
    axis: np.ndarray
    """direction of coincident particles, along warp and weft, shape (2, 3)"""
    tiny: float
    """TINY"""
    tile: np.ndarray
    """scratch: transposed rows of x, y, z, mobility, f; shape (threads, 5, columns * lanes)"""
    errors: np.ndarray
    """scratch: transposed rows of rounding errors, shape (threads, 3, columns * lanes)"""
    work: np.ndarray
    """scratch of the elimination: l, off-diagonal / pivot, s; shape (threads, 3, edges * lanes)"""


def grid_lines(blocks: list[Block], spacing, compliance, *, slots: int, dtype,
               threads: int = 1) -> Lines:
    """
    Return the lines of some grids.

    Parameters
    ----------
    blocks : slots of each grid
    spacing : rest length of each grid's warp and weft edges [m], shape (grids, 2)
    compliance : of each grid, of the warp edges by row and of the weft edges by column [m/N]
    slots : number of slots of the state; the multipliers of grid g are family 2 g (warp) and
        2 g + 1 (weft)
    dtype : of all arrays
    threads : number of threads

    """
    lanes_ = lane_count(dtype)
    longest = max(max(b.parts * b.part, b.rows) for b in blocks) + lanes_
    warp, weft = (np.zeros((len(blocks), longest), dtype) for _ in range(2))
    for g, (block, (by_row, by_column)) in enumerate(zip(blocks, compliance)):
        warp[g, :block.rows] = np.minimum(by_row, max_compliance(dtype))
        weft[g, block.slots[0] - block.first] = np.minimum(by_column, max_compliance(dtype))

    def of(value):
        return np.array([value(b) for b in blocks], np.int64)

    return Lines(of(lambda b: b.first), of(lambda b: b.rows), of(lambda b: b.columns),
                 of(lambda b: b.parts), of(lambda b: b.part), of(lambda b: b.row_stride),
                 np.arange(2 * len(blocks)).reshape(-1, 2) * slots,
                 np.array(spacing, dtype).reshape(-1, 2), warp, weft,
                 np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)], dtype), TINY,
                 zeros((threads, 5, longest * lanes_), dtype),
                 zeros((threads, 3, longest * lanes_), dtype),
                 zeros((threads, 3, longest * lanes_), dtype))


@jit
def solve_edges(lines, edges, state, substep):
    """
    Solve every warp line, then every weft line.

    Called twice: after a single solve of each, the weft solve has disturbed the warp lines. With
    few substeps that dominates the error: the reference swing of 41 x 41 particles at 50 kN/m and
    24 substeps has an error of 25 mm after half a second, and of 2 mm with the second solve.
    """
    force, stops, part = edges.force, edges.stops, substep.end - substep.begin
    for g in range(len(lines.first)):
        warp, weft = lines.force[g, 0], lines.force[g, 1]
        note_line(stops, warp, state, force)
        solve_warp(lines, g, force, state)
        gather_line_reaction(stops, warp, state, force, part)
        note_line(stops, weft, state, force)
        solve_weft(lines, g, force, state)
        gather_line_reaction(stops, weft, state, force, part)


@jit
def solve_warp(lines, g, force, state):
    """Solve every warp line of grid g; ``force`` holds the multipliers of warp and weft."""
    x, y, z, m = state.x[0], state.x[1], state.x[2], state.mobility
    work, tile = lines.work[worker(state.team)], lines.tile[worker(state.team)]
    count = lanes(x)
    start, rows, columns = lines.first[g], lines.rows[g], lines.columns[g]
    part, stride, parts = lines.part[g], lines.stride[g], lines.parts[g]
    if columns > 1:
        base, tiles = lines.force[g, 0], max(1, rows // count)
        one, other, over = turns_of_few(state.team, tiles, len(lines.work))
        spare = lines.errors[worker(state.team)]
        for begin in range(one * count, rows if other == tiles else other * count, over * count):
            upper = max(0, min(begin, rows - count))    # the last tile may overlap the one before
            top = start + upper * stride
            gather_rows(x, top, parts, part, stride, tile[0])
            gather_rows(y, top, parts, part, stride, tile[1])
            gather_rows(z, top, parts, part, stride, tile[2])
            gather_rows(m, top, parts, part, stride, tile[3])
            gather_rows(force, base + top, parts, part, stride, tile[4])
            errors = gather_errors(moves(state.rounding), top, parts, part, stride, spare)
            _solve(tile[0], tile[1], tile[2], errors, tile[3], tile[4], 0, 0, count, columns,
                   begin - upper, lines.rest_length[g, 0], load(lines.warp[g], upper), work,
                   lines.axis[0], lines.tiny)
            scatter_rows(tile[0], x, top, parts, part, stride)
            scatter_rows(tile[1], y, top, parts, part, stride)
            scatter_rows(tile[2], z, top, parts, part, stride)
            scatter_rows(tile[4], force, base + top, parts, part, stride)
            scatter_errors(errors, moves(state.rounding), top, parts, part, stride)
        wait(state.team)


@jit
def solve_weft(lines, g, force, state):
    """Solve every weft line of grid g."""
    x, y, z, m = state.x[0], state.x[1], state.x[2], state.mobility
    work = lines.work[worker(state.team)]
    count = lanes(x)
    start, rows = lines.first[g], lines.rows[g]
    part, stride, parts = lines.part[g], lines.stride[g], lines.parts[g]
    if rows > 1:
        one, other, over = turns_of_few(state.team, parts * part // count, len(lines.work))
        for q in range(one * count, other * count, over * count):
            at = start + q
            _solve(x, y, z, moves(state.rounding), m, force, at, lines.force[g, 1] + at, stride,
                   rows, 0, lines.rest_length[g, 1], load(lines.weft[g], q), work,
                   lines.axis[1], lines.tiny)
        wait(state.team)


@jit
def gather_rows(source, top, parts, part, stride, tile):
    """Transpose as many rows as there are lanes into ``tile``: column c becomes vector c."""
    count = lanes(source)
    for k in range(parts):
        for p in range(0, part, count):
            transpose(source, top + k * part + p, stride, tile, (parts * p + k) * count,
                      parts * count)


@jit
def scatter_rows(tile, target, top, parts, part, stride):
    """Transpose ``tile`` back into the rows of ``target``."""
    count = lanes(target)
    for k in range(parts):
        for p in range(0, part, count):
            transpose(tile, (parts * p + k) * count, parts * count, target,
                      top + k * part + p, stride)


def gather_errors(errors, top, parts, part, stride, tile):
    """Transpose as many rows of rounding errors as there are lanes; return ``tile``, or None."""


def scatter_errors(tile, errors, top, parts, part, stride):
    """Transpose ``tile`` back into the rounding errors, unless it is None."""


@inline(gather_errors)
def _gather_errors(errors, top, parts, part, stride, tile):
    if isinstance(errors, types.NoneType):
        return lambda errors, top, parts, part, stride, tile: None

    def gather(errors, top, parts, part, stride, tile):
        for k in range(3):
            gather_rows(errors[k], top, parts, part, stride, tile[k])
        return tile
    return gather


@inline(scatter_errors)
def _scatter_errors(tile, errors, top, parts, part, stride):
    if isinstance(errors, types.NoneType):
        return lambda tile, errors, top, parts, part, stride: None

    def scatter(tile, errors, top, parts, part, stride):
        for k in range(3):
            scatter_rows(tile[k], errors[k], top, parts, part, stride)
    return scatter


@jit(inline=True)
def edge_vector(x, y, z, axis):
    """
    Return the vector d of an edge, d·d, its length l, and l or 1.

    That of coincident particles is ``axis``, with d·d = 1 and l = 0.
    """
    square = fma(x, x, fma(y, y, z * z))
    apart, l = square > 0.0, root(square)
    return ((select(apart, x, axis[0]), select(apart, y, axis[1]), select(apart, z, axis[2])),
            select(apart, square, 1.0), l, select(apart, l, 1.0))


@jit
def _solve(x, y, z, errors, m, force, start, edge, stride, nodes, done, rest, alpha, work, axis,
           tiny):
    """
    Solve one line per lane, except in the first ``done`` lanes.

    Particle k of the lines is at start + k stride, and the multiplier of the edge from k to k + 1
    at edge + k stride.
    """
    n = lanes(x)
    long, ratio, step = work[0], work[1], work[2]
    zero, there = splat(x, 0.0), after(x, done)
    xa, ya, za, ma = load(x, start), load(y, start), load(z, start), load(m, start)
    vx, vy, vz, pivot, right = zero, zero, zero, zero, zero
    for k in range(nodes - 1):
        i, c, o = start + (k + 1) * stride, edge + k * stride, k * n
        xb, yb, zb, mb = load(x, i), load(y, i), load(z, i), load(m, i)
        f = load(force, c)
        (dx, dy, dz), square, l, l_or_1 = edge_vector(xb - xa, yb - ya, zb - za, axis)
        off = -ma * fma(dx, vx, fma(dy, vy, dz * vz))
        total = ma + mb
        link = off * pivot
        bottom = fma(-link, off, (total + larger(alpha, tiny * total)) * square)
        solvable = both(bottom > 0.0, there)
        pivot = 1.0 / select(solvable, bottom, 1.0)
        right = select(solvable, (-fma(alpha, f, l - rest) * l_or_1 - off * right) * pivot, 0.0)
        store(long, o, l_or_1)
        store(ratio, o, link)
        store(step, o, right)
        vx, vy, vz = dx, dy, dz
        xa, ya, za, ma = xb, yb, zb, mb
    # right is now s of the last edge; going back, s_k = right_k - (off_{k+1} pivot_k) s_{k+1}
    s, above, wx, wy, wz = zero, zero, zero, zero, zero
    for k in range(nodes - 2, -1, -1):
        i, c, o = start + (k + 1) * stride, edge + k * stride, k * n
        xb, yb, zb, mb = xa, ya, za, load(m, i)
        xa, ya, za = load(x, i - stride), load(y, i - stride), load(z, i - stride)
        (dx, dy, dz), _, _, _ = edge_vector(xb - xa, yb - ya, zb - za, axis)    # as before
        s = load(step, o) - above * s
        store(force, c, fma(s, load(long, o), load(force, c)))
        gx, gy, gz = s * dx, s * dy, s * dz
        store_moved(x, row(errors, 0), i, xb, mb, gx - wx)
        store_moved(y, row(errors, 1), i, yb, mb, gy - wy)
        store_moved(z, row(errors, 2), i, zb, mb, gz - wz)
        above = load(ratio, o)
        wx, wy, wz = gx, gy, gz
    mb = load(m, start)
    store_sum(x, row(errors, 0), start, xa, -(mb * wx))
    store_sum(y, row(errors, 1), start, ya, -(mb * wy))
    store_sum(z, row(errors, 2), start, za, -(mb * wz))
