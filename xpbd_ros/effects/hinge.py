"""
Hinge: bending stiffness by dihedral angles, for flat and for curved rest shapes.

For the edge (x0, x1) with opposite particles x2, x3, e = x1 - x0, n1 = e × (x2 - x0) and
n2 = (x3 - x0) × e (``constraints.hinges``; doc/numerics.md 5.6),

    C = θ - θ0,   θ = atan2((n1 × n2)·e / |e|, n1·n2) = atan2(-|e| n1·(x3 - x0), n1·n2)
    g2 = -|e| n1 / |n1|²,   g3 = -|e| n2 / |n2|²,   g1 = t1 n1 / |n1|² + t2 n2 / |n2|²
    g0 = -g1 - g2 - g3,   t1 = (x2 - x0)·e / |e|,   t2 = (x3 - x0)·e / |e|

with the energy B |e|² C² / (2 (A0 + A1)) of the rest shape, so α = (A0 + A1) / (B |e|²) [1/(N m)].
In force form Δf = -(C + α f) / (W + α), x_i += m_i g_i Δf, with W = Σ m_i |g_i|². The angle
continues beyond ±180°: of the angles that differ by whole turns it is the one nearest to the last.
On a flat mesh each hinge has its own B, fitted so that the sheet bends as a plate
(``constraints.plate_rigidity``).

A hinge with a triangle without height (below 1e-12 of its edge; 5e-4 in float32) has no angle: it
is not projected until it has one again.

Limits: a fold turns by less than half a turn per substep. On a curved irregular mesh the rigidity
depends on the triangles: on a cylinder 1.04 to 1.43 of B (doc/numerics.md 5.7).
"""

from dataclasses import dataclass
from math import pi
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, fma, lanes, load, nearest, root, select, store
from xpbd_ros.sim.backend.simd_records import load_records
from xpbd_ros.sim.constraints.atan2 import angle_of
from xpbd_ros.sim.constraints.distance import max_compliance
from xpbd_ros.sim.constraints.hinges import all_hinges, dihedral, rigidity, slenderness
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
from xpbd_ros.sim.constraints.plate_rigidity import plate, shortfall
from xpbd_ros.sim.constraints.projection import (
    denominator,
    keep,
    recall,
    xpbd_residual,
    zero_multipliers,
)
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.geometry.closest_points import cross as cross_3, dot as dot_3
from xpbd_ros.sim.geometry.mesh import cross, dot, length
from xpbd_ros.sim.parameters import need_one_or_two, quantity
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.records import from_records, put_records, to_records
from xpbd_ros.sim.stepping.stages import prepare, project, project_back, stage


@dataclass(frozen=True)
class Parameters:
    """One bending rigidity, or one each along warp and weft."""

    stiffness: float | None = quantity(None, unit='N m', above=0.0, live=True,
                                       doc='bending rigidity B, alike in all directions')
    warp: float | None = quantity(None, unit='N m', above=0.0, live=True,
                                  doc='bending rigidity of a strip along warp')
    weft: float | None = quantity(None, unit='N m', above=0.0, live=True,
                                  doc='bending rigidity of a strip along weft')

    def __post_init__(self):
        """Require exactly one of the two forms."""
        need_one_or_two(self.stiffness, (self.warp, self.weft), both='warp and weft (N m)',
                        either='stiffness, or warp and weft (N m)')

    @property
    def rigidities(self) -> tuple[float, float]:
        """B along warp and along weft [N m]."""
        if self.stiffness is not None:
            return self.stiffness, self.stiffness
        assert self.warp is not None and self.weft is not None
        return self.warp, self.weft


class Hinge(NamedTuple):
    """Hinges in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots: edge start, edge end, opposite, opposite; shape (4, hinges)"""
    rest_angle: np.ndarray
    """[rad], shape (hinges,)"""
    compliance: np.ndarray
    """[1/(N m)], shape (hinges,)"""
    angle: np.ndarray
    """last angle [rad], with whole turns; shape (hinges,)"""
    force: np.ndarray | None
    """f [N m], shape (hinges,); None if multipliers are not kept"""
    packs: Packs | None
    """hinges at pinned particles; None in a scene without pins"""


@stage(prepare, Hinge)
@jit
def prepare_hinge(hinge, state, substep):
    """Zero the multipliers."""
    zero_multipliers(state.apart, hinge.force)


@stage(project, Hinge)
@jit
def project_hinge(hinge, state, substep):
    """One pass over all hinges."""
    _project(hinge, state, substep, False)


@stage(project_back, Hinge)
@jit
def project_hinge_back(hinge, state, substep):
    """The same pass in reverse order."""
    _project(hinge, state, substep, True)


@jit
def _project(hinge, state, substep, reverse):
    first, last = hinge.slots[0], hinge.slots[1]
    to_records(state, hinge.records, first, last)
    for number in range(segment_count(hinge.packs)):
        begin, end, a, b = segment(hinge.packs, number, len(hinge.rest_angle), reverse)
        _note(hinge.packs, a, b, hinge.records, state.apart, hinge.force)
        _project_packs(hinge.records, state.apart, hinge.particles, hinge.rest_angle,
                       hinge.compliance, hinge.angle, hinge.force,
                       (4096.0 * np.finfo(state.x.dtype).eps)**2, begin, end, reverse)
        collect(hinge.packs, a, b, hinge.force, substep.end - substep.begin, state.reaction)
    from_records(state, hinge.records, first, last)


@jit
def _project_packs(records, apart, particles, rest_angle, compliance, angle, force, flat,
                   begin, end, reverse):
    i0, i1, i2, i3 = particles[0], particles[1], particles[2], particles[3]
    step = lanes(rest_angle)
    for p in range(begin, end, step):
        q = begin + end - step - p if reverse else p
        x0, y0, z0, m0 = load_records(records, i0, q)
        x1, y1, z1, m1 = load_records(records, i1, q)
        x2, y2, z2, m2 = load_records(records, i2, q)
        x3, y3, z3, m3 = load_records(records, i3, q)
        ex, ey, ez = x1 - x0, y1 - y0, z1 - z0
        ax, ay, az = x2 - x0, y2 - y0, z2 - z0
        bx, by, bz = x3 - x0, y3 - y0, z3 - z0
        nx, ny, nz = fma(ey, az, -(ez * ay)), fma(ez, ax, -(ex * az)), fma(ex, ay, -(ey * ax))
        ox, oy, oz = fma(by, ez, -(bz * ey)), fma(bz, ex, -(bx * ez)), fma(bx, ey, -(by * ex))
        square = fma(ex, ex, fma(ey, ey, ez * ez))
        n_n = fma(nx, nx, fma(ny, ny, nz * nz))
        o_o = fma(ox, ox, fma(oy, oy, oz * oz))
        n_o = fma(nx, ox, fma(ny, oy, nz * oz))
        n_b = fma(nx, bx, fma(ny, by, nz * bz))
        least = flat * square * square
        open_ = both(n_n > least, o_o > least)
        l = select(open_, root(square), 1.0)
        r1, r2 = 1.0 / select(open_, n_n, 1.0), 1.0 / select(open_, o_o, 1.0)
        last = load(angle, q)
        now = angle_of(-(l * n_b), n_o)
        now = fma(2.0 * pi, nearest((last - now) * (0.5 / pi)), now)
        now = select(open_, now, last)
        store(angle, q, now)

        t1 = fma(ax, ex, fma(ay, ey, az * ez)) / l
        t2 = fma(bx, ex, fma(by, ey, bz * ez)) / l
        s1, s2, mixed = l - t1, l - t2, 2.0 * n_o * r1 * r2
        w0 = fma(s1 * s1, r1, fma(s2 * s2, r2, s1 * s2 * mixed))
        w1 = fma(t1 * t1, r1, fma(t2 * t2, r2, t1 * t2 * mixed))
        total = fma(m0, w0, fma(m1, w1, square * fma(m2, r1, m3 * r2)))
        alpha, f = load(compliance, q), recall(apart, force, q)
        df = select(both(open_, total > 0.0), -xpbd_residual(now - load(rest_angle, q), alpha, f)
                    / denominator(apart, total, alpha), 0.0)
        keep(force, q, f, df)
        ux, uy, uz = r1 * nx, r1 * ny, r1 * nz
        vx, vy, vz = r2 * ox, r2 * oy, r2 * oz
        d0, d1, dl = m0 * df, m1 * df, -(l * df)
        put_records(records, apart, i0, q, x0, y0, z0, m0, d0, fma(s1, ux, s2 * vx),
                    fma(s1, uy, s2 * vy), fma(s1, uz, s2 * vz))
        put_records(records, apart, i1, q, x1, y1, z1, m1, d1, fma(t1, ux, t2 * vx),
                    fma(t1, uy, t2 * vy), fma(t1, uz, t2 * vz))
        put_records(records, apart, i2, q, x2, y2, z2, m2, m2 * dl, ux, uy, uz)
        put_records(records, apart, i3, q, x3, y3, z3, m3, m3 * dl, vx, vy, vz)


@jit(inline=True)
def way(x, i, j):
    """Return the vector from record i to record j."""
    return x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]


@jit
def _note(packs, first, last, records, apart, force):
    """Note g_i of the hinges of a pack; those without an angle keep their multiplier."""
    if packs is not None:
        remember(packs, first, last, apart, force)
        for h in range(first, last):
            i0, i1, i2, i3 = packs.held.particles[h]
            e, a, b = way(records, i0, i1), way(records, i0, i2), way(records, i0, i3)
            n, o = cross_3(e, a), cross_3(b, e)
            l, n_n, o_o = np.sqrt(dot_3(e, e)), dot_3(n, n), dot_3(o, o)
            if n_n == 0.0 or o_o == 0.0:
                continue
            t1, t2, g = dot_3(a, e) / l, dot_3(b, e) / l, packs.gradient[h - first, 0]
            for k in range(3):
                u, v = n[k] / n_n, o[k] / o_o
                g[0, k], g[1, k] = (l - t1) * u + (l - t2) * v, t1 * u + t2 * v
                g[2, k], g[3, k] = -l * u, -l * v


class Angles:
    """The hinges one by one, in sweep order: the definition in NumPy."""

    def __init__(self, particles, index, rest_angle, compliance, angle):
        self.particles = particles
        self.index = index
        self.rest_angle = rest_angle.astype(float)
        self.compliance = compliance.astype(float)
        self._angle = angle

    @staticmethod
    def of(data: Hinge) -> 'Angles':
        """Return the hinges of a batch."""
        index = np.flatnonzero(data.particles[0] != data.particles[1])
        return Angles(data.particles[:, index].T.astype(np.int64), index,
                      data.rest_angle[index], data.compliance[index], data.angle)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C [rad], shape (hinges,), from the definition, nearest to the last angle."""
        angle = dihedral(x.T.astype(float)[self.particles])
        turns = np.round((self._angle[self.index] - angle) / (2.0 * pi))
        return angle + 2.0 * pi * turns - self.rest_angle

    def energy(self, x: np.ndarray) -> float:
        """Return Σ C² / (2 α) [J]."""
        return float((0.5 * self.residual(x)**2 / self.compliance).sum())

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """Return 4 Σ g_i g_iᵀ / α at each particle [N/m], shape (slots, 3, 3): K is no more."""
        x0, x1, x2, x3 = (x.T.astype(float)[self.particles[:, k]] for k in range(4))
        e, a, b = x1 - x0, x2 - x0, x3 - x0
        l = length(e)[:, None]
        u, v = cross(e, a), cross(b, e)
        u, v = u / dot(u, u)[:, None], v / dot(v, v)[:, None]
        t1, t2 = dot(a, e)[:, None] / l, dot(b, e)[:, None] / l
        found = np.zeros((x.shape[1], 3, 3))
        for k, g in enumerate(((l - t1) * u + (l - t2) * v, t1 * u + t2 * v, -l * u, -l * v)):
            np.add.at(found, self.particles[:, k], 4.0 / self.compliance[:, None, None]
                      * g[:, :, None] * g[:, None, :])
        return found


class BuiltHinge(Built):
    """The hinges of all cloths with this effect."""

    def __init__(self, parameters, world):
        super().__init__()
        particles, rest, compliance = [], [], []
        for cloth, chosen in parameters.items():
            mesh = cloth.mesh
            these, share = all_hinges(mesh)
            if mesh.grid is not None:
                b = share * rigidity(mesh, these, *chosen.rigidities)
            else:
                found = plate(mesh, *chosen.rigidities)
                b, short = found.rigidity, shortfall(found, *chosen.rigidities)
                self.notes += [f'cloths.{cloth.name}.effects.hinge: {short}'] if short else []
            corners = mesh.positions[these]
            particles.append(cloth.slots[these])
            rest.append(dihedral(corners))
            with np.errstate(over='ignore', divide='ignore'):
                compliance.append(world.compliance_scale / (b * slenderness(corners)))
        dtype = world.state.x.dtype
        particles, rest, compliance = map(np.concatenate, (particles, rest, compliance))
        order = pack(particles)
        rest = padded(rest, order, 0.0, dtype)
        angle = zeros(len(order), dtype)
        angle[:] = rest
        self.data = Hinge(
            world.records,
            np.array([particles.min(initial=0), particles.max(initial=-1) + 1]),
            padded(particles, order, world.slots - 1, np.int32).T.copy(), rest,
            padded(np.minimum(compliance, max_compliance(dtype)), order, max_compliance(dtype),
                   dtype), angle,
            zeros(len(order), dtype) if world.forces else None,
            packs_for(room_for(len(order), 4)) if world.pins else None)
        self._before = angle.copy()
        self.constraints = Angles.of(self.data)

    def hold(self, inv_mass):
        hold_packs(self.data.packs, self.constraints, inv_mass, len(self.data.rest_angle))

    def begin(self, clock, state):
        self._before[:] = self.data.angle

    def again(self):
        self.data.angle[:] = self._before

    def reset(self, state, now_ns):
        self.data.angle[:] = self.data.rest_angle

    def adopt(self, old):
        self.data.angle[:] = old.data.angle


EFFECT = Effect('hinge', Parameters, BuiltHinge)
