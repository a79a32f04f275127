"""
Bend: bending stiffness by linear constraints: curvature and twist on grids, hinges on meshes.

On a grid of spacing d along a row and rows w apart (half of it at the rim), every three particles
in a row, and every cell dx × dy, have a linear vector constraint in R³:

    curvature   C = x1 - 2 x2 + x3               α = d³ / (B w)
    twist       C = x00 - x01 - x10 + x11        α = dx dy / (2 B)

The energy |C|² / (2 α) is the plate's B (κxx² + κyy² + 2 κxy²) / 2 per area with κ by central
differences, so the error falls with d². B is ``warp`` for rows, ``weft`` for columns, and the
geometric mean of both for the twist.

On any other mesh a hinge (x0, x1) with opposite particles x2, x3 and rest areas A0, A1 has

    C = Σ K_i x_i / sqrt(A0 + A1),   K = (c03+c04, c01+c02, -c01-c03, -c02-c04),   α = 1 / b

with c01 = cot(e, x2-x0), c02 = cot(e, x3-x0), c03 = cot(-e, x2-x1), c04 = cot(-e, x3-x1) at rest
(isometric bending, Bergou et al. 2006; |Σ K_i x_i| = 2 |e| sin(θ/2) at the dihedral angle θ). Each
hinge of a flat mesh has its own b, fitted so that the sheet bends as a plate
(``constraints.plate_rigidity``). The hinges of a regular grid see the curvature of every other
particle only, so a sheet free to relax would be a quarter too soft; hence the stencils above.

All gradients are constant weights k_i: no singularity, no wrap at 180° (doc/numerics.md 5.5). In
force form, with mobilities m = w H², W = Σ m_i k_i² and a 3-vector f = λ / H²,

    Δf = -(C + α f) / (W + α),   x_i += m_i k_i Δf.

Limits: a flat rest shape, and deformations that keep lengths. Where warp and weft differ by much
more than a factor of ten, the hinges of most meshes cannot represent both; a note says which
rigidities they give.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.constraints.curvature import curvature_shapes, straighten, twist_shapes, untwist
from xpbd_ros.sim.constraints.distance import by_place, max_compliance
from xpbd_ros.sim.constraints.grid_batches import grid_runs, join, listed, Runs
from xpbd_ros.sim.constraints.isometric_bending import isometric_weights, project_packs
from xpbd_ros.sim.constraints.mesh_batches import pack, padded
from xpbd_ros.sim.constraints.pinned import hold, room_for
from xpbd_ros.sim.constraints.plate_rigidity import plate, shortfall
from xpbd_ros.sim.constraints.projection import row, zero_multipliers
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.parameters import need_one_or_two, quantity
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.records import from_records, to_records
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    prepare,
    project,
    project_back,
    stage,
)


@dataclass(frozen=True)
class Parameters:
    """One bending rigidity, or one each along warp and weft."""

    stiffness: float | None = quantity(None, unit='N m', above=0.0, live=True,
                                       doc='bending rigidity B')
    warp: float | None = quantity(None, unit='N m', above=0.0, live=True,
                                  doc='bending rigidity of rows, which run along warp')
    weft: float | None = quantity(None, unit='N m', above=0.0, live=True,
                                  doc='bending rigidity of columns, which run along weft')

    def __post_init__(self):
        """Require exactly one of the two forms."""
        need_one_or_two(self.stiffness, (self.warp, self.weft), both='warp and weft (N m)',
                        either='stiffness (N m) or warp and weft (N m)')

    @property
    def rigidity(self) -> tuple[float, float]:
        """B along warp and weft [N m]."""
        warp, weft = self.warp or self.stiffness, self.weft or self.stiffness
        assert warp is not None and weft is not None
        return warp, weft


class Held(NamedTuple):
    """The constraints at pinned particles, whose reaction forces are summed up."""

    count: np.ndarray
    """shape (1,)"""
    particles: np.ndarray
    """slots, shape (room, particles of a constraint)"""
    index: np.ndarray
    """index of each one's force, shape (room,)"""
    weight: np.ndarray
    """k_i, shape (room, particles of a constraint)"""


class Curvature(NamedTuple):
    """Three particles in a row or a column, in runs."""

    runs: Runs
    compliance: np.ndarray
    """[m/N], by shape and place in a row, ABSENT where there is none; shape (shapes, places)"""
    force: np.ndarray | None
    """f [N], shape (3, families * slots); None if multipliers are not kept"""
    held: Held | None
    """None in a scene without pins"""


class Twist(NamedTuple):
    """The four particles of a cell, in runs."""

    runs: Runs
    compliance: np.ndarray
    """[m/N], by shape and place in a row, ABSENT where there is none; shape (shapes, places)"""
    force: np.ndarray | None
    """f [N], shape (3, families * slots); None if multipliers are not kept"""
    held: Held | None
    """None in a scene without pins"""


WEIGHTS = {Curvature: (1.0, -2.0, 1.0), Twist: (1.0, -1.0, -1.0, 1.0)}


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
    """1 / b [1/(N m)], shape (hinges,)"""
    force: np.ndarray | None
    """f [N m], shape (3, hinges); None if multipliers are not kept"""
    held: Held | None
    """None in a scene without pins"""


@stage(prepare, Curvature)
@stage(prepare, Twist)
@stage(prepare, MeshBend)
@jit
def prepare_bend(bend, state, substep):
    """Zero the multipliers."""
    zero_multipliers(state.apart, bend.force)


@stage(project, Curvature, shared=True)
@jit
def project_curvature(bend, state, substep):
    """One Gauss-Seidel pass, run after run."""
    straighten(bend, state, False)


@stage(project_back, Curvature, shared=True)
@jit
def project_curvature_back(bend, state, substep):
    """The same pass in reverse order."""
    straighten(bend, state, True)


@stage(project, Twist, shared=True)
@jit
def project_twist(bend, state, substep):
    """One Gauss-Seidel pass, run after run."""
    untwist(bend, state, False)


@stage(project_back, Twist, shared=True)
@jit
def project_twist_back(bend, state, substep):
    """The same pass in reverse order."""
    untwist(bend, state, True)


@stage(project, MeshBend)
@jit
def project_mesh_bend(bend, state, substep):
    """One pass over all hinges."""
    _project_mesh(bend, state, False)


@stage(project_back, MeshBend)
@jit
def project_mesh_bend_back(bend, state, substep):
    """The same pass in reverse order."""
    _project_mesh(bend, state, True)


@jit
def _project_mesh(bend, state, reverse):
    first_, last = bend.slots[0], bend.slots[1]
    to_records(state, bend.records, first_, last)
    project_packs(bend.records, state.apart, bend.particles, bend.weight, bend.compliance,
                  row(bend.force, 0), row(bend.force, 1), row(bend.force, 2), reverse)
    from_records(state, bend.records, first_, last)


@stage(accumulate_reactions, Curvature)
@stage(accumulate_reactions, Twist)
@stage(accumulate_reactions, MeshBend)
@jit
def react_bend(bend, state, substep):
    """Forces on pinned particles: k_i f."""
    part, held = substep.end - substep.begin, bend.held
    for h in range(held.count[0]):
        for p in range(held.particles.shape[1]):
            i = held.particles[h, p]
            for k in range(3):
                state.reaction[k, i] += part * held.weight[h, p] * bend.force[k, held.index[h]]


class Linear:
    """The constraints one by one, in sweep order: the definition in NumPy."""

    def __init__(self, particles, index, weight, compliance):
        self.particles = particles
        self.index = index
        self.weight = weight.astype(float)
        self.compliance = compliance.astype(float)

    @staticmethod
    def of(data: Curvature | Twist | MeshBend) -> 'Linear':
        """Return the constraints of a batch."""
        if isinstance(data, MeshBend):
            index = np.flatnonzero(data.particles[0] != data.particles[1])
            return Linear(data.particles[:, index].T.astype(np.int64), index,
                          data.weight[:, index].T, data.compliance[index])
        particles, index, shape, place = listed(data.runs)
        return Linear(particles, index, np.tile(WEIGHTS[type(data)], (len(index), 1)),
                      data.compliance[shape, place])

    @staticmethod
    def joined(lists: list['Linear']) -> 'Linear':
        """
        Return the constraints of several batches with four particles each.

        Those of three particles list the middle one first as well, with weight 0. ``index`` counts
        within each batch.
        """
        wide = [each if each.particles.shape[1] == 4 else Linear(
            each.particles[:, [1, 0, 1, 2]], each.index,
            np.pad(each.weight, ((0, 0), (1, 0))), each.compliance) for each in lists]
        return Linear(*(np.concatenate([getattr(each, name) for each in wide]) for name in (
            'particles', 'index', 'weight', 'compliance')))

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C, shape (constraints, 3), from the definition; x has shape (3, slots)."""
        return (self.weight[:, :, None] * x.T[self.particles]).sum(1)

    def energy(self, x: np.ndarray) -> float:
        """Return Σ |C|² / (2 α) [J]."""
        return float((0.5 * self.residual(x)**2 / self.compliance[:, None]).sum())

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """Return Σ |k_i| Σ |k_j| / α at each particle [N/m], shape (slots, 3, 3)."""
        weight = np.abs(self.weight)
        total = np.zeros(x.shape[1])
        np.add.at(total, self.particles, weight * weight.sum(1, keepdims=True)
                  / self.compliance[:, None])
        return total[:, None, None] * np.eye(3)


def _on_grids(cloths, world) -> list[Curvature | Twist]:
    found = []
    for kind, shapes_of, families, compliance_of in (
            (Curvature, curvature_shapes, 2, _curvature_compliance),
            (Twist, twist_shapes, 1, _twist_compliance)):
        runs, alpha = [], []
        for number, (cloth, chosen) in enumerate(cloths):
            shapes = shapes_of(cloth.block.rows, cloth.block.columns)
            runs.append(grid_runs(cloth.block, shapes, world.slots, families=families * number,
                                  shapes_before=len(shapes) * number))
            alpha.append(world.compliance_scale * compliance_of(cloth, *chosen.rigidity))
        runs = join(runs)
        count = len(listed(runs)[1])
        if count:
            dtype, size = world.state.x.dtype, (3, families * len(cloths) * world.slots)
            found.append(kind(runs, by_place(runs, alpha, dtype),
                              zeros(size, dtype) if world.forces else None,
                              _room(count, len(WEIGHTS[kind])) if world.pins else None))
    return found


def _curvature_compliance(cloth, warp: float, weft: float) -> np.ndarray:
    """Return d³ / (B w) of each shape [m/N], by place in a row; w is half at the rim."""
    block, (dx, dy) = cloth.block, cloth.mesh.spacing
    found = np.zeros((3, block.row_stride))
    found[0] = dx**3 / (warp * dy)
    found[1] = 2.0 * found[0]
    found[2] = dy**3 / (weft * dx)
    if block.columns > 1:
        found[2, block.slots[0, [0, -1]] - block.first] *= 2.0
    return found


def _twist_compliance(cloth, warp: float, weft: float) -> np.ndarray:
    """Return dx dy / (2 B) [m/N], by place in a row."""
    dx, dy = cloth.mesh.spacing
    with np.errstate(divide='ignore'):
        return np.full((1, cloth.block.row_stride), dx * dy / (2.0 * np.sqrt(warp * weft)))


def _on_meshes(cloths, world) -> tuple[list[MeshBend], list[str]]:
    """Return the hinges of meshes, and notes on rigidities that they cannot represent."""
    dtype, notes, compliance = world.state.x.dtype, [], []
    particles = np.concatenate([cloth.slots[cloth.mesh.hinges] for cloth, _ in cloths])
    weight = np.concatenate([isometric_weights(cloth.mesh.positions[cloth.mesh.hinges])
                             for cloth, _ in cloths])
    for cloth, chosen in cloths:
        found = plate(cloth.mesh, *chosen.rigidity)
        with np.errstate(over='ignore', divide='ignore'):
            compliance.append(world.compliance_scale / found.rigidity)
        short = shortfall(found, *chosen.rigidity)
        notes += [f'cloths.{cloth.name}.effects.bend: {short}'] if short else []
    if not len(particles):
        return [], notes
    compliance, order = np.concatenate(compliance), pack(particles)
    return [MeshBend(
        world.records,
        np.array([particles.min(initial=0), particles.max(initial=-1) + 1]),
        padded(particles, order, world.slots - 1, np.int32).T.copy(),
        padded(weight, order, 0.0, dtype).T.copy(),
        padded(np.minimum(compliance, max_compliance(dtype)), order, max_compliance(dtype), dtype),
        zeros((3, len(order)), dtype) if world.forces else None,
        _room(len(order), 4) if world.pins else None)], notes


def _room(count: int, width: int) -> Held:
    return Held(*room_for(count, width), np.zeros((count, width)))


class BuiltBend(Built):
    """The curvatures and twists of grids, and the hinges of other meshes."""

    def __init__(self, parameters, world):
        super().__init__()
        on_grids, on_meshes = ([(cloth, chosen) for cloth, chosen in parameters.items()
                                if (cloth.mesh.grid is not None) == of_kind]
                               for of_kind in (True, False))
        parts: list[Any] = _on_grids(on_grids, world) if on_grids else []
        if on_meshes:
            more, self.notes = _on_meshes(on_meshes, world)
            parts += more
        self.data, *self.also = parts or [None]
        self.lists = [Linear.of(part) for part in parts]
        none = np.zeros(0, np.int64)
        self.constraints = Linear.joined([
            Linear(none.reshape(0, 4), none, none.reshape(0, 4), none), *self.lists])

    def hold(self, inv_mass):
        for part, constraints in zip(self.parts, self.lists):
            hold(part.held, constraints, inv_mass)


EFFECT = Effect('bend', Parameters, BuiltBend)
