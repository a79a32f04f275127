"""
Volume: elastic bodies of tetrahedra, stable neo-Hookean, two coupled constraints each.

With the deformation gradient F = [f1 f2 f3] = [x1-x0, x2-x0, x3-x0] Dm⁻¹, n = sqrt(tr FᵀF) and
J = det F, the energy of a rest volume V0 is V0 (μ/2 C_D² + λ/2 C_H²), that is, C_D² / (2 α_D) +
C_H² / (2 α_H) with

    C_D² = n² - 3 - 2 (J - 1) + 8/9 (J - 1)² + (n - √3)² / 3,  α_D = 1 / (μ V0);
    C_H = J - 1,                                               α_H = 1 / (λ V0),

Lamé's λ and μ of the given Young's modulus and Poisson's ratio. It is the energy of Smith et al.
2018 (stable neo-Hookean) with another barrier: theirs is -log(n² + 1), and here n is kept near √3
like the length of an edge. Without a barrier C_D is 0 in a point as well as at rest, and a
tetrahedron crushed to a point stays there; with theirs it leaves the more slowly the nearer it is.
Here C_D² > 0 except at rest (by AM-GM n² ≥ 3 |J|^⅔, and the right side falls up to J = 1 and then
rises), and a crushed tetrahedron is pushed out by a force that does not vanish. In a point F / n
is undefined and taken to be that of the rest shape, oriented as in the scene's file: the same in
every run.

In this split both constraints are 0 at rest. Macklin and Müller 2021 take sqrt(tr FᵀF)
and J - 1 - μ/(λ+μ), whose forces cancel at rest: with a substep of more than about sqrt(ρ / E)
times the size of a tetrahedron that is unstable, and the split here is not (doc/numerics.md 5.9).
The gradients are [∇1 ∇2 ∇3] = P Dm⁻ᵀ, ∇0 = -∇1 - ∇2 - ∇3, with

    P_D = (F - cof F + 8/9 (J - 1) cof F + (n - √3)/3 F/n) / C_D,
    P_H = cof F = [f2×f3, f3×f1, f1×f2].

Both are solved together: J M Jᵀ + α, 2 by 2, after C_H's gradient is made orthogonal to C_D's, so
that no digits cancel in stiff bodies. det F is a polynomial: flat and inverted tetrahedra pass
through and recover.

Limits: 0 ≤ poisson < 0.5; linear tetrahedra lock near 0.5, and in bending where they are few.
"""

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import fma, larger, load, root, select
from xpbd_ros.sim.backend.simd_vector3 import fma3, vector3
from xpbd_ros.sim.constraints.builders import Packing
from xpbd_ros.sim.constraints.definitions import Constraints, isotropic
from xpbd_ros.sim.constraints.pinned import Held
from xpbd_ros.sim.constraints.projection import (
    denominator,
    keep,
    max_compliance,
    recall,
    xpbd_residual,
)
from xpbd_ros.sim.effect import Built, Effect, sides_of
from xpbd_ros.sim.geometry.mesh import cross, dot
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.accumulators import row
from xpbd_ros.sim.stepping.constraint_stages import constraint

SMALL = 8.0
"""tr FᵀF below which C_D is computed from the strain, since at rest its terms cancel"""
REST = 3.0**0.5
"""n at rest"""


@dataclass(frozen=True)
class Parameters:
    """Young's modulus and Poisson's ratio."""

    young: float = quantity(unit='Pa', above=0.0, live=True, doc="Young's modulus")
    poisson: float = quantity(0.3, minimum=0.0, live=True, doc="Poisson's ratio, below 0.5")

    def __post_init__(self):
        """Require a finite bulk modulus."""
        if self.poisson >= 0.5:
            raise InputError(f'poisson: must be < 0.5 (got {self.poisson:g}); 0.49 or 0.499 keeps '
                             'the volume nearly')

    @property
    def lame(self) -> tuple[float, float]:
        """Lamé's λ and μ [Pa]."""
        young, nu = self.young, self.poisson
        return (young * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)), 0.5 * young / (1.0 + nu))


class Volume(NamedTuple):
    """Tetrahedra in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots, shape (4, tetrahedra)"""
    force: np.ndarray | None
    """f of C_D and of C_H, multipliers over H² [J], shape (2, tetrahedra); None if multipliers are
    not kept"""
    held: Held | None
    """tetrahedra at pinned particles; None in a scene without pins"""
    colours: np.ndarray | None
    """first constraint of each colour, and the number of places, shape (colours + 1,); None in
    sequential order"""
    inverse: np.ndarray
    """Dm⁻¹ [1/m], row after row, shape (9, tetrahedra)"""
    compliance: np.ndarray
    """α_D and α_H [1/J], shape (2, tetrahedra)"""


@jit(inline=True)
def mix(a, x, b, y, c, z):
    """Return a x + b y + c z."""
    return fma(a, x, fma(b, y, c * z))


@jit(inline=True)
def mix3(a, x, b, y, c, z):
    """Return a x + b y + c z of Vector3 x, y and z."""
    return fma3(a, x, fma3(b, y, c * z))


@jit(inline=True)
def gradients(p, b):
    """Return ∇0 … ∇3 from the columns of P and the rows of Dm⁻¹."""
    p1, p2, p3 = p
    b11, b12, b13, b21, b22, b23, b31, b32, b33 = b
    g1, g2 = mix3(b11, p1, b12, p2, b13, p3), mix3(b21, p1, b22, p2, b23, p3)
    g3 = mix3(b31, p1, b32, p2, b33, p3)
    return -(g1 + g2 + g3), g1, g2, g3


@jit(inline=True)
def inner(m, g, h):
    """Return Σ m g·h over four particles."""
    return fma(m[0], dot(g[0], h[0]), mix(
        m[1], dot(g[1], h[1]), m[2], dot(g[2], h[2]), m[3], dot(g[3], h[3])))


@jit(inline=True)
def combined(a, g, b, h):
    """Return a g + b h for four particles."""
    return (fma3(a, g[0], b * h[0]), fma3(a, g[1], b * h[1]), fma3(a, g[2], b * h[2]),
            fma3(a, g[3], b * h[3]))


@jit(inline=True)
def strained(d1, d2, d3, b):
    """Return C_D², C_H, and the columns of C_D P_D and of P_H, for the sides of a tetrahedron."""
    b11, b12, b13, b21, b22, b23, b31, b32, b33 = b
    f1, f2 = mix3(b11, d1, b21, d2, b31, d3), mix3(b12, d1, b22, d2, b32, d3)
    f3 = mix3(b13, d1, b23, d2, b33, d3)
    u1, u2, u3 = cross(f2, f3), cross(f3, f1), cross(f1, f2)
    j = dot(f1, u1) - 1.0
    # G = FᵀF - 1, its principal minors of order 2 and 3: tr G = 2 j + j² - minors - det
    s11, s22, s33 = dot(f1, f1), dot(f2, f2), dot(f3, f3)
    e11, e22, e33 = s11 - 1.0, s22 - 1.0, s33 - 1.0
    e12, e13, e23 = dot(f1, f2), dot(f1, f3), dot(f2, f3)
    m23, m13, m12 = e22 * e33 - e23 * e23, e11 * e33 - e13 * e13, e11 * e22 - e12 * e12
    det = e11 * m23 - e12 * (e12 * e33 - e13 * e23) + e13 * (e12 * e23 - e13 * e22)
    strain, trace = e11 + e22 + e33, s11 + s22 + s33
    norm = root(trace)
    longer = strain / (norm + REST)    # n - √3
    square = (select(trace < SMALL, j * j - (m12 + m13 + m23) - det, strain - 2.0 * j)
              + (8.0 / 9.0) * j * j + longer * longer / 3.0)
    there = norm > 0.0
    per = longer / (3.0 * select(there, norm, 1.0))
    alone = select(there, 0.0, per / REST)    # of a point
    more = (8.0 / 9.0) * j
    p1, p2 = fma3(more, u1, fma3(per, f1, f1 - u1)), fma3(more, u2, fma3(per, f2, f2 - u2))
    p3 = fma3(more, u3, fma3(per, f3, f3 - u3))
    deviatoric = (vector3(p1.x + alone, p1.y, p1.z), vector3(p2.x, p2.y + alone, p2.z),
                  vector3(p3.x, p3.y, p3.z + alone))
    return square, j, deviatoric, (u1, u2, u3)


@constraint(Volume, particles=4)
@jit(inline=True)
def solve_volume(volume, apart, c, x, m):
    """Solve a vector of tetrahedra from index c on."""
    inverse, count = volume.inverse, volume.inverse.shape[1]
    b = (load(inverse, c), load(inverse, count + c), load(inverse, 2 * count + c),
         load(inverse, 3 * count + c), load(inverse, 4 * count + c), load(inverse, 5 * count + c),
         load(inverse, 6 * count + c), load(inverse, 7 * count + c), load(inverse, 8 * count + c))
    square, ch, deviatoric, cofactor = strained(x[1] - x[0], x[2] - x[0], x[3] - x[0], b)
    cd = root(larger(square, 0.0))
    gd, gh = gradients(deviatoric, b), gradients(cofactor, b)
    per = select(cd > 0.0, 1.0 / select(cd > 0.0, cd, 1.0), 0.0)
    gd = combined(per, gd, 0.0, gd)
    wd = inner(m, gd, gd)
    t = select(wd > 0.0, inner(m, gd, gh) / select(wd > 0.0, wd, 1.0), 0.0)
    gh = combined(1.0, gh, -t, gd)    # orthogonal to gd: its multiplier stays the same
    wh = inner(m, gh, gh)
    alpha_d, alpha_h = load(volume.compliance, c), load(volume.compliance, count + c)
    fd, fh = row(volume.force, 0), row(volume.force, 1)
    f, g = recall(apart, fd, c), recall(apart, fh, c)
    rd, rh = -xpbd_residual(cd, alpha_d, f), -xpbd_residual(ch, alpha_h, g)
    # [wd + α_D, -t α_D; -t α_D, wh + t² α_D + α_H] [u; v] = [rd; rh - t rd]
    wd, wh = denominator(apart, wd, 0.0), denominator(apart, wh, 0.0)
    ad, ah = denominator(apart, 0.0, alpha_d), denominator(apart, 0.0, alpha_h)
    along = t * ad
    det = (wd + ad) * (wh + ah) + t * along * wd
    u = ((wh + ah) * rd + along * rh) / det
    v = (wd * (rh - t * rd) + ad * rh) / det
    keep(fd, c, f, u - t * v)
    keep(fh, c, g, v)
    i0, i1, i2, i3 = combined(u, gd, v, gh)
    return (1.0, i0), (1.0, i1), (1.0, i2), (1.0, i3)


@jit(inline=True)
def gradient_row(volume, c, x, a):
    """Return row a of the deformation gradient F of tetrahedron c."""
    particles, b = volume.particles, volume.inverse
    first = x[a, particles[0, c]]
    d, e = x[a, particles[1, c]] - first, x[a, particles[2, c]] - first
    f = x[a, particles[3, c]] - first
    return (d * b[0, c] + e * b[3, c] + f * b[6, c], d * b[1, c] + e * b[4, c] + f * b[7, c],
            d * b[2, c] + e * b[5, c] + f * b[8, c])


@jit
def energy_of(volume, x):
    """Return Σ C_D² / (2 α_D) + C_H² / (2 α_H) [J]."""
    total, alpha = 0.0, volume.compliance
    for c in range(volume.particles.shape[1]):
        if volume.particles[0, c] == volume.particles[1, c]:    # an empty place of a pack
            continue
        p1, p2, p3 = gradient_row(volume, c, x, 0)
        q1, q2, q3 = gradient_row(volume, c, x, 1)
        r1, r2, r3 = gradient_row(volume, c, x, 2)
        growth = (p1 * (q2 * r3 - q3 * r2) + p2 * (q3 * r1 - q1 * r3)
                  + p3 * (q1 * r2 - q2 * r1)) - 1.0
        trace = (p1 * p1 + p2 * p2 + p3 * p3 + q1 * q1 + q2 * q2 + q3 * q3
                 + r1 * r1 + r2 * r2 + r3 * r3)
        square = (trace - 3.0 - 2.0 * growth + 8.0 / 9.0 * growth**2
                  + (sqrt(trace) - REST)**2 / 3.0)
        total += max(square, 0.0) / alpha[0, c] + growth**2 / alpha[1, c]
    return 0.5 * total


@dataclass(eq=False)
class Tetrahedra(Constraints):
    """The tetrahedra one by one: the definition in NumPy."""

    inverse: np.ndarray
    """Dm⁻¹ [1/m], shape (tetrahedra, 3, 3)"""
    stretch = True
    """the substeps must resolve it, unlike bending"""

    def __post_init__(self):
        """Take the rows of Dm⁻¹ apart."""
        self.inverse = self.inverse.reshape(-1, 3, 3)

    @property
    def block(self) -> np.ndarray:
        """α of the two constraints of each, shape (tetrahedra, 2, 2)."""
        return self.compliance[:, :, None] * np.eye(2)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C_D and C_H, shape (tetrahedra, 2); x is (3, slots)."""
        corners = self.corners(x)
        f = (corners[:, 1:] - corners[:, :1]).swapaxes(1, 2) @ self.inverse
        growth, square = np.linalg.det(f) - 1.0, (f * f).sum((1, 2))
        square += (8.0 / 9.0 * growth**2 - 3.0 - 2.0 * growth + (np.sqrt(square) - REST)**2 / 3.0)
        return np.stack([np.sqrt(np.maximum(square, 0.0)), growth], 1)

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """
        Return the largest eigenvalue of each element's K at its particles [N/m], (slots, 3, 3).

        About the rest shape, K = V0 (2 μ |ε|² + λ tr² ε). With b_i the gradient of i's shape
        function and h the eigenvalues of Σ b_i b_iᵀ, that is the largest one of the 3 × 3 matrix
        V0 (2 μ diag(h) + λ √h √hᵀ): a shear gives V0 μ (h_k + h_l) at most.
        """
        rows = np.concatenate([-self.inverse.sum(1, keepdims=True), self.inverse], 1)
        root = np.sqrt(np.linalg.eigvalsh(rows.swapaxes(1, 2) @ rows))[:, :, None]
        twice_mu, lame = (np.array([2.0, 1.0]) / self.compliance).T[:, :, None, None]
        block = (twice_mu * np.eye(3) + lame) * root * root.swapaxes(1, 2)
        return isotropic(x, self.particles, np.repeat(np.linalg.eigvalsh(block)[:, -1:], 4, 1))


class BuiltVolume(Built):
    """The tetrahedra of all bodies with this effect."""

    def __init__(self, parameters, world):
        super().__init__()
        particles, inverse, compliance = [], [], []
        for cloth, chosen in parameters.items():
            mesh = cloth.mesh
            if not len(mesh.tetrahedra):
                raise InputError(
                    f'cloths.{cloth.name}.effects.volume: needs a mesh of tetrahedra, and this is '
                    'a surface; pressure fills a closed one, and area keeps the triangles of any')
            corners = mesh.positions[mesh.tetrahedra]
            sides = (corners[:, 1:] - corners[:, :1]).swapaxes(1, 2)
            volume = np.linalg.det(sides) / 6.0
            particles.append(cloth.slots[mesh.tetrahedra])
            inverse.append(np.linalg.inv(sides).reshape(-1, 9))
            with np.errstate(divide='ignore'):
                compliance.append([world.compliance_scale / (modulus * volume)
                                   for modulus in chosen.lame[::-1]])
        packing, most = Packing(particles, world), max_compliance(world.state.x.dtype)
        alpha = np.minimum(np.concatenate(compliance, 1).T, most)
        self.data = Volume(**packing.common((2,)), inverse=packing.column(inverse),
                           compliance=packing.column(alpha, 1.0))
        self.constraints = Tetrahedra.of(self.data)
        self.sides = sides_of(parameters)

    def stored_energy(self, state):
        return energy_of(self.data, state.x)


EFFECT = Effect('volume', Parameters, BuiltVolume)
