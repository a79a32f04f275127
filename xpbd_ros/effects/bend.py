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

Where it is soft in a substep, ``line`` sweeps it once, with W / 2 (doc/numerics.md 3.2).

Limits: a flat rest shape, and deformations that keep lengths. Where warp and weft differ by much
more than a factor of ten, the hinges of most meshes cannot represent both; a note says which
rigidities they give.
"""

from dataclasses import dataclass
from math import inf
from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, fma, load, select
from xpbd_ros.sim.backend.simd_vector3 import fma3
from xpbd_ros.sim.constraints.builders import Packing, Rows
from xpbd_ros.sim.constraints.curvature import curvature_shapes, twist_shapes
from xpbd_ros.sim.constraints.definitions import Constraints, isotropic
from xpbd_ros.sim.constraints.grid_batches import listed, Runs
from xpbd_ros.sim.constraints.isometric_bending import isometric_weights
from xpbd_ros.sim.constraints.pinned import Held, Stops
from xpbd_ros.sim.constraints.plate_rigidity import plate, shortfall
from xpbd_ros.sim.constraints.projection import denominator, keep3, recall3, xpbd_residual
from xpbd_ros.sim.effect import Built, by_kind, Effect, is_grid
from xpbd_ros.sim.parameters import along_both, need_one_or_two, quantity
from xpbd_ros.sim.stepping.constraint_stages import constraint


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
    def rigidities(self) -> tuple[float, float]:
        """B along warp and weft [N m]."""
        return along_both(self.stiffness, self.warp, self.weft)


class Curvature(NamedTuple):
    """Three particles in a row or a column, in runs."""

    runs: Runs
    compliance: np.ndarray
    """[m/N], by shape and place in a row, ABSENT where there is none; shape (shapes, places)"""
    rate: float
    """of all bending, as ``Built.rate``"""
    force: np.ndarray | None
    """f [N], shape (3, families * slots); None if multipliers are not kept"""
    stops: Stops | None
    """None in a scene without pins"""


class Twist(NamedTuple):
    """The four particles of a cell, in runs."""

    runs: Runs
    compliance: np.ndarray
    """[m/N], by shape and place in a row, ABSENT where there is none; shape (shapes, places)"""
    rate: float
    """of all bending, as ``Built.rate``"""
    force: np.ndarray | None
    """f [N], shape (3, families * slots); None if multipliers are not kept"""
    stops: Stops | None
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
    force: np.ndarray | None
    """f [N m], shape (3, hinges); None if multipliers are not kept"""
    held: Held | None
    """None in a scene without pins"""
    colours: np.ndarray | None
    """first constraint of each colour, and the number of places, shape (colours + 1,); None in
    sequential order"""
    rate: float
    """of all bending, as ``Built.rate``"""
    weight: np.ndarray
    """K_i / sqrt(A0 + A1) [1/m], shape (4, hinges)"""
    compliance: np.ndarray
    """1 / b [1/(N m)], shape (hinges,)"""


@jit(inline=True)
def solve(apart, force, c, residual, total, alpha, there):
    """Return Δf = -(C + α f) / (W + α) of a vector of constraints, where ``there``; keep f."""
    f = recall3(apart, force, c)
    per = select(both(total + alpha > 0.0, there), -1.0 / denominator(apart, total, alpha), 0.0)
    df = per * xpbd_residual(residual, alpha, f)
    keep3(force, c, f, df)
    return df


@constraint(Curvature, particles=3)
@jit(inline=True)
def solve_curvature(bend, apart, at, x, m):
    """Solve a vector of three particles in a line."""
    alpha = load(bend.compliance, at.number)
    df = solve(apart, bend.force, at.c, fma3(-2.0, x[1], x[0] + x[2]),
               fma(4.0, m[1], m[0] + m[2]), alpha, both(alpha >= 0.0, at.there))
    return (1.0, df), (-2.0, df), (1.0, df)


@constraint(Twist, particles=4)
@jit(inline=True)
def solve_twist(bend, apart, at, x, m):
    """Solve a vector of cells."""
    alpha = load(bend.compliance, at.number)
    df = solve(apart, bend.force, at.c, (x[0] - x[1]) - (x[2] - x[3]),
               (m[0] + m[1]) + (m[2] + m[3]), alpha, both(alpha >= 0.0, at.there))
    return (1.0, df), (-1.0, df), (-1.0, df), (1.0, df)


@constraint(MeshBend, particles=4)
@jit(inline=True)
def solve_hinges(bend, apart, c, x, m):
    """Solve a vector of hinges from index c on."""
    count, alpha = len(bend.compliance), load(bend.compliance, c)
    k0, k1 = load(bend.weight, c), load(bend.weight, count + c)
    k2, k3 = load(bend.weight, 2 * count + c), load(bend.weight, 3 * count + c)
    total = fma(k0, k0 * m[0], fma(k1, k1 * m[1], fma(k2, k2 * m[2], k3 * (k3 * m[3]))))
    residual = fma3(k0, x[0], fma3(k1, x[1], fma3(k2, x[2], k3 * x[3])))
    df = solve(apart, bend.force, c, residual, total, alpha, alpha >= 0.0)
    return (k0, df), (k1, df), (k2, df), (k3, df)


@jit
def energy_of(particles, weight, compliance, x):
    """Return Σ |C|² / (2 α) of constraints listed one by one [J]."""
    total = 0.0
    for c in range(len(particles)):
        for a in range(3):
            residual = 0.0
            for k in range(particles.shape[1]):
                residual += weight[c, k] * x[a, particles[c, k]]
            total += residual * residual / compliance[c]
    return 0.5 * total


@dataclass(eq=False)
class Linear(Constraints):
    """The constraints one by one: the definition in NumPy."""

    weight: np.ndarray
    """k_i, shape (constraints, particles of each)"""

    @classmethod
    def of(cls, batch: Curvature | Twist | MeshBend) -> 'Linear':
        """Return the constraints of a batch."""
        if isinstance(batch, MeshBend):
            return super().of(batch)
        particles, index, shape, place = listed(batch.runs)
        return Linear(particles, index, batch.compliance[shape, place].astype(float),
                      np.tile(WEIGHTS[type(batch)], (len(index), 1)))

    @classmethod
    def joined(cls, lists: list['Linear']) -> 'Linear':
        """
        Return the constraints of several batches with four particles each.

        Those of three particles list the middle one first as well, with weight 0. ``index`` counts
        within each batch.
        """
        return super().joined([each if each.particles.shape[1] == 4 else Linear(
            each.particles[:, [1, 0, 1, 2]], each.index, each.compliance,
            np.pad(each.weight, ((0, 0), (1, 0)))) for each in lists])

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C, shape (constraints, 3); x has shape (3, slots)."""
        return (self.weight[:, :, None] * self.corners(x)).sum(1)

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """Return Σ |k_i| Σ |k_j| / α at each particle [N/m], shape (slots, 3, 3)."""
        weight = np.abs(self.weight)
        return isotropic(x, self.particles,
                         weight * weight.sum(1, keepdims=True) / self.compliance[:, None])


def _on_grids(cloths, world) -> list[Curvature | Twist]:
    found = []
    for kind, shapes_of, compliance_of in ((Curvature, curvature_shapes, _curvature_compliance),
                                           (Twist, twist_shapes, _twist_compliance)):
        rows = Rows([cloth.block for cloth, _ in cloths], shapes_of, world)
        if len(listed(rows.runs)[1]):
            found.append(kind(**rows.common([
                world.compliance_scale * compliance_of(cloth, *chosen.rigidities)
                for cloth, chosen in cloths], (3,)), rate=inf))
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
    particles, weight, compliance, notes = [], [], [], []
    for cloth, chosen in cloths:
        hinges, found = cloth.mesh.hinges, plate(cloth.mesh, *chosen.rigidities)
        particles.append(cloth.slots[hinges])
        weight.append(isometric_weights(cloth.mesh.positions[hinges]))
        with np.errstate(over='ignore', divide='ignore'):
            compliance.append(world.compliance_scale / found.rigidity)
        short = shortfall(found, *chosen.rigidities)
        notes += [f'cloths.{cloth.name}.effects.bend: {short}'] if short else []
    if not sum(map(len, particles)):
        return [], notes
    packing = Packing(particles, world)
    return [MeshBend(**packing.common((3,)), rate=inf, weight=packing.column(weight),
                     compliance=packing.compliance(compliance))], notes


class BuiltBend(Built):
    """The curvatures and twists of grids, and the hinges of other meshes."""

    def __init__(self, parameters, world):
        super().__init__()
        on_grids, on_meshes = by_kind(parameters, is_grid)
        parts: list[Any] = _on_grids(on_grids, world) if on_grids else []
        if on_meshes:
            more, self.notes = _on_meshes(on_meshes, world)
            parts += more
        self.lists = [Linear.of(part) for part in parts]
        none = np.zeros(0, np.int64)
        self.constraints = Linear.joined([
            Linear(none.reshape(0, 4), none, none, none.reshape(0, 4)), *self.lists])
        self.rate = self.constraints.rate(world.state.mass)
        self.data, *self.also = [part._replace(rate=self.rate) for part in parts] or [None]

    def stored_energy(self, state):
        these = self.constraints
        return energy_of(these.particles, these.weight, these.compliance, state.x)


EFFECT = Effect('bend', Parameters, BuiltBend)
