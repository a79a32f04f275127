"""Curvature of three particles in a row and twist of four of a cell, axis by axis."""

from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.runs import PHASES, Shape, share_of
from xpbd_ros.sim.team import wait
from xpbd_ros.sim.update import divisor, keep, misfit, moves, put, recall, row
from xpbd_ros.sim.vector import both, first, fma, lanes, load, select


@jit
def straighten(bend, state, reverse):
    """Project C = x1 - 2 x2 + x3, run after run; the axes know nothing of one another."""
    for phase in range(PHASES):
        begin, end = share_of(bend.runs, state.team, phase, reverse)
        for k in range(3):
            _straighten(state.x[k], row(moves(state.apart), k), row(bend.force, k), state.mobility,
                        state.apart, bend.runs, bend.compliance, begin, end, reverse)
        wait(state.team)


@jit
def _straighten(x, to, force, mobility, apart, runs, compliance, begin, end, reverse):
    places = compliance.shape[1]
    for a in range(end - begin):
        r = end - 1 - a if reverse else begin + a
        numbers, base = runs.shape[r] * places + runs.place[r], runs.base[r]
        last = (runs.count[r] - 1) // lanes(x) * lanes(x)
        for b in range(runs.rows[r]):
            anchor = runs.start[r] + (runs.rows[r] - 1 - b if reverse else b) * runs.stride[r]
            for p in range(0, runs.count[r], lanes(x)):
                q = last - p if reverse else p
                c = anchor + q
                i1, i2, i3 = (c + runs.offset[r, 0], c + runs.offset[r, 1],
                              c + runs.offset[r, 2])
                x1, x2, x3 = load(x, i1), load(x, i2), load(x, i3)
                m1, m2, m3 = load(mobility, i1), load(mobility, i2), load(mobility, i3)
                alpha, f = load(compliance, numbers + q), recall(apart, force, base + c)
                total = fma(4.0, m2, m1 + m3)
                there = both(both(total > 0.0, alpha >= 0.0), first(x, runs.count[r] - q))
                df = select(there, -misfit(fma(-2.0, x2, x1 + x3), alpha, f)
                            / divisor(apart, total, alpha), 0.0)
                keep(force, base + c, f, df)
                put(x, to, i1, x1, m1, df)
                put(x, to, i2, x2, -2.0 * m2, df)
                put(x, to, i3, x3, m3, df)


@jit
def untwist(bend, state, reverse):
    """Project C = x00 - x01 - x10 + x11, run after run; the axes know nothing of one another."""
    for phase in range(PHASES):
        begin, end = share_of(bend.runs, state.team, phase, reverse)
        for k in range(3):
            _untwist(state.x[k], row(moves(state.apart), k), row(bend.force, k), state.mobility,
                     state.apart, bend.runs, bend.compliance, begin, end, reverse)
        wait(state.team)


@jit
def _untwist(x, to, force, mobility, apart, runs, compliance, begin, end, reverse):
    places = compliance.shape[1]
    for a in range(end - begin):
        r = end - 1 - a if reverse else begin + a
        numbers, base = runs.shape[r] * places + runs.place[r], runs.base[r]
        last = (runs.count[r] - 1) // lanes(x) * lanes(x)
        for b in range(runs.rows[r]):
            anchor = runs.start[r] + (runs.rows[r] - 1 - b if reverse else b) * runs.stride[r]
            for p in range(0, runs.count[r], lanes(x)):
                q = last - p if reverse else p
                c = anchor + q
                i0, i1 = c + runs.offset[r, 0], c + runs.offset[r, 1]
                i2, i3 = c + runs.offset[r, 2], c + runs.offset[r, 3]
                x0, x1, x2, x3 = load(x, i0), load(x, i1), load(x, i2), load(x, i3)
                m0, m1 = load(mobility, i0), load(mobility, i1)
                m2, m3 = load(mobility, i2), load(mobility, i3)
                alpha, f = load(compliance, numbers + q), recall(apart, force, base + c)
                total = (m0 + m1) + (m2 + m3)
                there = both(both(total > 0.0, alpha >= 0.0), first(x, runs.count[r] - q))
                df = select(there, -misfit((x0 - x1) - (x2 - x3), alpha, f)
                            / divisor(apart, total, alpha), 0.0)
                keep(force, base + c, f, df)
                put(x, to, i0, x0, m0, df)
                put(x, to, i1, x1, -m1, df)
                put(x, to, i2, x2, -m2, df)
                put(x, to, i3, x3, m3, df)


def curvature_shapes(rows: int, columns: int) -> list[Shape]:
    """Return three in a row (inside, at the rim), three in a column."""
    across = ((0, 0), (0, 1), (0, 2))
    inside, rim = (range(1, rows - 1), range(0, rows, rows - 1)) if rows > 1 else (
        range(1), range(0))
    return [Shape(across, inside, range(columns - 2), 0),
            Shape(across, rim, range(columns - 2), 0),
            Shape(((0, 0), (1, 0), (2, 0)), range(rows - 2), range(columns), 1)]


def twist_shapes(rows: int, columns: int) -> list[Shape]:
    """Return the cells."""
    return [Shape(((0, 0), (0, 1), (1, 0), (1, 1)), range(rows - 1), range(columns - 1), 0)]
