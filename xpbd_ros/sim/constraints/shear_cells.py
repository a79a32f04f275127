"""
Shear of rectangular grid cells: C is the difference of the diagonals' lengths.

For a cell with the corners x0, x1 on one diagonal and x2, x3 on the other,

    C = |x0 - x1| - |x2 - x3|,   n = (x0 - x1) / |x0 - x1|,   o = (x2 - x3) / |x2 - x3|
    g0 = n,  g1 = -n,  g2 = -o,  g3 = o

At rest C = 0. A stretch of warp or weft changes both diagonals equally, so C does not resist it; a
shear γ of a cell dx × dy with diagonals of length l gives C = 2 γ dx dy / l. In force form, with
mobilities m = w H² and W = m0 + m1 + m2 + m3,

    Δf = -(C + α f) / (W + α),   x_i += m_i g_i Δf

The four particles are distinct, so W has no mixed terms. Coincident ends of a diagonal separate
along a fixed axis, as those of edges do (``constraints.distance``).
"""

from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, first, fma, lanes, load, root, select
from xpbd_ros.sim.backend.threads import wait
from xpbd_ros.sim.constraints.damping import apart_before, Damping, gamma_of, lag, shared
from xpbd_ros.sim.constraints.distance import (
    AXES,
    by_place,
    damping,
    Edges,
    stops_between,
    stops_of,
)
from xpbd_ros.sim.constraints.grid_batches import listed, PHASES, Runs, Shape, share_of
from xpbd_ros.sim.constraints.pinned import room_for
from xpbd_ros.sim.constraints.pinned_edges import Stops
from xpbd_ros.sim.constraints.projection import (
    at_the_end,
    denominator,
    keep,
    moves,
    put,
    recall,
    row,
    xpbd_residual,
)
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.particles.memory_layout import zeros


class Held(NamedTuple):
    """List of cells at pinned particles."""

    count: np.ndarray
    """length of the list, shape (1,)"""
    particles: np.ndarray
    """slots, shape (capacity, 4)"""
    index: np.ndarray
    """position of each multiplier in ``force``, shape (capacity,)"""
    compliance: np.ndarray
    """[m/N], shape (capacity,)"""


class Slant(NamedTuple):
    """Shear constraints of cells, in runs (``constraints.grid_batches``)."""

    runs: Runs
    compliance: np.ndarray
    """[m/N], by grid and place in a row, ABSENT where there is no cell, shape (grids, places)"""
    axis: np.ndarray
    """direction of coincident ends, of each diagonal, shape (2, 3)"""
    force: np.ndarray | None
    """f, multiplier over H² [N], shape (families * slots,); None if multipliers are not kept"""
    stops: Stops | None
    """cells at pinned particles, with directions (n, o); None in a scene without pins"""
    damping: Damping | None = None
    """None in a scene without ``rayleigh``"""


class Slants:
    """
    Cells as NumPy arrays, in sweep order: the reference definition of C, energy and stiffness.

    An edge is a cell whose second diagonal has the weight 0: C = |x0 - x1| - L.

    Parameters
    ----------
    particles : slots, both ends of either diagonal, shape (cells, 4)
    index : position of each multiplier in ``force``, shape (cells,)
    compliance : [m/N], shape (cells,)
    rest_length : L [m], shape (cells,); None: 0
    weight : of the second diagonal, shape (cells,); None: 1

    """

    def __init__(self, particles, index, compliance, rest_length=None, weight=None):
        self.particles = particles
        self.index = index
        self.compliance = compliance.astype(float)
        self.rest_length = np.zeros(len(index)) if rest_length is None else rest_length
        self.weight = np.ones(len(index)) if weight is None else weight

    @staticmethod
    def of(batch: Slant) -> 'Slants':
        """Return the cells of a batch."""
        particles, index, shape, place = listed(batch.runs)
        return Slants(particles, index, batch.compliance[shape, place])

    @staticmethod
    def joined(lists: list[Any]) -> 'Slants | Edges':
        """Return the constraints of several batches; ``index`` refers to each one's own batch."""
        if all(isinstance(these, Edges) for these in lists):
            return Edges.joined(lists)
        wide = [Slants(these.particles[:, [0, 1, 0, 1]], these.index, these.compliance,
                       these.rest_length, np.zeros(len(these.index)))
                if isinstance(these, Edges) else these for these in lists]
        return Slants(*(np.concatenate([getattr(these, name) for these in wide]) for name in (
            'particles', 'index', 'compliance', 'rest_length', 'weight')))

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C [m], shape (cells,), by its definition; x: positions [m], (3, slots)."""
        x0, x1, x2, x3 = (x[:, self.particles[:, k]].T.astype(float) for k in range(4))
        return length(x0 - x1) - self.weight * length(x2 - x3) - self.rest_length

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """Return ∂C/∂x, shape (cells, 4, 3); 0 where a diagonal has length 0."""
        x0, x1, x2, x3 = (x[:, self.particles[:, k]].T.astype(float) for k in range(4))
        n, o = (np.divide(d, length(d)[:, None], out=np.zeros_like(d),
                          where=length(d)[:, None] > 0.0) for d in (x0 - x1, x2 - x3))
        o *= self.weight[:, None]
        return np.stack([n, -n, -o, o], 1)

    def energy(self, x: np.ndarray) -> float:
        """Return Σ C² / (2 α) [J]."""
        return float((0.5 * self.residual(x)**2 / self.compliance).sum())

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """
        Return Σ |g_i| Σ |g_j| / α at each particle, an upper bound of the stiffness K [N/m].

        Shape (slots, 3, 3).
        """
        found = np.zeros(x.shape[1])
        with np.errstate(divide='ignore'):
            stiffness = (2.0 + 2.0 * self.weight) / self.compliance
        for pair, weight in ((self.particles[:, :2], np.ones(len(self.weight))),
                             (self.particles[:, 2:], self.weight)):
            np.add.at(found, pair, (weight * stiffness)[:, None])
        return found[:, None, None] * np.eye(3)


def slant_shape(rows: int, columns: int) -> Shape:
    """Return the shape of a grid's cells: ends of the rising, then of the falling diagonal."""
    return Shape(((0, 0), (1, 1), (0, 1), (1, 0)), range(rows - 1), range(columns - 1), 0)


def slants(runs: Runs, compliance: list, *, world, time=None) -> Slant:
    """
    Return the shear constraints of grids for the kernels.

    Parameters
    ----------
    runs : runs of all grids, one family each
    compliance : of each grid [m/N], shape (1, 1)
    world : build context
    time : relaxation time of each grid [s], shape (grids,); None without ``rayleigh``

    """
    dtype, count = world.state.x.dtype, len(listed(runs)[1])
    room = Stops(Held(*room_for(count, 4), np.zeros(count)),
                 np.zeros(len(runs.start) + 1, np.int64), np.zeros((count, 6)),
                 np.zeros(count)) if world.pins else None
    return Slant(runs, by_place(runs, compliance, dtype), np.array(AXES[:2], dtype),
                 zeros(len(compliance) * world.slots, dtype) if world.forces else None, room,
                 damping(world, time, np.zeros(len(compliance), bool), dtype))


@jit
def _note(stops, first_, last, x, y, z, apart, force):
    """Record n, o and the multipliers of the listed cells first_:last."""
    if stops is not None:
        for k in range(first_, last):
            i0, i1, i2, i3 = stops.held.particles[k]
            for a, i, j in ((0, i0, i1), (3, i2, i3)):
                dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
                l = np.sqrt(dx * dx + dy * dy + dz * dz)
                per = 1.0 / l if l > 0.0 else 0.0
                stops.direction[k, a] = per * dx
                stops.direction[k, a + 1] = per * dy
                stops.direction[k, a + 2] = per * dz
            stops.before[k] = force[stops.held.index[k]] if at_the_end(apart) else 0.0


@jit
def _gather_reaction(stops, first_, last, mobility, force, part, reaction):
    """
    Add the forces g Δf that the listed cells first_:last exerted since ``_note``.

    ``part`` is the substep's fraction of the frame. Cells of four immobile particles are treated
    by ``react_slants``.
    """
    if stops is not None:
        for k in range(first_, last):
            i0, i1, i2, i3 = stops.held.particles[k]
            if mobility[i0] + mobility[i1] + mobility[i2] + mobility[i3] > 0.0:
                df = part * (force[stops.held.index[k]] - stops.before[k])
                for a in range(3):
                    n, o = df * stops.direction[k, a], df * stops.direction[k, a + 3]
                    reaction[a, i0] += n
                    reaction[a, i1] -= n
                    reaction[a, i2] -= o
                    reaction[a, i3] += o


@jit
def project_slants(slant, state, substep, reverse):
    """Project all cells once, run by run, in reverse order if ``reverse``."""
    part = substep.end - substep.begin
    for phase in range(PHASES):
        begin, end = share_of(slant.runs, state.team, phase, reverse)
        _project(state.x[0], state.x[1], state.x[2], state.mobility, state.apart,
                 row(moves(state.apart), 0), row(moves(state.apart), 1),
                 row(moves(state.apart), 2), slant.runs, slant.compliance, slant.force,
                 slant.axis, slant.damping, slant.stops, part, state.reaction, begin, end,
                 reverse)
        wait(state.team)


@jit
def _project(x, y, z, mobility, apart, tx, ty, tz, runs, compliance, force, axis, damping, stops,
             part, reaction, begin, end, reverse):
    places = compliance.shape[1]
    for a in range(end - begin):
        r = end - 1 - a if reverse else begin + a
        gamma = gamma_of(damping, runs.shape[r])
        numbers, base = runs.shape[r] * places + runs.place[r], runs.base[r]
        to0, to1 = runs.offset[r, 0], runs.offset[r, 1]
        to2, to3 = runs.offset[r, 2], runs.offset[r, 3]
        last = (runs.count[r] - 1) // lanes(x) * lanes(x)
        next_, past = stops_of(stops, r)
        for b in range(runs.rows[r]):
            anchor = runs.start[r] + (runs.rows[r] - 1 - b if reverse else b) * runs.stride[r]
            for p in range(0, runs.count[r], lanes(x)):
                q = last - p if reverse else p
                c = anchor + q
                i0, i1, i2, i3 = c + to0, c + to1, c + to2, c + to3
                stop, on = next_, next_
                if next_ < past:
                    stop, on = stops_between(stops, next_, past, base + c, base + c + lanes(x),
                                             reverse)
                    _note(stops, stop, on, x, y, z, apart, force)
                m0, m1 = load(mobility, i0), load(mobility, i1)
                m2, m3 = load(mobility, i2), load(mobility, i3)
                x0, y0, z0 = load(x, i0), load(y, i0), load(z, i0)
                x1, y1, z1 = load(x, i1), load(y, i1), load(z, i1)
                x2, y2, z2 = load(x, i2), load(y, i2), load(z, i2)
                x3, y3, z3 = load(x, i3), load(y, i3), load(z, i3)
                dx, dy, dz, ex, ey, ez = x0 - x1, y0 - y1, z0 - z1, x2 - x3, y2 - y3, z2 - z3
                l = root(fma(dx, dx, fma(dy, dy, dz * dz)))
                g = root(fma(ex, ex, fma(ey, ey, ez * ez)))
                long, wide = l > 0.0, g > 0.0
                l_or_1, g_or_1 = select(long, l, 1.0), select(wide, g, 1.0)
                alpha, f = load(compliance, numbers + q), recall(apart, force, base + c)
                total = (m0 + m1) + (m2 + m3)
                there = both(both(total > 0.0, alpha >= 0.0), first(x, runs.count[r] - q))
                # γ ∇C·(x - x̄) has a term for each diagonal, the second with the opposite sign
                wrong = lag(xpbd_residual(l - g, alpha, f), gamma,
                            apart_before(damping, i0, i1), dx, dy, dz, l_or_1)
                wrong = -lag(-wrong, gamma, apart_before(damping, i2, i3), ex, ey, ez, g_or_1)
                df = select(there, -(wrong / denominator(apart, shared(total, gamma), alpha)), 0.0)
                keep(force, base + c, f, df)
                s, t = df / l_or_1, df / g_or_1
                dx, dy, dz = (select(long, dx, axis[0, 0]), select(long, dy, axis[0, 1]),
                              select(long, dz, axis[0, 2]))
                ex, ey, ez = (select(wide, ex, axis[1, 0]), select(wide, ey, axis[1, 1]),
                              select(wide, ez, axis[1, 2]))
                s0, s1, s2, s3 = m0 * s, -(m1 * s), -(m2 * t), m3 * t
                put(x, tx, i0, x0, s0, dx)
                put(y, ty, i0, y0, s0, dy)
                put(z, tz, i0, z0, s0, dz)
                put(x, tx, i1, x1, s1, dx)
                put(y, ty, i1, y1, s1, dy)
                put(z, tz, i1, z1, s1, dz)
                put(x, tx, i2, x2, s2, ex)
                put(y, ty, i2, y2, s2, ey)
                put(z, tz, i2, z2, s2, ez)
                put(x, tx, i3, x3, s3, ex)
                put(y, ty, i3, y3, s3, ey)
                put(z, tz, i3, z3, s3, ez)
                if stop < on:
                    _gather_reaction(stops, stop, on, mobility, force, part, reaction)
                    next_, past = (next_, stop) if reverse else (on, past)


@jit
def react_slants(slant, state, substep):
    """Add the forces of cells whose four particles are immobile: f = -C / α."""
    part, held, x, m = substep.end - substep.begin, slant.stops.held, state.x, state.mobility
    for k in range(held.count[0]):
        i0, i1, i2, i3 = held.particles[k]
        if m[i0] + m[i1] + m[i2] + m[i3] > 0.0:
            continue
        l, g = 0.0, 0.0
        for a in range(3):
            l += (x[a, i0] - x[a, i1])**2
            g += (x[a, i2] - x[a, i3])**2
        l, g = np.sqrt(l), np.sqrt(g)
        f = -(l - g) / held.compliance[k]
        for a in range(3):
            if l > 0.0:
                n = part * f * (x[a, i0] - x[a, i1]) / l
                state.reaction[a, i0] += n
                state.reaction[a, i1] -= n
            if g > 0.0:
                o = part * f * (x[a, i2] - x[a, i3]) / g
                state.reaction[a, i2] -= o
                state.reaction[a, i3] += o
