"""
Area: triangles resist changes of their area, but not of their shape.

C = A - A0 with 2 A n = (x1-x0) × (x2-x0), |n| = 1, so

    ∇1 = (x2-x0) × n / 2,   ∇2 = n × (x1-x0) / 2,   ∇0 = -∇1 - ∇2.

The energy of a triangle is stiffness C² / (2 A0), so α = A0 / stiffness [m³/N]: ``stiffness`` is
the tension of a sheet whose area has doubled. It serves flat bodies and skins, together with an
effect that resists shear; on a body of tetrahedra it acts on the skin.

Limits: a triangle whose corners are collinear has no normal and does not move. Alone, the effect
lets a triangle shear without bound.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, fma, lanes, load, root, select
from xpbd_ros.sim.backend.simd_records import load_records
from xpbd_ros.sim.constraints.distance import max_compliance
from xpbd_ros.sim.constraints.mesh_batches import pack, padded
from xpbd_ros.sim.constraints.pinned import (
    collect,
    hold_packs,
    Packs,
    packs_for,
    remember,
    room_for,
    segment,
    segment_count,
)
from xpbd_ros.sim.constraints.projection import (
    denominator,
    keep,
    recall,
    xpbd_residual,
    zero_multipliers,
)
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.geometry.mesh import cross, length
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.records import from_records, put_records, to_records
from xpbd_ros.sim.stepping.stages import prepare, project, project_back, stage


@dataclass(frozen=True)
class Parameters:
    """The area modulus."""

    stiffness: float = quantity(unit='N/m', above=0.0, live=True,
                                doc='area modulus: tension per relative change of area')


class Area(NamedTuple):
    """Triangles in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots, shape (3, triangles)"""
    rest_area: np.ndarray
    """A0 [m²], shape (triangles,)"""
    compliance: np.ndarray
    """A0 / stiffness [m³/N], shape (triangles,)"""
    force: np.ndarray | None
    """f, multiplier over H² [N/m], negative in tension, shape (triangles,); None if
    multipliers are not kept"""
    packs: Packs | None
    """triangles at pinned particles; None in a scene without pins"""


@stage(prepare, Area)
@jit
def prepare_area(area, state, substep):
    """Zero the multipliers."""
    zero_multipliers(state.apart, area.force)


@stage(project, Area)
@jit
def project_area(area, state, substep):
    """One pass over all triangles."""
    _project(area, state, substep, False)


@stage(project_back, Area)
@jit
def project_area_back(area, state, substep):
    """The same pass in reverse order."""
    _project(area, state, substep, True)


@jit
def _project(area, state, substep, reverse):
    first, last = area.slots[0], area.slots[1]
    to_records(state, area.records, first, last)
    for number in range(segment_count(area.packs)):
        begin, end, a, b = segment(area.packs, number, len(area.rest_area), reverse)
        _note(area.packs, a, b, area.records, state.apart, area.force)
        _project_packs(area.records, state.apart, area.particles, area.rest_area,
                       area.compliance, area.force, begin, end, reverse)
        collect(area.packs, a, b, area.force, substep.end - substep.begin, state.reaction)
    from_records(state, area.records, first, last)


@jit
def _project_packs(records, apart, particles, rest_area, compliance, force, begin, end, reverse):
    step = lanes(compliance)
    p0, p1, p2 = particles[0], particles[1], particles[2]
    for p in range(begin, end, step):
        q = begin + end - step - p if reverse else p
        x0, y0, z0, m0 = load_records(records, p0, q)
        x1, y1, z1, m1 = load_records(records, p1, q)
        x2, y2, z2, m2 = load_records(records, p2, q)
        ax, ay, az = x1 - x0, y1 - y0, z1 - z0
        bx, by, bz = x2 - x0, y2 - y0, z2 - z0
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        twice = root(fma(nx, nx, fma(ny, ny, nz * nz)))
        there = twice > 0.0
        per = select(there, 0.5 / select(there, twice, 1.0), 0.0)
        nx, ny, nz = per * nx, per * ny, per * nz
        gx, gy, gz = by * nz - bz * ny, bz * nx - bx * nz, bx * ny - by * nx
        hx, hy, hz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
        ex, ey, ez = -(gx + hx), -(gy + hy), -(gz + hz)
        total = fma(m0, fma(ex, ex, fma(ey, ey, ez * ez)), fma(
            m1, fma(gx, gx, fma(gy, gy, gz * gz)), m2 * fma(hx, hx, fma(hy, hy, hz * hz))))
        alpha, f = load(compliance, q), recall(apart, force, q)
        residual = xpbd_residual(0.5 * twice - load(rest_area, q), alpha, f)
        df = select(both(there, total > 0.0), -residual / denominator(apart, total, alpha), 0.0)
        keep(force, q, f, df)
        put_records(records, apart, p0, q, x0, y0, z0, m0, m0 * df, ex, ey, ez)
        put_records(records, apart, p1, q, x1, y1, z1, m1, m1 * df, gx, gy, gz)
        put_records(records, apart, p2, q, x2, y2, z2, m2, m2 * df, hx, hy, hz)


@jit
def _note(packs, first, last, x, apart, force):
    """Note ∇C of the triangles of a pack; those without an area keep their multiplier."""
    if packs is not None:
        remember(packs, first, last, apart, force)
        for k in range(first, last):
            i, j, l = packs.held.particles[k]
            ax, ay, az = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
            bx, by, bz = x[l, 0] - x[i, 0], x[l, 1] - x[i, 1], x[l, 2] - x[i, 2]
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            twice = np.sqrt(nx * nx + ny * ny + nz * nz)
            if twice == 0.0:
                continue
            gradient = packs.gradient[k - first, 0]
            for axis, g, h in ((0, by * nz - bz * ny, ny * az - nz * ay),
                               (1, bz * nx - bx * nz, nz * ax - nx * az),
                               (2, bx * ny - by * nx, nx * ay - ny * ax)):
                gradient[1, axis], gradient[2, axis] = 0.5 * g / twice, 0.5 * h / twice
                gradient[0, axis] = -0.5 * (g + h) / twice


class Triangles:
    """The triangles one by one, in sweep order: the definition in NumPy."""

    def __init__(self, particles, index, rest_area, compliance):
        self.particles = particles
        self.index = index
        self.rest_area = rest_area.astype(float)
        self.compliance = compliance.astype(float)

    @staticmethod
    def of(data: Area) -> 'Triangles':
        """Return the triangles of a batch."""
        index = np.flatnonzero(data.particles[0] != data.particles[1])
        return Triangles(data.particles[:, index].T.astype(np.int64), index,
                         data.rest_area[index], data.compliance[index])

    def _sides(self, x):
        corners = x.T.astype(float)[self.particles]
        return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C [m²], shape (triangles,), from the definition; x is (3, slots)."""
        return 0.5 * length(cross(*self._sides(x))) - self.rest_area

    def energy(self, x: np.ndarray) -> float:
        """Return Σ C² / (2 α) [J]."""
        return float((0.5 * self.residual(x)**2 / self.compliance).sum())

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """Return Σ |∇i| Σ |∇j| / α at each particle [N/m], shape (slots, 3, 3)."""
        a, b = self._sides(x)
        slopes = 0.5 * length(np.stack([a - b, b, a], 1))    # |∇| is half the opposite side
        total = np.zeros(x.shape[1])
        np.add.at(total, self.particles,
                  slopes * slopes.sum(1, keepdims=True) / self.compliance[:, None])
        return total[:, None, None] * np.eye(3)


class BuiltArea(Built):
    """The triangles of all cloths with this effect."""

    def __init__(self, parameters, world):
        super().__init__()
        particles, rest, compliance = [], [], []
        for cloth, chosen in parameters.items():
            a, b, c = (cloth.mesh.positions[cloth.mesh.triangles[:, k]] for k in range(3))
            area = 0.5 * length(cross(b - a, c - a))
            particles.append(cloth.slots[cloth.mesh.triangles])
            rest.append(area)
            compliance.append(world.compliance_scale * area / chosen.stiffness)
        particles, rest, compliance = map(np.concatenate, (particles, rest, compliance))
        dtype, order = world.state.x.dtype, pack(particles)
        count = len(order)
        self.data = Area(
            world.records,
            np.array([particles.min(initial=world.slots), particles.max(initial=-1) + 1]),
            padded(particles, order, world.slots - 1, np.int32).T.copy(),
            padded(rest, order, 0.0, dtype),
            padded(np.minimum(compliance, max_compliance(dtype)), order, max_compliance(dtype),
                   dtype),
            zeros(count, dtype) if world.forces else None,
            packs_for(room_for(count, 3)) if world.pins else None)
        self.constraints = Triangles.of(self.data)

    def hold(self, inv_mass):
        hold_packs(self.data.packs, self.constraints, inv_mass, len(self.data.rest_area))


EFFECT = Effect('area', Parameters, BuiltArea)
