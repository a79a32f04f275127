"""
Membrane: finite-element triangles with moduli along warp and weft and a free Poisson's ratio.

With rest edges D = (X1 - X0, X2 - X0) in axes along warp and weft and F = (x1 - x0, x2 - x0) D⁻¹,
of columns f1 and f2, each triangle is one constraint with three components, Green's strain:

    C = (E11, E22, γ12) = ((f1·f1 - 1) / 2, (f2·f2 - 1) / 2, f1·f2)
    ∂E11/∂x_i = p_i f1,  ∂E22/∂x_i = q_i f2,  ∂γ12/∂x_i = p_i f2 + q_i f1

(p and q: the columns of D⁻¹ for particles 1 and 2, minus their sum for particle 0;
doc/numerics.md 5.4). The energy is A Cᵀ S C / 2 (St. Venant-Kirchhoff in plane stress), so
α = S⁻¹ / A:

    S⁻¹ = ((1/Y1, -ν/Y1, 0), (-ν/Y1, 1/Y2, 0), (0, 0, 1/G))

and the three multipliers are solved together (Macklin et al. 2016, eq 18 as a block): with
mobilities m = w H², P = Σ m p², Q = Σ m q², R = Σ m p q and s_ab = f_a·f_b,

    (J M Jᵀ + α) Δf = -(C + α f),   J M Jᵀ = ((P s11, R s12, P s12 + R s11), (…, Q s22,
    R s22 + Q s12), (…, …, P s22 + 2 R s12 + Q s11))

Green's strain hardly changes when a triangle is squeezed flat: a full step from the stretch σ
would end at 1 / (2 σ). Where the smallest stretch is below 1/2, J M Jᵀ has s11 + (σ/2 - σ²) and
s22 + (σ/2 - σ²) instead; the step ends near the rest length, and states of rest are unchanged.

Limits: in compression the force fades, and at zero length it vanishes. Stretched by a fifth, the
triangle is a third stiffer than Hooke's law. The warp of a curved mesh is its one direction,
projected onto each triangle.
"""

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import fma, lanes, larger, load, root, select
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
    row,
    xpbd_residual,
    zero_multipliers,
)
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.geometry.mesh import cross, dot, length, Mesh
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.records import from_records, put_records, to_records
from xpbd_ros.sim.stepping.stages import prepare, project, project_back, stage


@dataclass(frozen=True)
class Parameters:
    """Either moduli along warp and weft and of shear, or Young's modulus."""

    warp: float | None = quantity(None, unit='N/m', above=0.0, live=True,
                                  doc='modulus of a strip pulled along warp')
    weft: float | None = quantity(None, unit='N/m', above=0.0, live=True,
                                  doc='modulus of a strip pulled along weft')
    shear: float | None = quantity(None, unit='N/m', above=0.0, live=True, doc='shear modulus')
    young: float | None = quantity(None, unit='N/m', above=0.0, live=True,
                                   doc='modulus of a sheet that is alike in all directions')
    poisson: float = quantity(0.0, live=True,
                              doc='contraction along weft per stretch along warp')

    def __post_init__(self):
        """Require exactly one of the two forms, and a positive definite S."""
        threads = (self.warp, self.weft, self.shear)
        if self.young is None and None in threads or (
                self.young is not None and threads != (None, None, None)):
            raise InputError('needs either warp, weft and shear (N/m), or young (N/m), from which '
                             'shear follows')
        y1, y2, _ = self.moduli
        most = sqrt(y1 / y2)
        if abs(self.poisson) >= most:
            reason = '' if self.young is not None else ' = sqrt(warp / weft)'
            raise InputError(f'poisson: must be between -{most:.4g} and {most:.4g}{reason} (got '
                             f'{self.poisson:g}): beyond, the sheet would gain energy by being '
                             'stretched')

    @property
    def moduli(self) -> tuple[float, float, float]:
        """Y1, Y2 and G [N/m]."""
        if self.young is not None:
            return self.young, self.young, 0.5 * self.young / (1.0 + self.poisson)
        assert self.warp is not None and self.weft is not None and self.shear is not None
        return self.warp, self.weft, self.shear

    @property
    def compliance(self) -> np.ndarray:
        """S⁻¹ as (1/Y1, -ν/Y1, 1/Y2, 1/G) [m/N]."""
        y1, y2, g = self.moduli
        with np.errstate(over='ignore'):
            return np.array([1.0, -self.poisson, 1.0, 1.0]) / np.array([y1, y1, y2, g])


class Held(NamedTuple):
    """The triangles at pinned particles, whose reaction forces are summed up."""

    count: np.ndarray
    """shape (1,)"""
    particles: np.ndarray
    """slots, shape (room, 3)"""
    index: np.ndarray
    """index of each one's force, shape (room,)"""
    inverse: np.ndarray
    """D⁻¹, shape (room, 4)"""


class Membrane(NamedTuple):
    """Triangles in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots of the corners, shape (3, triangles)"""
    inverse: np.ndarray
    """D⁻¹, row after row: p1, q1, p2, q2 [1/m], shape (4, triangles)"""
    compliance: np.ndarray
    """α11, α12, α22, α33 [1/(N m)], shape (4, triangles)"""
    force: np.ndarray | None
    """f [N m], shape (3, triangles); None if multipliers are not kept"""
    packs: Packs | None
    """triangles at pinned particles; None in a scene without pins"""


@stage(prepare, Membrane)
@jit
def prepare_membrane(membrane, state, substep):
    """Zero the multipliers."""
    zero_multipliers(state.apart, membrane.force)


@stage(project, Membrane)
@jit
def project_membrane(membrane, state, substep):
    """One pass over all triangles."""
    _project(membrane, state, substep, False)


@stage(project_back, Membrane)
@jit
def project_membrane_back(membrane, state, substep):
    """The same pass in reverse order."""
    _project(membrane, state, substep, True)


@jit
def _project(membrane, state, substep, reverse):
    first, last = membrane.slots[0], membrane.slots[1]
    to_records(state, membrane.records, first, last)
    for number in range(segment_count(membrane.packs)):
        begin, end, a, b = segment(membrane.packs, number, membrane.particles.shape[1], reverse)
        _note(membrane.packs, a, b, membrane.records, state.apart, membrane.force)
        _project_packs(membrane.records, state.apart, membrane.particles, membrane.inverse,
                       membrane.compliance, row(membrane.force, 0), row(membrane.force, 1),
                       row(membrane.force, 2), 4.0 * np.finfo(state.x.dtype).eps, begin, end,
                       reverse)
        collect(membrane.packs, a, b, membrane.force, substep.end - substep.begin,
                state.reaction)
    from_records(state, membrane.records, first, last)


@jit
def _project_packs(records, apart, particles, inverse, compliance, force1, force2, force3, least,
                   begin, end, reverse):
    i0, i1, i2 = particles[0], particles[1], particles[2]
    p_1, q_1, p_2, q_2 = inverse[0], inverse[1], inverse[2], inverse[3]
    a_11, a_12, a_22, a_33 = compliance[0], compliance[1], compliance[2], compliance[3]
    step = lanes(p_1)
    for t in range(begin, end, step):
        k = begin + end - step - t if reverse else t
        x0, y0, z0, m0 = load_records(records, i0, k)
        x1, y1, z1, m1 = load_records(records, i1, k)
        x2, y2, z2, m2 = load_records(records, i2, k)
        p1, q1, p2, q2 = load(p_1, k), load(q_1, k), load(p_2, k), load(q_2, k)
        p0, q0 = -(p1 + p2), -(q1 + q2)
        dx, dy, dz, ex, ey, ez = x1 - x0, y1 - y0, z1 - z0, x2 - x0, y2 - y0, z2 - z0
        fx, fy, fz = fma(p1, dx, p2 * ex), fma(p1, dy, p2 * ey), fma(p1, dz, p2 * ez)
        gx, gy, gz = fma(q1, dx, q2 * ex), fma(q1, dy, q2 * ey), fma(q1, dz, q2 * ez)
        s11 = fma(fx, fx, fma(fy, fy, fz * fz))
        s22 = fma(gx, gx, fma(gy, gy, gz * gz))
        s12 = fma(fx, gx, fma(fy, gy, fz * gz))

        a11, a12, a22, a33 = load(a_11, k), load(a_12, k), load(a_22, k), load(a_33, k)
        f1, f2, f3 = recall(apart, force1, k), recall(apart, force2, k), recall(apart, force3, k)
        r1 = xpbd_residual(xpbd_residual(0.5 * (s11 - 1.0), a11, f1), a12, f2)
        r2 = xpbd_residual(xpbd_residual(0.5 * (s22 - 1.0), a12, f1), a22, f2)
        r3 = xpbd_residual(s12, a33, f3)

        half, apart_ = 0.5 * (s11 + s22), 0.5 * (s11 - s22)
        longest = half + root(fma(apart_, apart_, s12 * s12))
        shortest = larger(fma(s11, s22, -(s12 * s12)), 0.0) / select(longest > 0.0, longest, 1.0)
        squeezed = larger(0.5 * root(shortest) - shortest, 0.0)
        s11, s22 = s11 + squeezed, s22 + squeezed

        pp = fma(m0 * p0, p0, fma(m1 * p1, p1, m2 * p2 * p2))
        qq = fma(m0 * q0, q0, fma(m1 * q1, q1, m2 * q2 * q2))
        pq = fma(m0 * p0, q0, fma(m1 * p1, q1, m2 * p2 * q2))
        b11 = denominator(apart, pp * s11, a11)
        b12 = denominator(apart, pq * s12, a12)
        b22 = denominator(apart, qq * s22, a22)
        b13 = denominator(apart, fma(pp, s12, pq * s11), 0.0)
        b23 = denominator(apart, fma(pq, s22, qq * s12), 0.0)
        b33 = denominator(apart, fma(pp, s22, fma(2.0 * pq, s12, qq * s11)), a33)

        l12, l13 = b12 / b11, b13 / b11    # symmetric and positive definite: no pivoting
        c22 = larger(b22 - l12 * b12, least * b22)
        c23 = b23 - l12 * b13
        l23 = c23 / c22
        c33 = larger(b33 - l13 * b13 - l23 * c23, least * b33)
        r2 = r2 - l12 * r1
        r3 = r3 - l13 * r1 - l23 * r2
        d3 = -r3 / c33
        d2 = -r2 / c22 - l23 * d3
        d1 = -r1 / b11 - l12 * d2 - l13 * d3
        keep(force1, k, f1, d1)
        keep(force2, k, f2, d2)
        keep(force3, k, f3, d3)

        px, py, pz = fma(fx, d1, gx * d3), fma(fy, d1, gy * d3), fma(fz, d1, gz * d3)
        qx, qy, qz = fma(gx, d2, fx * d3), fma(gy, d2, fy * d3), fma(gz, d2, fz * d3)
        put_records(records, apart, i0, k, x0, y0, z0, m0, m0, fma(p0, px, q0 * qx),
                    fma(p0, py, q0 * qy), fma(p0, pz, q0 * qz))
        put_records(records, apart, i1, k, x1, y1, z1, m1, m1, fma(p1, px, q1 * qx),
                    fma(p1, py, q1 * qy), fma(p1, pz, q1 * qz))
        put_records(records, apart, i2, k, x2, y2, z2, m2, m2, fma(p2, px, q2 * qx),
                    fma(p2, py, q2 * qy), fma(p2, pz, q2 * qz))


@jit
def _note(packs, first, last, x, apart, force):
    """Note the rows of J of a pack's triangles."""
    if packs is not None:
        remember(packs, first, last, apart, force)
        for h in range(first, last):
            i0, i1, i2 = packs.held.particles[h]
            p1, q1, p2, q2 = packs.held.inverse[h]
            rows = packs.gradient[h - first]
            for k in range(3):
                d, e = x[i1, k] - x[i0, k], x[i2, k] - x[i0, k]
                f, g = p1 * d + p2 * e, q1 * d + q2 * e
                for c, p, q in ((0, -(p1 + p2), -(q1 + q2)), (1, p1, q1), (2, p2, q2)):
                    rows[0, c, k], rows[1, c, k], rows[2, c, k] = p * f, q * g, p * g + q * f


class Triangles:
    """The triangles one by one, in sweep order: the definition in NumPy."""

    def __init__(self, particles, index, inverse, block):
        self.particles = particles
        self.index = index
        self.inverse = inverse
        self.block = block
        """α [1/(N m)], shape (triangles, 3, 3)"""

    @staticmethod
    def of(data: Membrane) -> 'Triangles':
        """Return the triangles of a batch."""
        index = np.flatnonzero(data.particles[0] != data.particles[1])
        a11, a12, a22, a33 = data.compliance[:, index].astype(float)
        block = np.zeros((len(index), 3, 3))
        block[:, 0, 0], block[:, 1, 1], block[:, 2, 2] = a11, a22, a33
        block[:, 0, 1] = block[:, 1, 0] = a12
        return Triangles(data.particles[:, index].T.astype(np.int64), index,
                         data.inverse[:, index].T.astype(float), block)

    @property
    def compliance(self) -> np.ndarray:
        """Smallest eigenvalue of α [1/(N m)], shape (triangles,)."""
        return np.linalg.eigvalsh(self.block)[:, 0]

    @property
    def shares(self) -> np.ndarray:
        """p_i and q_i [1/m], shape (triangles, 3 particles, 2)."""
        inverse = self.inverse.reshape(-1, 2, 2)
        return np.concatenate([-inverse.sum(1, keepdims=True), inverse], 1)

    def columns(self, x: np.ndarray) -> np.ndarray:
        """Return F, shape (triangles, 3, 2)."""
        return np.einsum('tik,tia->tka', x.T.astype(float)[self.particles], self.shares)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return Green's strain, shape (triangles, 3), from the definition."""
        f = self.columns(x)
        s = np.einsum('tka,tkb->tab', f, f)
        return np.stack([0.5 * (s[:, 0, 0] - 1.0), 0.5 * (s[:, 1, 1] - 1.0), s[:, 0, 1]], 1)

    def energy(self, x: np.ndarray) -> float:
        """Return Σ Cᵀ α⁻¹ C / 2 [J]."""
        strain = self.residual(x)
        stress = np.linalg.solve(self.block, strain[..., None])[..., 0]
        return float(0.5 * (strain * stress).sum())

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return ∂C/∂x [1/m], shape (triangles, 3 components, 3 particles, 3)."""
        f, share = self.columns(x), self.shares
        one, two = (share[:, :, a, None] * f[:, None, :, a] for a in (0, 1))
        mixed = share[:, :, 0, None] * f[:, None, :, 1] + share[:, :, 1, None] * f[:, None, :, 0]
        return np.stack([one, two, mixed], 1)

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """Return 3 Σ J_iᵀ α⁻¹ J_i at each particle [N/m], (slots, 3, 3): K at rest is no more."""
        jacobian = self.jacobian(x)
        blocks = 3.0 * np.einsum('tcik,tcd,tdil->tikl', jacobian, np.linalg.inv(self.block),
                                 jacobian)
        found = np.zeros((x.shape[1], 3, 3))
        np.add.at(found, self.particles, blocks)
        return found


def inverse_rest_edges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """
    Return D⁻¹ of each triangle [1/m] and its area [m²].

    The first axis is the warp, projected onto the triangle; where the warp is normal to it, the
    first edge.

    Returns
    -------
    shapes (triangles, 2, 2) and (triangles,)

    """
    corners = mesh.positions[mesh.triangles]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = cross(one, two)
    double = length(normal)
    normal = normal / double[:, None]
    warp = np.asarray(mesh.warp, float)
    along = warp - dot(normal, warp)[:, None] * normal
    upright = length(along) < 1e-6    # of a unit vector
    along[upright] = one[upright]
    along /= length(along)[:, None]
    across = cross(normal, along)
    edges = np.stack([np.stack([dot(along, d), dot(across, d)], 1) for d in (one, two)], 2)
    return np.linalg.inv(edges), 0.5 * double


class BuiltMembrane(Built):
    """The triangles of all cloths with this effect."""

    def __init__(self, parameters, world):
        super().__init__()
        particles, inverse, compliance = [], [], []
        for cloth, chosen in parameters.items():
            inverted, area = inverse_rest_edges(cloth.mesh)
            particles.append(cloth.slots[cloth.mesh.triangles])
            inverse.append(inverted.reshape(-1, 4))
            compliance.append(world.compliance_scale * chosen.compliance / area[:, None])
        dtype = world.state.x.dtype
        particles, inverse, compliance = map(np.concatenate, (particles, inverse, compliance))
        none = max_compliance(dtype) * np.array([1.0, 0.0, 1.0, 1.0])
        soft = np.abs(compliance).max(1, keepdims=True) > max_compliance(dtype)
        compliance = np.where(soft, none, compliance)
        order = pack(particles)
        self.data = Membrane(
            world.records,
            np.array([particles.min(initial=0), particles.max(initial=-1) + 1]),
            padded(particles, order, world.slots - 1, np.int32).T.copy(),
            padded(inverse, order, 0.0, dtype).T.copy(),
            padded(compliance, order, none, dtype).T.copy(),
            zeros((3, len(order)), dtype) if world.forces else None,
            packs_for(Held(*room_for(len(order), 3), np.zeros((len(order), 4))), 3)
            if world.pins else None)
        self.constraints = Triangles.of(self.data)

    def hold(self, inv_mass):
        hold_packs(self.data.packs, self.constraints, inv_mass, self.data.particles.shape[1])


EFFECT = Effect('membrane', Parameters, BuiltMembrane)
