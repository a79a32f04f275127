"""Projection of curvature (three particles in a line) and twist (a cell) with constant weights."""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, first, fma, lanes, load, select
from xpbd_ros.sim.backend.threads import wait
from xpbd_ros.sim.constraints.grid_batches import PHASES, Shape, share_of
from xpbd_ros.sim.constraints.projection import (
    denominator,
    keep,
    moves,
    put,
    recall,
    row,
    xpbd_residual,
)


@jit
def straighten(bend, state, reverse):
    """Project C = x1 - 2 x2 + x3 of all lines of three, run by run (formulas in ``bend``)."""
    for phase in range(PHASES):
        begin, end = share_of(bend.runs, state.team, phase, reverse)
        _straighten(state.x[0], state.x[1], state.x[2], row(moves(state.apart), 0),
                    row(moves(state.apart), 1), row(moves(state.apart), 2), row(bend.force, 0),
                    row(bend.force, 1), row(bend.force, 2), state.mobility, state.apart, bend.runs,
                    bend.compliance, begin, end, reverse)
        wait(state.team)


@jit
def _straighten(x, y, z, tx, ty, tz, fx, fy, fz, mobility, apart, runs, compliance, begin, end,
                reverse):
    places = compliance.shape[1]
    for a in range(end - begin):
        r = end - 1 - a if reverse else begin + a
        numbers, base = runs.shape[r] * places + runs.place[r], runs.base[r]
        to1, to2, to3 = runs.offset[r, 0], runs.offset[r, 1], runs.offset[r, 2]
        last = (runs.count[r] - 1) // lanes(x) * lanes(x)
        for b in range(runs.rows[r]):
            anchor = runs.start[r] + (runs.rows[r] - 1 - b if reverse else b) * runs.stride[r]
            for p in range(0, runs.count[r], lanes(x)):
                q = last - p if reverse else p
                c = anchor + q
                i1, i2, i3 = c + to1, c + to2, c + to3
                m1, m2, m3 = load(mobility, i1), load(mobility, i2), load(mobility, i3)
                x1, x2, x3 = load(x, i1), load(x, i2), load(x, i3)
                y1, y2, y3 = load(y, i1), load(y, i2), load(y, i3)
                z1, z2, z3 = load(z, i1), load(z, i2), load(z, i3)
                alpha = load(compliance, numbers + q)
                f, g, h = (recall(apart, fx, base + c), recall(apart, fy, base + c),
                           recall(apart, fz, base + c))
                total = fma(4.0, m2, m1 + m3)
                there = both(both(total > 0.0, alpha >= 0.0), first(x, runs.count[r] - q))
                per = select(there, -1.0 / denominator(apart, total, alpha), 0.0)
                dx = per * xpbd_residual(fma(-2.0, x2, x1 + x3), alpha, f)
                dy = per * xpbd_residual(fma(-2.0, y2, y1 + y3), alpha, g)
                dz = per * xpbd_residual(fma(-2.0, z2, z1 + z3), alpha, h)
                keep(fx, base + c, f, dx)
                keep(fy, base + c, g, dy)
                keep(fz, base + c, h, dz)
                n2 = -2.0 * m2
                put(x, tx, i1, x1, m1, dx)
                put(y, ty, i1, y1, m1, dy)
                put(z, tz, i1, z1, m1, dz)
                put(x, tx, i2, x2, n2, dx)
                put(y, ty, i2, y2, n2, dy)
                put(z, tz, i2, z2, n2, dz)
                put(x, tx, i3, x3, m3, dx)
                put(y, ty, i3, y3, m3, dy)
                put(z, tz, i3, z3, m3, dz)


@jit
def untwist(bend, state, reverse):
    """Project C = x00 - x01 - x10 + x11 of all cells, run by run (formulas in ``bend``)."""
    for phase in range(PHASES):
        begin, end = share_of(bend.runs, state.team, phase, reverse)
        _untwist(state.x[0], state.x[1], state.x[2], row(moves(state.apart), 0),
                 row(moves(state.apart), 1), row(moves(state.apart), 2), row(bend.force, 0),
                 row(bend.force, 1), row(bend.force, 2), state.mobility, state.apart, bend.runs,
                 bend.compliance, begin, end, reverse)
        wait(state.team)


@jit
def _untwist(x, y, z, tx, ty, tz, fx, fy, fz, mobility, apart, runs, compliance, begin, end,
             reverse):
    places = compliance.shape[1]
    for a in range(end - begin):
        r = end - 1 - a if reverse else begin + a
        numbers, base = runs.shape[r] * places + runs.place[r], runs.base[r]
        to0, to1 = runs.offset[r, 0], runs.offset[r, 1]
        to2, to3 = runs.offset[r, 2], runs.offset[r, 3]
        last = (runs.count[r] - 1) // lanes(x) * lanes(x)
        for b in range(runs.rows[r]):
            anchor = runs.start[r] + (runs.rows[r] - 1 - b if reverse else b) * runs.stride[r]
            for p in range(0, runs.count[r], lanes(x)):
                q = last - p if reverse else p
                c = anchor + q
                i0, i1, i2, i3 = c + to0, c + to1, c + to2, c + to3
                m0, m1 = load(mobility, i0), load(mobility, i1)
                m2, m3 = load(mobility, i2), load(mobility, i3)
                x0, x1, x2, x3 = load(x, i0), load(x, i1), load(x, i2), load(x, i3)
                y0, y1, y2, y3 = load(y, i0), load(y, i1), load(y, i2), load(y, i3)
                z0, z1, z2, z3 = load(z, i0), load(z, i1), load(z, i2), load(z, i3)
                alpha = load(compliance, numbers + q)
                f, g, h = (recall(apart, fx, base + c), recall(apart, fy, base + c),
                           recall(apart, fz, base + c))
                total = (m0 + m1) + (m2 + m3)
                there = both(both(total > 0.0, alpha >= 0.0), first(x, runs.count[r] - q))
                per = select(there, -1.0 / denominator(apart, total, alpha), 0.0)
                dx = per * xpbd_residual((x0 - x1) - (x2 - x3), alpha, f)
                dy = per * xpbd_residual((y0 - y1) - (y2 - y3), alpha, g)
                dz = per * xpbd_residual((z0 - z1) - (z2 - z3), alpha, h)
                keep(fx, base + c, f, dx)
                keep(fy, base + c, g, dy)
                keep(fz, base + c, h, dz)
                put(x, tx, i0, x0, m0, dx)
                put(y, ty, i0, y0, m0, dy)
                put(z, tz, i0, z0, m0, dz)
                put(x, tx, i1, x1, -m1, dx)
                put(y, ty, i1, y1, -m1, dy)
                put(z, tz, i1, z1, -m1, dz)
                put(x, tx, i2, x2, -m2, dx)
                put(y, ty, i2, y2, -m2, dy)
                put(z, tz, i2, z2, -m2, dz)
                put(x, tx, i3, x3, m3, dx)
                put(y, ty, i3, y3, m3, dy)
                put(z, tz, i3, z3, m3, dz)


def curvature_shapes(rows: int, columns: int) -> list[Shape]:
    """Return the shapes of three in a row, in interior and boundary rows, and in a column."""
    across = ((0, 0), (0, 1), (0, 2))
    inside, rim = (range(1, rows - 1), range(0, rows, rows - 1)) if rows > 1 else (
        range(1), range(0))
    return [Shape(across, inside, range(columns - 2), 0),
            Shape(across, rim, range(columns - 2), 0),
            Shape(((0, 0), (1, 0), (2, 0)), range(rows - 2), range(columns), 1)]


def twist_shapes(rows: int, columns: int) -> list[Shape]:
    """Return the shape of the four particles of a cell."""
    return [Shape(((0, 0), (0, 1), (1, 0), (1, 1)), range(rows - 1), range(columns - 1), 0)]
