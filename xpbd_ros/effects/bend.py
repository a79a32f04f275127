"""
Bend: isometric bending of each hinge as one linear vector constraint.

For the hinge (x0, x1) with opposite particles x2, x3 and rest areas A0, A1,

    C = Σ K_i x_i / sqrt(A0 + A1)  in R³,   K = (c03+c04, c01+c02, -c01-c03, -c02-c04),

with c01 = cot(e, x2-x0), c02 = cot(e, x3-x0), c03 = cot(-e, x2-x1), c04 = cot(-e, x3-x1) at rest
(Bergou et al. 2006; K x = 2 |e| sin(θ/2) for a hinge of dihedral angle θ). The energy is
B |C|² / 2, so α = 1 / B [1/(N m)]. The gradient is constant: no singularity, no wrap at 180°. In
force form, with mobilities m = w H², W = Σ m_i K_i² / (A0 + A1) and a 3-vector f = λ / H²,

    Δf = -(C + α f) / (W + α),   x_i += m_i K_i Δf / sqrt(A0 + A1).

The diagonals of a grid count half, which makes the sheet's bending stiffness the same about both
axes (NUMERICS 2.5).

Limits: a flat rest shape, deformations that keep lengths.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.distance import softest
from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.layout import zeros
from xpbd_ros.sim.mesh import cross, dot, length
from xpbd_ros.sim.runs import grid_runs, join, listed, Runs, Shape
from xpbd_ros.sim.stages import prepare, project, project_back, react, stage
from xpbd_ros.sim.vector import both, first, fma, lanes, load, select, store


@dataclass(frozen=True)
class Parameters:
    """The bending rigidity."""

    stiffness: float = quantity(unit='N m', above=0.0, live=True, doc='bending rigidity B')


class Held(NamedTuple):
    """The hinges at pinned particles, whose forces somebody asks for."""

    count: np.ndarray
    """shape (1,)"""
    particles: np.ndarray
    """slots, shape (room, 4)"""
    index: np.ndarray
    """where each keeps its force, shape (room,)"""
    shape: np.ndarray
    """number of its shape, shape (room,)"""


class Bend(NamedTuple):
    """Hinges in runs; edge start, edge end, opposite, opposite."""

    runs: Runs
    weight: np.ndarray
    """K_i / sqrt(A0 + A1) [1/m], by shape; shape (shapes, 4)"""
    compliance: np.ndarray
    """1 / B [1/(N m)], by shape; shape (shapes,)"""
    force: np.ndarray
    """f, multiplier over H² [N m], shape (3, families * slots)"""
    held: Held | None
    """None in a scene without pins"""


@stage(prepare, Bend)
@jit
def prepare_bend(bend, state, substep):
    """Zero the multipliers."""
    bend.force[:] = 0.0


@stage(project, Bend)
@jit
def project_bend(bend, state, substep):
    """One Gauss-Seidel pass over all hinges, run after run."""
    for k in range(3):
        _project(state.x[k], bend.force[k], state.mobility, bend.runs, bend.weight,
                 bend.compliance, False)


@stage(project_back, Bend)
@jit
def project_bend_back(bend, state, substep):
    """Do the same pass in reverse."""
    for k in range(3):
        _project(state.x[k], bend.force[k], state.mobility, bend.runs, bend.weight,
                 bend.compliance, True)


@jit
def _project(x, force, mobility, runs, weight, compliance, reverse):
    """Do one axis: the constraint is linear, so the axes know nothing of one another."""
    for a in range(len(runs.start)):
        r = len(runs.start) - 1 - a if reverse else a
        shape, base = runs.shape[r], runs.base[r]
        k0, k1, k2, k3 = weight[shape, 0], weight[shape, 1], weight[shape, 2], weight[shape, 3]
        alpha = compliance[shape]
        for b in range(runs.rows[r]):
            row = runs.rows[r] - 1 - b if reverse else b
            anchor = runs.start[r] + row * runs.stride[r]
            for q in range(0, runs.count[r], lanes(x)):
                c = anchor + q
                i0, i1 = c + runs.offset[r, 0], c + runs.offset[r, 1]
                i2, i3 = c + runs.offset[r, 2], c + runs.offset[r, 3]
                x0, x1, x2, x3 = load(x, i0), load(x, i1), load(x, i2), load(x, i3)
                m0, m1 = k0 * load(mobility, i0), k1 * load(mobility, i1)
                m2, m3 = k2 * load(mobility, i2), k3 * load(mobility, i3)
                total = fma(k0, m0, fma(k1, m1, fma(k2, m2, k3 * m3)))
                f = load(force, base + c)
                residual = fma(k0, x0, fma(k1, x1, fma(k2, x2, k3 * x3)))
                moves = both(total > 0.0, first(x, runs.count[r] - q))
                df = select(moves, -fma(alpha, f, residual) / (total + alpha), 0.0)
                store(force, base + c, f + df)
                store(x, i0, fma(m0, df, x0))
                store(x, i1, fma(m1, df, x1))
                store(x, i2, fma(m2, df, x2))
                store(x, i3, fma(m3, df, x3))


@stage(react, Bend)
@jit
def react_bend(bend, state, substep):
    """Forces on pinned particles: K_i f / sqrt(A0 + A1)."""
    part, held = substep.end - substep.begin, bend.held
    for h in range(held.count[0]):
        for p in range(4):
            i = held.particles[h, p]
            for k in range(3):
                state.reaction[k, i] += (part * bend.weight[held.shape[h], p]
                                         * bend.force[k, held.index[h]])


class Hinges:
    """The same hinges one by one, in sweep order, as people and NumPy want them."""

    def __init__(self, data: Bend):
        self.particles, self.index, self.shape = listed(data.runs)
        self.weight = data.weight[self.shape].astype(float)
        self.compliance = data.compliance[self.shape].astype(float)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C, shape (hinges, 3), straight from the definition; x has shape (3, slots)."""
        return (self.weight[:, :, None] * x.T[self.particles]).sum(1)

    def energy(self, x: np.ndarray) -> float:
        """Return Σ B |C|² / 2 [J]."""
        return float((0.5 * self.residual(x)**2 / self.compliance[:, None]).sum())


def grid_hinges(rows: int, columns: int) -> list[Shape]:
    """
    Return the hinges of a grid with alternating diagonals.

    Where row + column is even the cell's diagonal rises from its first corner, so both neighbours
    of an edge that starts there lie one column (or row) further on; where it is odd they do not.
    """
    shapes = []
    for j in (0, 1):
        for c in (0, 1):
            n = 1 - (j + c) % 2
            along, across = ((0, 0), (0, 1), (-1, n), (1, n)), ((0, 0), (1, 0), (n, -1), (n, 1))
            diagonal = (((0, 0), (1, 1), (0, 1), (1, 0)) if n else
                        ((0, 1), (1, 0), (0, 0), (1, 1)))
            shapes += [
                Shape(along, range(j or 2, rows - 1, 2), range(c, columns - 1, 2), 0),
                Shape(across, range(j, rows - 1, 2), range(c or 2, columns - 1, 2), 1),
                Shape(diagonal, range(j, rows - 1, 2), range(c, columns - 1, 2), 2)]
    return shapes


def isometric_weights(corners: np.ndarray) -> np.ndarray:
    """
    Return K_i / sqrt(A0 + A1) [1/m], shape (hinges, 4); a grid's diagonals weigh half.

    Parameters
    ----------
    corners : rest positions of the hinges' particles [m], shape (hinges, 4, 3)

    """
    x0, x1, x2, x3 = (corners[:, k] for k in range(4))
    e = x1 - x0

    def cot(u, v):
        return dot(u, v) / length(cross(u, v))

    c01, c02, c03, c04 = cot(e, x2 - x0), cot(e, x3 - x0), cot(-e, x2 - x1), cot(-e, x3 - x1)
    area = 0.5 * (length(cross(e, x2 - x0)) + length(cross(e, x3 - x0)))
    diagonal = (np.abs(e[:, 0]) > 0.0) & (np.abs(e[:, 1]) > 0.0)
    scale = np.sqrt(np.where(diagonal, 0.5, 1.0) / area)
    return np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], 1) * scale[:, None]


class BuiltBend(Built):
    """The hinges of every cloth that bends."""

    def __init__(self, parameters, world):
        super().__init__()
        runs, weight, compliance = [], [], []
        for number, (cloth, chosen) in enumerate(parameters.items()):
            shapes = grid_hinges(cloth.block.rows, cloth.block.columns)
            runs.append(grid_runs(cloth.block, shapes, world.slots, families=3 * number,
                                  shapes_before=len(shapes) * number))
            corners = np.zeros((len(shapes), 4, 3))
            corners[:, :, :2] = [[(c * cloth.mesh.spacing[0], j * cloth.mesh.spacing[1])
                                  for j, c in shape.particles] for shape in shapes]
            weight.append(isometric_weights(corners))
            compliance.append(np.full(len(shapes), world.compliance_scale / chosen.stiffness))
        dtype = world.state.x.dtype
        runs = join(runs)
        count = len(listed(runs)[1])
        held = Held(np.zeros(1, np.int64), np.zeros((count, 4), np.int64),
                    np.zeros(count, np.int64), np.zeros(count, np.int64)) if world.pins else None
        self.data = Bend(runs, np.concatenate(weight).astype(dtype),
                         np.minimum(np.concatenate(compliance), softest(dtype)).astype(dtype),
                         zeros((3, 3 * len(parameters) * world.slots), dtype), held)
        self.constraints = Hinges(self.data)

    def hold(self, inv_mass):
        held, all_ = self.data.held, self.constraints
        found = (inv_mass[all_.particles] == 0.0).any(1)
        held.count[0] = count = found.sum()
        held.particles[:count] = all_.particles[found]
        held.index[:count] = all_.index[found]
        held.shape[:count] = all_.shape[found]


EFFECT = Effect('bend', Parameters, BuiltBend)
