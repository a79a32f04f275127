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

from dataclasses import dataclass
from math import inf
from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, load, select
from xpbd_ros.sim.backend.simd_vector3 import vector3
from xpbd_ros.sim.constraints.builders import Rows
from xpbd_ros.sim.constraints.damping import apart_before, damped, Damping, gamma_of, lag
from xpbd_ros.sim.constraints.definitions import Constraints
from xpbd_ros.sim.constraints.distance import AXES, damping, Edges
from xpbd_ros.sim.constraints.grid_batches import listed, Runs, Shape
from xpbd_ros.sim.constraints.pinned import Stops, stops_for
from xpbd_ros.sim.constraints.pinned_edges import room
from xpbd_ros.sim.constraints.projection import denominator, keep, recall, xpbd_residual
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.particles.memory_layout import Block


class Slant(NamedTuple):
    """Shear constraints of cells, in runs (``constraints.grid_batches``)."""

    runs: Runs
    compliance: np.ndarray
    """[m/N], by grid and place in a row, ABSENT where there is no cell, shape (grids, places)"""
    force: np.ndarray | None
    """f, multiplier over H² [N], shape (families * slots,); None if multipliers are not kept"""
    stops: Stops | None
    """cells at pinned particles; None in a scene without pins"""
    axis: np.ndarray
    """direction of coincident ends, of each diagonal, shape (2, 3)"""
    damping: Damping | None
    """None in a scene without ``rayleigh``"""
    rate: float
    """of all shear, as ``Built.rate``"""


@dataclass(eq=False)
class Slants(Constraints):
    """
    Cells one by one: the definition in NumPy.

    An edge is a cell whose second diagonal has the weight 0: C = |x0 - x1| - L.
    """

    rest_length: np.ndarray
    """L [m], shape (cells,)"""
    weight: np.ndarray
    """of the second diagonal, shape (cells,)"""

    @classmethod
    def of(cls, batch: Slant) -> 'Slants':
        """Return the cells of a batch."""
        particles, index, shape, place = listed(batch.runs)
        return Slants(particles, index, batch.compliance[shape, place].astype(float),
                      np.zeros(len(index)), np.ones(len(index)))

    @classmethod
    def joined(cls, lists: list[Any]) -> Any:
        """Return the constraints of several batches; ``index`` refers to each one's own batch."""
        if all(isinstance(these, Edges) for these in lists):
            return Edges.joined(lists)
        return super().joined([
            Slants(these.particles[:, [0, 1, 0, 1]], these.index, these.compliance,
                   these.rest_length, np.zeros(len(these.index)))
            if isinstance(these, Edges) else these for these in lists])

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


def cells(rows: int, columns: int) -> list[Shape]:
    """Return the shape of a grid's cells: ends of the rising, then of the falling diagonal."""
    return [Shape(((0, 0), (1, 1), (0, 1), (1, 0)), range(rows - 1), range(columns - 1), 0)]


def slants(blocks: list[Block], compliance: list, *, world, time: list | None) -> Slant:
    """
    Return the shear constraints of grids for the kernels.

    Parameters
    ----------
    blocks : slots of each grid
    compliance : of each grid [m/N], shape (1, 1)
    world : build context
    time : relaxation time of each grid [s], shape (grids,); None without ``rayleigh``

    """
    dtype, rows = world.state.x.dtype, Rows(blocks, cells, world)
    return Slant(**rows.common(compliance, stops=lambda runs: stops_for(runs, room)),
                 axis=np.array(AXES[:2], dtype),
                 damping=damping(world, time, np.zeros(len(blocks), bool), dtype), rate=inf)


@jit(inline=True)
def solve_slants(slant, apart, at, x, m):
    """Solve a vector of cells."""
    alpha, f, gamma = (load(slant.compliance, at.number), recall(apart, slant.force, at.c),
                       gamma_of(slant.damping, at.shape))
    d, e, axis, slots = x[0] - x[1], x[2] - x[3], slant.axis, at.slots
    l, g = length(d), length(e)
    long, wide = l > 0.0, g > 0.0
    l_or_1, g_or_1 = select(long, l, 1.0), select(wide, g, 1.0)
    total = (m[0] + m[1]) + (m[2] + m[3])
    there = both(both(total > 0.0, alpha >= 0.0), at.there)
    # γ ∇C·(x - x̄) has a term for each diagonal, the second with the opposite sign
    wrong = lag(xpbd_residual(l - g, alpha, f), gamma,
                apart_before(slant.damping, slots[0], slots[1]), d, l_or_1)
    wrong = -lag(-wrong, gamma, apart_before(slant.damping, slots[2], slots[3]), e, g_or_1)
    df = select(there, -(wrong / denominator(apart, damped(total, gamma), alpha)), 0.0)
    keep(slant.force, at.c, f, df)
    s, t = df / l_or_1, df / g_or_1
    d = vector3(select(long, d.x, axis[0, 0]), select(long, d.y, axis[0, 1]),
                select(long, d.z, axis[0, 2]))
    e = vector3(select(wide, e.x, axis[1, 0]), select(wide, e.y, axis[1, 1]),
                select(wide, e.z, axis[1, 2]))
    return (s, d), (-s, d), (-t, e), (t, e)


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
