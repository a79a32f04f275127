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
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.records import from_records, put_records, to_records
from xpbd_ros.sim.stepping.stages import prepare, project, project_back, stage

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


class Held(NamedTuple):
    """The tetrahedra at pinned particles, whose reaction forces are summed up."""

    count: np.ndarray
    """shape (1,)"""
    particles: np.ndarray
    """slots, shape (room, 4)"""
    index: np.ndarray
    """index of each one's forces, shape (room,)"""
    inverse: np.ndarray
    """Dm⁻¹ [1/m], shape (room, 3, 3)"""


class Volume(NamedTuple):
    """Tetrahedra in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots, shape (4, tetrahedra)"""
    inverse: np.ndarray
    """Dm⁻¹ [1/m], row after row, shape (9, tetrahedra)"""
    compliance: np.ndarray
    """α_D and α_H [1/J], shape (2, tetrahedra)"""
    force: np.ndarray | None
    """f of C_D and of C_H, multipliers over H² [J], shape (2, tetrahedra); None if multipliers are
    not kept"""
    packs: Packs | None
    """tetrahedra at pinned particles; None in a scene without pins"""
    work: np.ndarray
    """scratch for F, cof F and FᵀF - 1 of one tetrahedron, shape (3, 3, 3)"""


@stage(prepare, Volume)
@jit
def prepare_volume(volume, state, substep):
    """Zero the multipliers."""
    zero_multipliers(state.apart, volume.force)


@stage(project, Volume)
@jit
def project_volume(volume, state, substep):
    """One pass over all tetrahedra."""
    _project(volume, state, substep, False)


@stage(project_back, Volume)
@jit
def project_volume_back(volume, state, substep):
    """The same pass in reverse order."""
    _project(volume, state, substep, True)


@jit
def _project(volume, state, substep, reverse):
    first, last = volume.slots[0], volume.slots[1]
    to_records(state, volume.records, first, last)
    for number in range(segment_count(volume.packs)):
        begin, end, a, b = segment(volume.packs, number, volume.particles.shape[1], reverse)
        _note(volume.packs, volume.work, a, b, volume.records, state.apart, volume.force)
        _project_packs(volume.records, state.apart, volume.particles, volume.inverse,
                       volume.compliance, row(volume.force, 0), row(volume.force, 1), begin, end,
                       reverse)
        collect(volume.packs, a, b, volume.force, substep.end - substep.begin, state.reaction)
    from_records(state, volume.records, first, last)


@jit(inline=True)
def mix(a, x, b, y, c, z):
    """Return a x + b y + c z."""
    return fma(a, x, fma(b, y, c * z))


@jit(inline=True)
def gradients(p, b):
    """Return ∇0 … ∇3, each x y z, from the columns of P and the rows of Dm⁻¹."""
    (px, py, pz), (qx, qy, qz), (rx, ry, rz) = p
    b11, b12, b13, b21, b22, b23, b31, b32, b33 = b
    x1, y1, z1 = (mix(px, b11, qx, b12, rx, b13), mix(py, b11, qy, b12, ry, b13),
                  mix(pz, b11, qz, b12, rz, b13))
    x2, y2, z2 = (mix(px, b21, qx, b22, rx, b23), mix(py, b21, qy, b22, ry, b23),
                  mix(pz, b21, qz, b22, rz, b23))
    x3, y3, z3 = (mix(px, b31, qx, b32, rx, b33), mix(py, b31, qy, b32, ry, b33),
                  mix(pz, b31, qz, b32, rz, b33))
    return ((-(x1 + x2 + x3), -(y1 + y2 + y3), -(z1 + z2 + z3)), (x1, y1, z1), (x2, y2, z2),
            (x3, y3, z3))


@jit(inline=True)
def inner(m, g, h):
    """Return Σ m g·h over four particles."""
    m0, m1, m2, m3 = m
    (a0, b0, c0), (a1, b1, c1), (a2, b2, c2), (a3, b3, c3) = g
    (u0, v0, w0), (u1, v1, w1), (u2, v2, w2), (u3, v3, w3) = h
    return fma(m0, mix(a0, u0, b0, v0, c0, w0), mix(
        m1, mix(a1, u1, b1, v1, c1, w1), m2, mix(a2, u2, b2, v2, c2, w2),
        m3, mix(a3, u3, b3, v3, c3, w3)))


@jit(inline=True)
def combined(a, g, b, h):
    """Return a g + b h for four particles."""
    (a0, b0, c0), (a1, b1, c1), (a2, b2, c2), (a3, b3, c3) = g
    (u0, v0, w0), (u1, v1, w1), (u2, v2, w2), (u3, v3, w3) = h
    return ((fma(a, a0, b * u0), fma(a, b0, b * v0), fma(a, c0, b * w0)),
            (fma(a, a1, b * u1), fma(a, b1, b * v1), fma(a, c1, b * w1)),
            (fma(a, a2, b * u2), fma(a, b2, b * v2), fma(a, c2, b * w2)),
            (fma(a, a3, b * u3), fma(a, b3, b * v3), fma(a, c3, b * w3)))


@jit(inline=True)
def strained(d1, d2, d3, b):
    """Return C_D², C_H, and the columns of C_D P_D and of P_H, for the sides of a tetrahedron."""
    (x1, y1, z1), (x2, y2, z2), (x3, y3, z3) = d1, d2, d3
    b11, b12, b13, b21, b22, b23, b31, b32, b33 = b
    fx, fy, fz = (mix(x1, b11, x2, b21, x3, b31), mix(y1, b11, y2, b21, y3, b31),
                  mix(z1, b11, z2, b21, z3, b31))
    gx, gy, gz = (mix(x1, b12, x2, b22, x3, b32), mix(y1, b12, y2, b22, y3, b32),
                  mix(z1, b12, z2, b22, z3, b32))
    hx, hy, hz = (mix(x1, b13, x2, b23, x3, b33), mix(y1, b13, y2, b23, y3, b33),
                  mix(z1, b13, z2, b23, z3, b33))
    ux, uy, uz = gy * hz - gz * hy, gz * hx - gx * hz, gx * hy - gy * hx
    vx, vy, vz = hy * fz - hz * fy, hz * fx - hx * fz, hx * fy - hy * fx
    wx, wy, wz = fy * gz - fz * gy, fz * gx - fx * gz, fx * gy - fy * gx
    j = mix(fx, ux, fy, uy, fz, uz) - 1.0
    # G = FᵀF - 1, its principal minors of order 2 and 3: tr G = 2 j + j² - minors - det
    ff, gg, hh = (mix(fx, fx, fy, fy, fz, fz), mix(gx, gx, gy, gy, gz, gz),
                  mix(hx, hx, hy, hy, hz, hz))
    e11, e22, e33 = ff - 1.0, gg - 1.0, hh - 1.0
    e12, e13, e23 = (mix(fx, gx, fy, gy, fz, gz), mix(fx, hx, fy, hy, fz, hz),
                     mix(gx, hx, gy, hy, gz, hz))
    m23, m13, m12 = e22 * e33 - e23 * e23, e11 * e33 - e13 * e13, e11 * e22 - e12 * e12
    det = e11 * m23 - e12 * (e12 * e33 - e13 * e23) + e13 * (e12 * e23 - e13 * e22)
    strain, trace = e11 + e22 + e33, ff + gg + hh
    norm = root(trace)
    longer = strain / (norm + REST)    # n - √3
    square = (select(trace < SMALL, j * j - (m12 + m13 + m23) - det, strain - 2.0 * j)
              + (8.0 / 9.0) * j * j + longer * longer / 3.0)
    there = norm > 0.0
    per = longer / (3.0 * select(there, norm, 1.0))
    alone = select(there, 0.0, per / REST)    # of a point
    more = (8.0 / 9.0) * j
    deviatoric = (
        (fma(more, ux, fma(per, fx, fx - ux)) + alone, fma(more, uy, fma(per, fy, fy - uy)),
         fma(more, uz, fma(per, fz, fz - uz))),
        (fma(more, vx, fma(per, gx, gx - vx)), fma(more, vy, fma(per, gy, gy - vy)) + alone,
         fma(more, vz, fma(per, gz, gz - vz))),
        (fma(more, wx, fma(per, hx, hx - wx)), fma(more, wy, fma(per, hy, hy - wy)),
         fma(more, wz, fma(per, hz, hz - wz)) + alone))
    return square, j, deviatoric, ((ux, uy, uz), (vx, vy, vz), (wx, wy, wz))


@jit
def _project_packs(records, apart, particles, inverse, compliance, fd, fh, begin, end, reverse):
    count, step = particles.shape[1], lanes(inverse)
    p0, p1, p2, p3 = particles[0], particles[1], particles[2], particles[3]
    for p in range(begin, end, step):
        q = begin + end - step - p if reverse else p
        x0, y0, z0, m0 = load_records(records, p0, q)
        x1, y1, z1, m1 = load_records(records, p1, q)
        x2, y2, z2, m2 = load_records(records, p2, q)
        x3, y3, z3, m3 = load_records(records, p3, q)
        b = (load(inverse, q), load(inverse, count + q), load(inverse, 2 * count + q),
             load(inverse, 3 * count + q), load(inverse, 4 * count + q),
             load(inverse, 5 * count + q), load(inverse, 6 * count + q),
             load(inverse, 7 * count + q), load(inverse, 8 * count + q))
        square, ch, deviatoric, cofactor = strained(
            (x1 - x0, y1 - y0, z1 - z0), (x2 - x0, y2 - y0, z2 - z0),
            (x3 - x0, y3 - y0, z3 - z0), b)
        cd = root(larger(square, 0.0))
        m = m0, m1, m2, m3
        gd, gh = gradients(deviatoric, b), gradients(cofactor, b)
        per = select(cd > 0.0, 1.0 / select(cd > 0.0, cd, 1.0), 0.0)
        gd = combined(per, gd, 0.0, gd)
        wd = inner(m, gd, gd)
        t = select(wd > 0.0, inner(m, gd, gh) / select(wd > 0.0, wd, 1.0), 0.0)
        gh = combined(1.0, gh, -t, gd)    # orthogonal to gd: its multiplier stays the same
        wh = inner(m, gh, gh)
        alpha_d, alpha_h = load(compliance, q), load(compliance, count + q)
        f, g = recall(apart, fd, q), recall(apart, fh, q)
        rd, rh = -xpbd_residual(cd, alpha_d, f), -xpbd_residual(ch, alpha_h, g)
        # [wd + α_D, -t α_D; -t α_D, wh + t² α_D + α_H] [u; v] = [rd; rh - t rd]
        wd, wh = denominator(apart, wd, 0.0), denominator(apart, wh, 0.0)
        ad, ah = denominator(apart, 0.0, alpha_d), denominator(apart, 0.0, alpha_h)
        along = t * ad
        det = (wd + ad) * (wh + ah) + t * along * wd
        u = ((wh + ah) * rd + along * rh) / det
        v = (wd * (rh - t * rd) + ad * rh) / det
        keep(fd, q, f, u - t * v)
        keep(fh, q, g, v)
        (ax, ay, az), (bx, by, bz), (cx, cy, cz), (dx, dy, dz) = combined(u, gd, v, gh)
        put_records(records, apart, p0, q, x0, y0, z0, m0, m0, ax, ay, az)
        put_records(records, apart, p1, q, x1, y1, z1, m1, m1, bx, by, bz)
        put_records(records, apart, p2, q, x2, y2, z2, m2, m2, cx, cy, cz)
        put_records(records, apart, p3, q, x3, y3, z3, m3, m3, dx, dy, dz)


@jit
def _note(packs, work, first, last, x, apart, force):
    """Note ∇C_D and ∇C_H of the tetrahedra of a pack."""
    if packs is not None:
        remember(packs, first, last, apart, force)
        for k in range(first, last):
            _differentiate(packs.held.particles[k], packs.held.inverse[k], x, work,
                           packs.gradient[k - first])


@jit
def _differentiate(corners, b, x, work, gradient):
    f, c, e = work[0], work[1], work[2]
    for a in range(3):
        for axis in range(3):
            f[axis, a] = 0.0
            for i in range(3):
                f[axis, a] += (x[corners[i + 1], axis] - x[corners[0], axis]) * b[i, a]
    for a in range(3):
        n, o = (a + 1) % 3, (a + 2) % 3
        c[0, a] = f[1, n] * f[2, o] - f[2, n] * f[1, o]
        c[1, a] = f[2, n] * f[0, o] - f[0, n] * f[2, o]
        c[2, a] = f[0, n] * f[1, o] - f[1, n] * f[0, o]
    for a in range(3):
        for n in range(3):
            e[a, n] = (f[0, a] * f[0, n] + f[1, a] * f[1, n] + f[2, a] * f[2, n]
                       - (1.0 if a == n else 0.0))
    j = f[0, 0] * c[0, 0] + f[1, 0] * c[1, 0] + f[2, 0] * c[2, 0] - 1.0
    norm = 0.0
    for a in range(3):
        norm += f[0, a] * f[0, a] + f[1, a] * f[1, a] + f[2, a] * f[2, a]
    norm = np.sqrt(norm)
    longer = (e[0, 0] + e[1, 1] + e[2, 2]) / (norm + REST)
    square = 17.0 / 9.0 * j * j + longer * longer / 3.0
    for a in range(3):
        n, o = (a + 1) % 3, (a + 2) % 3
        minor = e[n, n] * e[o, o] - e[n, o] * e[n, o]
        square -= minor + (e[0, a] * (e[1, n] * e[2, o] - e[1, o] * e[2, n]))
    per = 1.0 / np.sqrt(square) if square > 0.0 else 0.0
    gradient[:] = 0.0
    for a in range(3):
        for axis in range(3):
            turn = f[axis, a] / norm if norm > 0.0 else (axis == a) / REST
            shape = per * (f[axis, a] - c[axis, a] + 8.0 / 9.0 * j * c[axis, a]
                           + longer / 3.0 * turn)
            for i in range(3):
                for m, slope in ((0, shape), (1, c[axis, a])):
                    gradient[m, i + 1, axis] += slope * b[i, a]
                    gradient[m, 0, axis] -= slope * b[i, a]


class Tetrahedra:
    """The tetrahedra one by one, in sweep order: the definition in NumPy."""

    stretch = True
    """the substeps must resolve it, unlike bending"""

    def __init__(self, particles, index, inverse, compliance):
        self.particles = particles
        self.index = index
        self.inverse = inverse.astype(float).reshape(-1, 3, 3)
        self.compliance = compliance.astype(float)

    @staticmethod
    def of(data: Volume) -> 'Tetrahedra':
        """Return the tetrahedra of a batch."""
        index = np.flatnonzero(data.particles[0] != data.particles[1])
        return Tetrahedra(data.particles[:, index].T.astype(np.int64), index,
                          data.inverse[:, index].T, data.compliance[:, index].T)

    @property
    def block(self) -> np.ndarray:
        """α of the two constraints of each, shape (tetrahedra, 2, 2)."""
        return self.compliance[:, :, None] * np.eye(2)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return F, shape (tetrahedra, 3, 3); x has shape (3, slots)."""
        corners = x.T.astype(float)[self.particles]
        return (corners[:, 1:] - corners[:, :1]).swapaxes(1, 2) @ self.inverse

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C_D and C_H, shape (tetrahedra, 2), from the definition."""
        f = self.gradient(x)
        growth, square = np.linalg.det(f) - 1.0, (f * f).sum((1, 2))
        square += (8.0 / 9.0 * growth**2 - 3.0 - 2.0 * growth + (np.sqrt(square) - REST)**2 / 3.0)
        return np.stack([np.sqrt(np.maximum(square, 0.0)), growth], 1)

    def energy(self, x: np.ndarray) -> float:
        """Return Σ C_D² / (2 α_D) + C_H² / (2 α_H) [J]."""
        return float((0.5 * self.residual(x)**2 / self.compliance).sum())

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """
        Return V0 (2 μ + 3 λ) Σ |b_i| Σ |b_j| at each particle [N/m], shape (slots, 3, 3).

        b_i is the gradient of i's shape function, |∇u|² ≤ (Σ |b_i| |u_i|)²; about the rest shape.
        """
        rows = np.concatenate([-self.inverse.sum(1, keepdims=True), self.inverse], 1)
        slopes = length(rows)
        stiffness = 2.0 / self.compliance[:, 0] + 3.0 / self.compliance[:, 1]
        total = np.zeros(x.shape[1])
        np.add.at(total, self.particles,
                  stiffness[:, None] * slopes * slopes.sum(1, keepdims=True))
        return total[:, None, None] * np.eye(3)


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
        particles, inverse = np.concatenate(particles), np.concatenate(inverse)
        dtype = world.state.x.dtype
        compliance = np.minimum(np.concatenate(compliance, 1).T, max_compliance(dtype))
        order = pack(particles)
        count = len(order)
        self.data = Volume(
            world.records, np.array([particles.min(), particles.max() + 1]),
            padded(particles, order, world.slots - 1, np.int32).T.copy(),
            padded(inverse, order, 0.0, dtype).T.copy(),
            padded(compliance, order, 1.0, dtype).T.copy(),
            zeros((2, count), dtype) if world.forces else None,
            packs_for(Held(*room_for(count, 4), np.zeros((count, 3, 3))), 2)
            if world.pins else None,
            np.zeros((3, 3, 3)))
        self.constraints = Tetrahedra.of(self.data)

    def hold(self, inv_mass):
        hold_packs(self.data.packs, self.constraints, inv_mass, self.data.particles.shape[1])


EFFECT = Effect('volume', Parameters, BuiltVolume)
