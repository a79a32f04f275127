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
from xpbd_ros.sim.backend.simd import fma, larger, load, root, select
from xpbd_ros.sim.backend.simd_vector3 import fma3
from xpbd_ros.sim.constraints.builders import Packing
from xpbd_ros.sim.constraints.definitions import Constraints
from xpbd_ros.sim.constraints.pinned import Held
from xpbd_ros.sim.constraints.projection import (
    denominator,
    keep,
    max_compliance,
    recall,
    xpbd_residual,
)
from xpbd_ros.sim.effect import Built, Effect, sides_of
from xpbd_ros.sim.geometry.mesh import cross, dot, length, Mesh
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.accumulators import row
from xpbd_ros.sim.stepping.constraint_stages import constraint


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
        most = 1.0 if self.warp is None or self.weft is None else sqrt(self.warp / self.weft)
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


class Membrane(NamedTuple):
    """Triangles in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots of the corners, shape (3, triangles)"""
    force: np.ndarray | None
    """f [N m], shape (3, triangles); None if multipliers are not kept"""
    held: Held | None
    """triangles at pinned particles; None in a scene without pins"""
    colours: np.ndarray | None
    """first constraint of each colour, and the number of places, shape (colours + 1,); None in
    sequential order"""
    inverse: np.ndarray
    """D⁻¹, row after row: p1, q1, p2, q2 [1/m], shape (4, triangles)"""
    compliance: np.ndarray
    """α11, α12, α22, α33 [1/(N m)], shape (4, triangles)"""


@constraint(Membrane, particles=3)
@jit(inline=True)
def solve_membrane(membrane, apart, c, x, m):
    """Solve a vector of triangles from index c on."""
    count, inverse, compliance = membrane.inverse.shape[1], membrane.inverse, membrane.compliance
    p1, q1 = load(inverse, c), load(inverse, count + c)
    p2, q2 = load(inverse, 2 * count + c), load(inverse, 3 * count + c)
    p0, q0 = -(p1 + p2), -(q1 + q2)
    d, e = x[1] - x[0], x[2] - x[0]
    f1, f2 = fma3(p1, d, p2 * e), fma3(q1, d, q2 * e)
    s11, s22, s12 = dot(f1, f1), dot(f2, f2), dot(f1, f2)

    a11, a12 = load(compliance, c), load(compliance, count + c)
    a22, a33 = load(compliance, 2 * count + c), load(compliance, 3 * count + c)
    force = membrane.force
    l1, l2, l3 = recall(apart, row(force, 0), c), recall(apart, row(force, 1), c), recall(
        apart, row(force, 2), c)
    r1 = xpbd_residual(xpbd_residual(0.5 * (s11 - 1.0), a11, l1), a12, l2)
    r2 = xpbd_residual(xpbd_residual(0.5 * (s22 - 1.0), a12, l1), a22, l2)
    r3 = xpbd_residual(s12, a33, l3)

    half, differ = 0.5 * (s11 + s22), 0.5 * (s11 - s22)
    longest = half + root(fma(differ, differ, s12 * s12))
    shortest = larger(fma(s11, s22, -(s12 * s12)), 0.0) / select(longest > 0.0, longest, 1.0)
    squeezed = larger(0.5 * root(shortest) - shortest, 0.0)
    s11, s22 = s11 + squeezed, s22 + squeezed

    pp = fma(m[0] * p0, p0, fma(m[1] * p1, p1, m[2] * p2 * p2))
    qq = fma(m[0] * q0, q0, fma(m[1] * q1, q1, m[2] * q2 * q2))
    pq = fma(m[0] * p0, q0, fma(m[1] * p1, q1, m[2] * p2 * q2))
    b11 = denominator(apart, pp * s11, a11)
    b12 = denominator(apart, pq * s12, a12)
    b22 = denominator(apart, qq * s22, a22)
    b13 = denominator(apart, fma(pp, s12, pq * s11), 0.0)
    b23 = denominator(apart, fma(pq, s22, qq * s12), 0.0)
    b33 = denominator(apart, fma(pp, s22, fma(2.0 * pq, s12, qq * s11)), a33)

    least = 4.0 * np.finfo(inverse.dtype).eps
    k12, k13 = b12 / b11, b13 / b11    # symmetric and positive definite: no pivoting
    c22 = larger(b22 - k12 * b12, least * b22)
    c23 = b23 - k12 * b13
    k23 = c23 / c22
    c33 = larger(b33 - k13 * b13 - k23 * c23, least * b33)
    r2 = r2 - k12 * r1
    r3 = r3 - k13 * r1 - k23 * r2
    d3 = -r3 / c33
    d2 = -r2 / c22 - k23 * d3
    d1 = -r1 / b11 - k12 * d2 - k13 * d3
    keep(row(force, 0), c, l1, d1)
    keep(row(force, 1), c, l2, d2)
    keep(row(force, 2), c, l3, d3)
    p, q = fma3(d1, f1, d3 * f2), fma3(d2, f2, d3 * f1)
    return ((1.0, fma3(p0, p, q0 * q)), (1.0, fma3(p1, p, q1 * q)),
            (1.0, fma3(p2, p, q2 * q)))


@jit
def energy_of(membrane, x):
    """Return Σ Cᵀ α⁻¹ C / 2 [J]."""
    particles, inverse, alpha = membrane.particles, membrane.inverse, membrane.compliance
    total = 0.0
    for c in range(particles.shape[1]):
        i, j, k = particles[0, c], particles[1, c], particles[2, c]
        if i == j:    # an empty place of a pack
            continue
        p1, q1, p2, q2 = inverse[0, c], inverse[1, c], inverse[2, c], inverse[3, c]
        s11 = s22 = s12 = 0.0
        for a in range(3):
            d, e = x[a, j] - x[a, i], x[a, k] - x[a, i]
            f1, f2 = p1 * d + p2 * e, q1 * d + q2 * e
            s11, s22, s12 = s11 + f1 * f1, s22 + f2 * f2, s12 + f1 * f2
        c1, c2, a12 = 0.5 * (s11 - 1.0), 0.5 * (s22 - 1.0), alpha[1, c]
        det = alpha[0, c] * alpha[2, c] - a12 * a12
        total += (alpha[2, c] * c1 * c1 - 2.0 * a12 * c1 * c2 + alpha[0, c] * c2 * c2) / det
        total += s12 * s12 / alpha[3, c]
    return 0.5 * total


@dataclass(eq=False)
class Triangles(Constraints):
    """The triangles one by one: the definition in NumPy."""

    inverse: np.ndarray
    """D⁻¹ [1/m], shape (triangles, 4)"""
    block: np.ndarray
    """α [1/(N m)], shape (triangles, 3, 3); ``compliance`` is its smallest eigenvalue"""

    @classmethod
    def of(cls, batch: Membrane) -> 'Triangles':
        """Return the triangles of a batch."""
        index = np.flatnonzero(batch.particles[0] != batch.particles[1])
        a11, a12, a22, a33 = batch.compliance[:, index].astype(float)
        block = np.zeros((len(index), 3, 3))
        block[:, 0, 0], block[:, 1, 1], block[:, 2, 2] = a11, a22, a33
        block[:, 0, 1] = block[:, 1, 0] = a12
        return cls(batch.particles[:, index].T.astype(np.int64), index,
                   np.linalg.eigvalsh(block)[:, 0], batch.inverse[:, index].T.astype(float), block)

    @property
    def shares(self) -> np.ndarray:
        """p_i and q_i [1/m], shape (triangles, 3 particles, 2)."""
        inverse = self.inverse.reshape(-1, 2, 2)
        return np.concatenate([-inverse.sum(1, keepdims=True), inverse], 1)

    def columns(self, x: np.ndarray) -> np.ndarray:
        """Return F, shape (triangles, 3, 2)."""
        return np.einsum('tik,tia->tka', self.corners(x), self.shares)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return Green's strain, shape (triangles, 3)."""
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
        packing, most = Packing(particles, world), max_compliance(world.state.x.dtype)
        compliance, none = np.concatenate(compliance), most * np.array([1.0, 0.0, 1.0, 1.0])
        soft = np.abs(compliance).max(1, keepdims=True) > most
        self.data = Membrane(**packing.common((3,)), inverse=packing.column(inverse),
                             compliance=packing.column(np.where(soft, none, compliance), none))
        self.constraints = Triangles.of(self.data)
        self.sides = sides_of(parameters)

    def stored_energy(self, state):
        return energy_of(self.data, state.x)


EFFECT = Effect('membrane', Parameters, BuiltMembrane)
