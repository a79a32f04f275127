"""
Elastic elements: each kind with its energy, as in doc/numerics.md 5.

The energy of an element is a function of a few vectors that are linear in the positions of its
particles, z = Σ w_i (x_i - x_0): an edge, two sides of a triangle, the columns of a deformation
gradient. Its exact gradient and Hessian follow from this formula (``derivatives``). If the Hessian
in z is clamped, that is its negative eigenvalues are set to 0, it is positive semidefinite, and so
is the Hessian in x.

No code is shared with the simulation, which is tested against this.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xpbd_ros.study.reference.derivatives import angle, cross, dot, Jet, root, variables, wrapped

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Elements:
    """Elements of one kind; arrays are checked, copied and made read-only; all in SI units."""

    particles: NDArray[np.int64]
    """indices of the k particles of each element, shape (m, k)"""

    def __post_init__(self):
        """Check the arrays, and keep read-only copies."""
        for entry in fields(self):
            kind = np.int64 if entry.name == 'particles' else float
            array = np.array(getattr(self, entry.name), kind, order='C')
            if not np.isfinite(array).all():
                raise ValueError(f'{self.name}.{entry.name}: must be finite')
            if entry.name != 'particles' and array.ndim and len(array) != len(self.particles):
                raise ValueError(f'{self.name}.{entry.name}: must have {len(self.particles)} '
                                 f'rows (got {len(array)})')
            if entry.name.endswith('stiffness') and array.ndim == 1 and (array <= 0.0).any():
                raise ValueError(f'{self.name}.{entry.name}: must be > 0 (got {array.min():g})')
            array.setflags(write=False)
            object.__setattr__(self, entry.name, array)
        if self.particles.ndim != 2:
            raise ValueError(f'{self.name}.particles: must have shape (m, k) '
                             f'(got {self.particles.shape})')
        if self.particles.shape[1] == 2 and (self.particles[:, 0] == self.particles[:, 1]).any():
            raise ValueError(f'{self.name}.particles: must be two different particles')

    @property
    def name(self) -> str:
        """Name of the kind in messages."""
        return type(self).__name__.lower()

    @property
    def parameters(self) -> tuple[Array, ...]:
        """All fields but the particles."""
        return tuple(getattr(self, entry.name) for entry in fields(self)[1:])

    @property
    def weights(self) -> Array:
        """Weights w of the vectors without those of particle 0, (1 or m, vectors, k - 1)."""
        return np.eye(self.particles.shape[1] - 1)[None]

    @cached_property
    def shares(self) -> Array:
        """Weights w of all particles, with sum 0, shape (1 or m, vectors, k)."""
        return np.concatenate([-self.weights.sum(2, keepdims=True), self.weights], 2)

    def energies(self, z: list) -> Array | Jet:
        """Return the energy of each element [J] for vectors z, each as components x, y, z."""
        raise NotImplementedError

    def vectors(self, x: Array) -> Array:
        """Return the vectors z at positions x [m], shape (m, vectors, 3)."""
        corners = x[self.particles]
        return self.weights @ (corners[:, 1:] - corners[:, :1])

    def evaluated(self, x: Array, order: int) -> Any:
        """Return ``energies`` at positions x, with derivatives by z up to an order."""
        vectors = self.vectors(x)
        columns = variables(vectors.reshape(len(vectors), 3 * vectors.shape[1]), order)
        return self.energies([columns[k:k + 3] for k in range(0, len(columns), 3)])

    def energy(self, x: Array) -> float:
        """Return the energy of all elements [J]."""
        return float(self.evaluated(x, 0).sum())

    def slope(self, x: Array) -> Array:
        """Return the gradient of each energy by its particles [N], shape (m, k, 3)."""
        first = self.evaluated(x, 1).first
        return self.shares.swapaxes(1, 2) @ first.reshape(len(first), first.shape[1] // 3, 3)

    def curvature(self, x: Array) -> Array:
        """Return the Hessian of each energy by z [N/m], shape (m, 3 vectors, 3 vectors)."""
        jet = self.evaluated(x, 2)
        count = jet.first.shape[1]
        return np.broadcast_to(jet.second, (len(self.particles), count, count))

    def blocks(self, x: Array, *, clamp: bool = False) -> Array:
        """Return the Hessian of each energy by its particles [N/m], shape (m, k, k, 3, 3)."""
        found = self.curvature(x)
        if clamp:
            values, modes = np.linalg.eigh(found)
            found = (modes * np.maximum(values, 0.0)[:, None, :]) @ modes.swapaxes(1, 2)
        q = found.shape[1] // 3
        found = found.reshape(-1, q, 3, q, 3).transpose(0, 2, 4, 1, 3)
        shares = self.shares[:, None, None]
        return (shares.swapaxes(3, 4) @ found @ shares).transpose(0, 3, 4, 1, 2)

    def bound(self, x: Array) -> Array:
        """
        Return the contributions of elements to a bound of the Hessian [N/m], shape (m, k).

        Their sum b_i at each particle satisfies xᵀ H x ≤ Σ b_i |x_i|². With κ the largest
        magnitude of an eigenvalue by z, zᵀ H z ≤ κ (Σ |w_i| |x_i|)² ≤ κ Σ|w_j| Σ |w_i| |x_i|².
        """
        kappa = np.abs(np.linalg.eigvalsh(self.curvature(x))).max(1, initial=0.0)
        w = np.sqrt(np.square(self.shares).sum(1))
        return kappa[:, None] * w * w.sum(1, keepdims=True)

    def outer(self, x: Array) -> tuple[Array, float] | None:
        """Return u, shape (n, 3), and a for a term u uᵀ / a of the Hessian; None without one."""
        return None


@dataclass(frozen=True, eq=False, kw_only=True)
class Edges(Elements):
    """E = k (|x1 - x0| - L)² / 2 (doc/numerics.md 5.1)."""

    rest_length: Array
    """L [m], shape (m,)"""
    stiffness: Array
    """k [N/m], shape (m,)"""

    def energies(self, z):
        stretch = root(dot(z[0], z[0])) - self.rest_length
        return 0.5 * self.stiffness * (stretch * stretch)


@dataclass(frozen=True, eq=False, kw_only=True)
class Slants(Elements):
    """E = k (|x1 - x0| - |x3 - x2|)² / 2 of the difference of a cell's diagonals."""

    stiffness: Array
    """k [N/m], shape (m,)"""

    @property
    def weights(self):
        return np.array([[[1.0, 0.0, 0.0], [0.0, -1.0, 1.0]]])

    def energies(self, z):
        slant = root(dot(z[0], z[0])) - root(dot(z[1], z[1]))
        return 0.5 * self.stiffness * (slant * slant)


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearSums(Elements):
    """
    E = B |Σ w_i x_i|² / 2, with weights of sum 0.

    For isometric hinges (doc/numerics.md 5.5), and for springs of zero length such as seams.
    """

    weight: Array
    """w of all particles, shape (m, k)"""
    stiffness: Array
    """B [N/m] for dimensionless weights, shape (m,)"""

    @property
    def weights(self):
        return self.weight[:, None, 1:]

    def energies(self, z):
        return 0.5 * self.stiffness * dot(z[0], z[0])


@dataclass(frozen=True, eq=False, kw_only=True)
class Membranes(Elements):
    """
    E = Cᵀ K C / 2 of Green's strain C = (E11, E22, γ12) (doc/numerics.md 5.4).

    F = (f1, f2) = (x1 - x0, x2 - x0) D⁻¹,  E11 = (f1·f1 - 1) / 2,  γ12 = f1·f2.
    """

    inverse: Array
    """D⁻¹ [1/m], shape (m, 2, 2)"""
    moduli: Array
    """K, multiplied by the rest area [N m], shape (m, 3, 3)"""

    @property
    def weights(self):
        return self.inverse.swapaxes(1, 2)

    def energies(self, z):
        f, g = z
        strain = (0.5 * (dot(f, f) - 1.0), 0.5 * (dot(g, g) - 1.0), dot(f, g))
        return 0.5 * sum(self.moduli[:, a, b] * (strain[a] * strain[b])
                         for a in range(3) for b in range(3))


@dataclass(frozen=True, eq=False, kw_only=True)
class Hinges(Elements):
    """
    E = k (θ - θ0)² / 2 of the dihedral angle about x0, x1; x2 and x3 opposite.

    As doc/numerics.md 5.6; θ is chosen modulo whole turns to be closest to θ0.
    """

    rest_angle: Array
    """θ0 [rad], shape (m,)"""
    stiffness: Array
    """k [N m], shape (m,)"""

    def energies(self, z):
        e, a, b = z
        n, o = cross(e, a), cross(b, e)
        # (n × o)·e = -|e|² n·b
        turn = wrapped(angle(-(root(dot(e, e)) * dot(n, b)), dot(n, o)) - self.rest_angle)
        return 0.5 * self.stiffness * (turn * turn)


@dataclass(frozen=True, eq=False, kw_only=True)
class Areas(Elements):
    """E = K (A - A0)² / 2 of a triangle."""

    rest_area: Array
    """A0 [m²], shape (m,)"""
    stiffness: Array
    """K [N/m³], shape (m,)"""

    def energies(self, z):
        n = cross(*z)
        more = 0.5 * root(dot(n, n)) - self.rest_area
        return 0.5 * self.stiffness * (more * more)


@dataclass(frozen=True, eq=False, kw_only=True)
class Tetrahedra(Elements):
    """
    Neo-Hookean (doc/numerics.md 5.9), with a term that opens a collapsed body.

    With J = det F and n² = tr FᵀF,

    E = μ (n² - 3 - 2 (J - 1) + 8/9 (J - 1)² + (n - √3)² / 3) / 2 + λ (J - 1)² / 2.
    F = (x_i - x_0) Dm⁻¹.
    """

    inverse: Array
    """Dm⁻¹ [1/m], shape (m, 3, 3)"""
    shear: Array
    """μ, multiplied by the rest volume [J], shape (m,)"""
    bulk: Array
    """λ, multiplied by the rest volume [J], shape (m,)"""

    @property
    def weights(self):
        return self.inverse.swapaxes(1, 2)

    def energies(self, z):
        f, g, h = z
        square, more = dot(f, f) + dot(g, g) + dot(h, h), dot(f, cross(g, h)) - 1.0
        longer = root(square) - 3.0**0.5
        return 0.5 * (self.shear * (square - 3.0 - 2.0 * more + (longer * longer) * (1.0 / 3.0))
                      + (self.bulk + 8.0 / 9.0 * self.shear) * (more * more))


@dataclass(frozen=True, eq=False, kw_only=True)
class Gas(Elements):
    """
    E = (V - V*)² / (2 α) of the volume in a closed surface, V = Σ x0·(x1×x2) / 6.

    There is one energy for all triangles (doc/numerics.md 5.10). Its Hessian is
    p ∇²V + ∇V ∇Vᵀ / α, with p = (V - V*) / α. Corners are relative to their mean, which changes no
    volume or derivative.
    """

    rest_volume: Array
    """V* [m³], shape ()"""
    compliance: Array
    """α [m³/Pa], shape ()"""

    @cached_property
    def shares(self):
        return np.eye(3)[None]

    def vectors(self, x):
        corners = x[self.particles]
        return corners - corners.mean((0, 1))

    def energies(self, z):
        return dot(z[0], cross(z[1], z[2])) * (1.0 / 6.0)

    def pressure(self, x: Array) -> float:
        """Return p = (V - V*) / α, minus the overpressure [Pa]."""
        return float((super().energy(x) - self.rest_volume) / self.compliance)

    def energy(self, x):
        return 0.5 * float(self.compliance) * self.pressure(x)**2

    def slope(self, x):
        return self.pressure(x) * super().slope(x)

    def curvature(self, x):
        return self.pressure(x) * super().curvature(x)

    def outer(self, x):
        u = np.zeros_like(x)
        np.add.at(u, self.particles, super().slope(x))
        return u, float(self.compliance)

    def bound(self, x):
        u, a = self.outer(x)
        slopes = np.sqrt(np.square(u).sum(1))
        often = np.bincount(self.particles.ravel(), minlength=len(x))[self.particles]
        return super().bound(x) + (slopes * slopes.sum() / a)[self.particles] / often
