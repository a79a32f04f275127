"""
Distance constraints: C = |x1 - x2| - L, the physics of every effect that is an elastic edge.

Gradient: n = (x1 - x2) / |x1 - x2| at x1, -n at x2 (Müller et al. 2006, eq 10-11). In force form,
with f = λ / H² [N], mobilities m = w H² and W = m1 + m2,

    Δf = -(C + α f) / (W + α),   x1 += m1 n Δf,   x2 -= m2 n Δf

which is Macklin et al. 2016, eq 18 and 17, times H². α is in m/N; 0 is rigid. f < 0 is tension.
Where two particles coincide the gradient is undefined: they part along an axis that each shape of
edge has for itself, which keeps momentum and is the same in every run.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.layout import zeros
from xpbd_ros.sim.mesh import length
from xpbd_ros.sim.runs import listed, Runs
from xpbd_ros.sim.vector import both, first, fma, lanes, load, root, select, store

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Held(NamedTuple):
    """The edges at pinned particles, whose forces somebody asks for."""

    count: np.ndarray
    """shape (1,)"""
    particles: np.ndarray
    """slots, shape (room, 2)"""
    index: np.ndarray
    """where each keeps its force, shape (room,)"""


class Distance(NamedTuple):
    """Elastic edges in runs; each family keeps its numbers by anchor."""

    runs: Runs
    rest_length: np.ndarray
    """[m], shape (families * slots,)"""
    compliance: np.ndarray
    """[m/N], shape (families * slots,)"""
    force: np.ndarray
    """f, multiplier over H² [N], negative in tension; shape (families * slots,)"""
    axis: np.ndarray
    """where two particles coincide, by shape; shape (shapes, 3)"""
    held: Held | None
    """None in a scene without pins"""


class Edges:
    """The same edges one by one, in sweep order, as people and NumPy want them."""

    def __init__(self, batch: Distance):
        self.particles, self.index, _ = listed(batch.runs)
        self.rest_length = batch.rest_length[self.index].astype(float)
        self.compliance = batch.compliance[self.index].astype(float)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C [m], shape (edges,), straight from the definition; x has shape (3, slots)."""
        i, j = self.particles.T
        return length((x[:, i] - x[:, j]).T.astype(float)) - self.rest_length

    def energy(self, x: np.ndarray) -> float:
        """Return Σ C² / (2 α) [J]; a rigid edge stores none."""
        elastic = self.compliance > 0.0
        return float((0.5 * self.residual(x)[elastic]**2 / self.compliance[elastic]).sum())


def softest(dtype) -> float:
    """Return the largest compliance: finite, so that times no force it is nothing."""
    return float(np.sqrt(np.finfo(dtype).max))


def distance_batch(runs: Runs, rest_length: np.ndarray, compliance: np.ndarray, *, pins: bool,
                   dtype) -> Distance:
    """
    Return edges ready for the kernels.

    Parameters
    ----------
    runs : where they are
    rest_length : by anchor [m], shape (families, slots)
    compliance : by anchor [m/N], shape (families, slots)
    pins : whether forces on pinned particles will be asked for
    dtype : of all numbers

    """
    families = len(rest_length)
    held = None
    if pins:
        count = len(listed(runs)[1])
        held = Held(np.zeros(1, np.int64), np.zeros((count, 2), np.int64),
                    np.zeros(count, np.int64))
    numbers = [zeros(np.size(rest_length), dtype) for _ in range(3)]
    numbers[0][:] = np.ravel(rest_length)
    numbers[1][:] = np.minimum(np.ravel(compliance), softest(dtype))
    return Distance(runs, *numbers,
                    np.array([AXES[k % 3] for k in range(families)], dtype).reshape(-1, 3), held)


def hold(held: Held, edges: Edges, inv_mass: np.ndarray) -> None:
    """List the edges that touch a pinned particle."""
    found = (inv_mass[edges.particles] == 0.0).any(1)
    held.count[0] = found.sum()
    held.particles[:held.count[0]] = edges.particles[found]
    held.index[:held.count[0]] = edges.index[found]


@jit
def release_forces(edges):
    """Zero the multipliers: once per substep, never per iteration (algorithm 1, line 4)."""
    edges.force[:] = 0.0


@jit
def project_edges(edges, state, reverse):
    """One Gauss-Seidel pass over all edges, run after run."""
    x, y, z = state.x[0], state.x[1], state.x[2]
    _project(x, y, z, state.mobility, edges.runs, edges.rest_length, edges.compliance,
             edges.force, edges.axis, reverse)


@jit
def _project(x, y, z, mobility, runs, rest_length, compliance, force, axis, reverse):
    runs_count = len(runs.start)
    for a in range(runs_count):
        r = runs_count - 1 - a if reverse else a
        to_i, to_j, base = runs.offset[r, 0], runs.offset[r, 1], runs.base[r]
        ux, uy, uz = axis[runs.shape[r], 0], axis[runs.shape[r], 1], axis[runs.shape[r], 2]
        for b in range(runs.rows[r]):
            row = runs.rows[r] - 1 - b if reverse else b
            anchor = runs.start[r] + row * runs.stride[r]
            for q in range(0, runs.count[r], lanes(x)):
                i, j, c = anchor + to_i + q, anchor + to_j + q, base + anchor + q
                xi, yi, zi, mi = load(x, i), load(y, i), load(z, i), load(mobility, i)
                xj, yj, zj, mj = load(x, j), load(y, j), load(z, j), load(mobility, j)
                alpha, f = load(compliance, c), load(force, c)
                dx, dy, dz, total = xi - xj, yi - yj, zi - zj, mi + mj
                l = root(fma(dx, dx, fma(dy, dy, dz * dz)))
                apart = l > 0.0
                l_or_1 = select(apart, l, 1.0)
                moves = both(total > 0.0, first(x, runs.count[r] - q))
                g = select(moves, -(fma(alpha, f, l - load(rest_length, c)))
                           / (l_or_1 * (total + alpha)), 0.0)
                dx, dy, dz = select(apart, dx, ux), select(apart, dy, uy), select(apart, dz, uz)
                store(force, c, fma(g, l_or_1, f))
                gi, gj = g * mi, -g * mj
                store(x, i, fma(gi, dx, xi))
                store(y, i, fma(gi, dy, yi))
                store(z, i, fma(gi, dz, zi))
                store(x, j, fma(gj, dx, xj))
                store(y, j, fma(gj, dy, yj))
                store(z, j, fma(gj, dz, zj))


@jit
def react_edges(edges, state, substep):
    """Force on a pinned particle: f n; an edge between two pinned ones pulls with -C / α."""
    weight, held, x = substep.end - substep.begin, edges.held, state.x
    for k in range(held.count[0]):
        i, j, c = held.particles[k, 0], held.particles[k, 1], held.index[k]
        dx, dy, dz = x[0, i] - x[0, j], x[1, i] - x[1, j], x[2, i] - x[2, j]
        l = np.sqrt(dx * dx + dy * dy + dz * dz)
        if l == 0.0:
            continue
        f = edges.force[c]
        if state.inv_mass[i] + state.inv_mass[j] == 0.0 and edges.compliance[c] > 0.0:
            f = -(l - edges.rest_length[c]) / edges.compliance[c]
        f *= weight / l
        for a, d in enumerate((dx, dy, dz)):
            state.reaction[a, i] += f * d
            state.reaction[a, j] -= f * d
