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

from xpbd_ros.sim.distance import release_forces, softest
from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.layout import zeros
from xpbd_ros.sim.mesh import cross, dot, length
from xpbd_ros.sim.packs import pack, padded
from xpbd_ros.sim.records import from_records, load_records, put_records, to_records
from xpbd_ros.sim.runs import grid_runs, join, listed, Runs, Shape
from xpbd_ros.sim.stages import prepare, project, project_back, react, stage
from xpbd_ros.sim.update import divisor, keep, misfit, put, recall, row, target
from xpbd_ros.sim.vector import both, first, fma, lanes, load, select


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
    weight: np.ndarray
    """K_i / sqrt(A0 + A1) [1/m], shape (room, 4)"""


class Bend(NamedTuple):
    """Hinges in runs; edge start, edge end, opposite, opposite."""

    runs: Runs
    weight: np.ndarray
    """K_i / sqrt(A0 + A1) [1/m], by shape; shape (shapes, 4)"""
    compliance: np.ndarray
    """1 / B [1/(N m)], by shape; shape (shapes,)"""
    force: np.ndarray | None
    """f, multiplier over H² [N m], shape (3, families * slots); None where nobody asks"""
    held: Held | None
    """None in a scene without pins"""


class MeshBend(NamedTuple):
    """Hinges of meshes, in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots: edge start, edge end, opposite, opposite; shape (4, hinges)"""
    weight: np.ndarray
    """K_i / sqrt(A0 + A1) [1/m], shape (4, hinges)"""
    compliance: np.ndarray
    """1 / B [1/(N m)], shape (hinges,)"""
    force: np.ndarray | None
    """f [N m], shape (3, hinges); None where nobody asks"""
    held: Held | None
    """None in a scene without pins"""


@stage(prepare, Bend)
@stage(prepare, MeshBend)
@jit
def prepare_bend(bend, state, substep):
    """Zero the multipliers."""
    release_forces(bend)


@stage(project, Bend)
@jit
def project_bend(bend, state, substep):
    """One Gauss-Seidel pass over all hinges, run after run."""
    for k in range(3):
        _project(state.x[k], target(state.apart, k), row(bend.force, k), state.mobility,
                 state.apart, bend.runs, bend.weight, bend.compliance, False)


@stage(project_back, Bend)
@jit
def project_bend_back(bend, state, substep):
    """Do the same pass in reverse."""
    for k in range(3):
        _project(state.x[k], target(state.apart, k), row(bend.force, k), state.mobility,
                 state.apart, bend.runs, bend.weight, bend.compliance, True)


@jit
def _project(x, to, force, mobility, apart, runs, weight, compliance, reverse):
    """Do one axis: the constraint is linear, so the axes know nothing of one another."""
    for a in range(len(runs.start)):
        r = len(runs.start) - 1 - a if reverse else a
        shape, base = runs.shape[r], runs.base[r]
        k0, k1, k2, k3 = weight[shape, 0], weight[shape, 1], weight[shape, 2], weight[shape, 3]
        alpha = compliance[shape]
        for b in range(runs.rows[r]):
            anchor = runs.start[r] + (runs.rows[r] - 1 - b if reverse else b) * runs.stride[r]
            for q in range(0, runs.count[r], lanes(x)):
                c = anchor + q
                i0, i1 = c + runs.offset[r, 0], c + runs.offset[r, 1]
                i2, i3 = c + runs.offset[r, 2], c + runs.offset[r, 3]
                x0, x1, x2, x3 = load(x, i0), load(x, i1), load(x, i2), load(x, i3)
                m0, m1 = k0 * load(mobility, i0), k1 * load(mobility, i1)
                m2, m3 = k2 * load(mobility, i2), k3 * load(mobility, i3)
                total = fma(k0, m0, fma(k1, m1, fma(k2, m2, k3 * m3)))
                f = recall(apart, force, base + c)
                residual = fma(k0, x0, fma(k1, x1, fma(k2, x2, k3 * x3)))
                moves = both(total > 0.0, first(x, runs.count[r] - q))
                df = select(moves, -misfit(residual, alpha, f) / divisor(apart, total, alpha), 0.0)
                keep(force, base + c, f, df)
                put(x, to, i0, x0, m0, df)
                put(x, to, i1, x1, m1, df)
                put(x, to, i2, x2, m2, df)
                put(x, to, i3, x3, m3, df)


@stage(project, MeshBend)
@jit
def project_mesh_bend(bend, state, substep):
    """One pass over all hinges."""
    _project_mesh(bend, state, False)


@stage(project_back, MeshBend)
@jit
def project_mesh_bend_back(bend, state, substep):
    """Do the same pass in reverse."""
    _project_mesh(bend, state, True)


@jit
def _project_mesh(bend, state, reverse):
    first_, last = bend.slots[0], bend.slots[1]
    to_records(state, bend.records, first_, last)
    _project_packs(bend.records, state.apart, bend.particles, bend.weight,
                   bend.compliance, row(bend.force, 0), row(bend.force, 1), row(bend.force, 2),
                   reverse)
    from_records(state, bend.records, first_, last)


@jit
def _project_packs(records, apart, particles, weight, compliance, fx, fy, fz, reverse):
    count, step = len(compliance), lanes(compliance)
    p0, p1, p2, p3 = particles[0], particles[1], particles[2], particles[3]
    w0, w1, w2, w3 = weight[0], weight[1], weight[2], weight[3]
    for p in range(0, count, step):
        q = count - step - p if reverse else p
        x0, y0, z0, m0 = load_records(records, p0, q)
        x1, y1, z1, m1 = load_records(records, p1, q)
        x2, y2, z2, m2 = load_records(records, p2, q)
        x3, y3, z3, m3 = load_records(records, p3, q)
        k0, k1, k2, k3 = load(w0, q), load(w1, q), load(w2, q), load(w3, q)
        n0, n1, n2, n3 = k0 * m0, k1 * m1, k2 * m2, k3 * m3
        total = fma(k0, n0, fma(k1, n1, fma(k2, n2, k3 * n3)))
        alpha = load(compliance, q)
        f, g, h = recall(apart, fx, q), recall(apart, fy, q), recall(apart, fz, q)
        x = fma(k0, x0, fma(k1, x1, fma(k2, x2, k3 * x3)))
        y = fma(k0, y0, fma(k1, y1, fma(k2, y2, k3 * y3)))
        z = fma(k0, z0, fma(k1, z1, fma(k2, z2, k3 * z3)))
        per = select(total > 0.0, -1.0 / divisor(apart, total, alpha), 0.0)
        dx, dy, dz = (per * misfit(x, alpha, f), per * misfit(y, alpha, g),
                      per * misfit(z, alpha, h))
        keep(fx, q, f, dx)
        keep(fy, q, g, dy)
        keep(fz, q, h, dz)
        put_records(records, apart, p0, q, x0, y0, z0, m0, n0, dx, dy, dz)
        put_records(records, apart, p1, q, x1, y1, z1, m1, n1, dx, dy, dz)
        put_records(records, apart, p2, q, x2, y2, z2, m2, n2, dx, dy, dz)
        put_records(records, apart, p3, q, x3, y3, z3, m3, n3, dx, dy, dz)


@stage(react, Bend)
@stage(react, MeshBend)
@jit
def react_bend(bend, state, substep):
    """Forces on pinned particles: K_i f / sqrt(A0 + A1)."""
    part, held = substep.end - substep.begin, bend.held
    for h in range(held.count[0]):
        for p in range(4):
            i = held.particles[h, p]
            for k in range(3):
                state.reaction[k, i] += part * held.weight[h, p] * bend.force[k, held.index[h]]


class Hinges:
    """The same hinges one by one, in sweep order, as people and NumPy want them."""

    def __init__(self, particles, index, weight, compliance):
        self.particles = particles
        self.index = index
        self.weight = weight.astype(float)
        self.compliance = compliance.astype(float)

    @staticmethod
    def of(data: Bend | MeshBend) -> 'Hinges':
        """Return the hinges of a batch."""
        if isinstance(data, MeshBend):
            index = np.flatnonzero(data.particles[0] != data.particles[1])
            return Hinges(data.particles[:, index].T.astype(np.int64), index,
                          data.weight[:, index].T, data.compliance[index])
        particles, index, shape, _ = listed(data.runs)
        return Hinges(particles, index, data.weight[shape], data.compliance[shape])

    @staticmethod
    def joined(lists: list['Hinges']) -> 'Hinges':
        """Return the hinges of several batches; ``index`` counts within each."""
        return Hinges(*(np.concatenate([getattr(hinges, name) for hinges in lists]) for name in (
            'particles', 'index', 'weight', 'compliance')))

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C, shape (hinges, 3), straight from the definition; x has shape (3, slots)."""
        return (self.weight[:, :, None] * x.T[self.particles]).sum(1)

    def energy(self, x: np.ndarray) -> float:
        """Return Σ B |C|² / 2 [J]."""
        return float((0.5 * self.residual(x)**2 / self.compliance[:, None]).sum())

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """Return B Σ |K_i| Σ |K_j| at each particle [N/m], shape (slots, 3, 3)."""
        weight = np.abs(self.weight)
        total = np.zeros(x.shape[1])
        np.add.at(total, self.particles, weight * weight.sum(1, keepdims=True)
                  / self.compliance[:, None])
        return total[:, None, None] * np.eye(3)


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
    Return K_i / sqrt(A0 + A1) [1/m], shape (hinges, 4).

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
    return np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], 1) / np.sqrt(area)[:, None]


def shape_weights(shapes: list[Shape], spacing: tuple[float, float]) -> np.ndarray:
    """Return the weights of a grid's shapes, (shapes, 4): those of diagonals count half."""
    corners = np.zeros((len(shapes), 4, 3))
    corners[:, :, :2] = [[(c * spacing[0], j * spacing[1]) for j, c in shape.particles]
                         for shape in shapes]
    diagonal = (corners[:, 0, :2] != corners[:, 1, :2]).all(1)
    return isometric_weights(corners) * np.sqrt(np.where(diagonal, 0.5, 1.0))[:, None]


def _on_grids(cloths, world) -> Bend:
    runs, weight, compliance = [], [], []
    for number, (cloth, chosen) in enumerate(cloths):
        shapes = grid_hinges(cloth.block.rows, cloth.block.columns)
        runs.append(grid_runs(cloth.block, shapes, world.slots, families=3 * number,
                              shapes_before=len(shapes) * number))
        weight.append(shape_weights(shapes, cloth.mesh.spacing))
        compliance.append(np.full(len(shapes), world.compliance_scale / chosen.stiffness))
    dtype = world.state.x.dtype
    runs = join(runs)
    return Bend(runs, np.concatenate(weight).astype(dtype),
                np.minimum(np.concatenate(compliance), softest(dtype)).astype(dtype),
                zeros((3, 3 * len(cloths) * world.slots), dtype) if world.forces else None,
                _room(len(listed(runs)[1])) if world.pins else None)


def _on_meshes(cloths, world) -> MeshBend:
    dtype = world.state.x.dtype
    particles = np.concatenate([cloth.slots[cloth.mesh.hinges] for cloth, _ in cloths])
    weight = np.concatenate([isometric_weights(cloth.mesh.positions[cloth.mesh.hinges])
                             for cloth, _ in cloths])
    compliance = np.concatenate([np.full(len(cloth.mesh.hinges),
                                         world.compliance_scale / chosen.stiffness)
                                 for cloth, chosen in cloths])
    order = pack(particles)
    return MeshBend(
        world.records,
        np.array([particles.min(initial=0), particles.max(initial=-1) + 1]),
        padded(particles, order, world.slots - 1, np.int32).T.copy(),
        padded(weight, order, 0.0, dtype).T.copy(),
        padded(np.minimum(compliance, softest(dtype)), order, softest(dtype), dtype),
        zeros((3, len(order)), dtype) if world.forces else None,
        _room(len(order)) if world.pins else None)


def _room(count: int) -> Held:
    return Held(np.zeros(1, np.int64), np.zeros((count, 4), np.int64), np.zeros(count, np.int64),
                np.zeros((count, 4)))


class BuiltBend(Built):
    """The hinges of every cloth that bends: of grids, and of other meshes."""

    def __init__(self, parameters, world):
        super().__init__()
        parts = []
        for make, of_kind in ((_on_grids, True), (_on_meshes, False)):
            cloths = [(cloth, chosen) for cloth, chosen in parameters.items()
                      if (cloth.mesh.grid is not None) == of_kind]
            if cloths:
                parts.append(make(cloths, world))
        self.data, *self.also = parts
        self._lists = [Hinges.of(part) for part in parts]
        self.constraints = Hinges.joined(self._lists)

    def hold(self, inv_mass):
        for part, hinges in zip(self.parts, self._lists):
            found = np.flatnonzero((inv_mass[hinges.particles] == 0.0).any(1))
            part.held.count[0] = len(found)
            for column, numbers in zip(part.held[1:], (hinges.particles, hinges.index,
                                                       hinges.weight)):
                column[:len(found)] = numbers[found]


EFFECT = Effect('bend', Parameters, BuiltBend)
