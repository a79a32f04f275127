"""
What the reference solver solves, as plain arrays, and its energy with both derivatives.

    m x'' = -∇E(x) + m g - m c x',   E = Σ k (|x_i - x_j| - L)² / 2 + Σ B |Σ_p w_p x_p|² / 2

over elastic edges and isometric hinges (NUMERICS 2.1, 2.5), with pinned particles at positions
given in time. With u = (x_i - x_j) / l an edge adds to the Hessian the block

    k [u uᵀ + (1 - L / l) (I - u uᵀ)]

to (i, i) and (j, j) and its negative to (i, j) and (j, i); a hinge adds B w_p w_q I. Clamped, that
is with (1 - L / l) not below 0, the blocks are positive semidefinite (NUMERICS 3.6).

Nothing here is shared with the simulation: it is judged by this.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import splu, SuperLU

Array = NDArray[Any]

LU = {'diag_pivot_thresh': 0.0, 'options': {'SymmetricMode': True}}
"""of SuperLU, so that a symmetric matrix keeps its diagonal as pivots"""
EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """
    An initial value problem of particles, edges and hinges.

    The arrays are checked, copied and made read-only. Everything is in SI units.
    """

    x: Array
    """positions at the start [m], shape (n, 3)"""
    v: Array | None = None
    """velocities at the start [m/s], shape (n, 3); None: at rest. Those of pinned particles are
    not read."""
    mass: Array
    """[kg], shape (n,), > 0"""
    pinned: Array | None = None
    """bool, shape (n,); None: all are free"""
    motion: Callable[[float], ArrayLike] | None = None
    """time since the start [s] -> positions [m] of the pinned particles, by rising index, shape
    (p, 3); None: they stay where they are"""
    interval: float | None = None
    """motion is smooth within each interval of this length, and may kink between two [s]"""
    gravity: Array = (0.0, 0.0, 0.0)
    """[m/s²], shape (3,)"""
    damping: float = 0.0
    """rate c at which velocities decay [1/s]"""
    edges: Array = ()
    """particles, shape (m, 2)"""
    rest_length: Array = ()
    """L [m], shape (m,)"""
    stiffness: Array = ()
    """k [N/m], shape (m,)"""
    bends: Array = ()
    """particles of each hinge, shape (h, 4)"""
    weight: Array = ()
    """w of the hinge's C = Σ w_p x_p [1/m for a stiffness in N m], shape (h, 4)"""
    bend_stiffness: Array = ()
    """B [N m], shape (h,)"""

    def __post_init__(self):
        """Refuse what has no meaning, and keep copies that nobody writes to."""
        n = len(self.x)
        zeros = np.zeros((n, 3))
        m, h = len(self.edges), len(self.bends)
        for name, value, shape, kind in (
                ('x', self.x, (n, 3), float),
                ('v', zeros if self.v is None else self.v, (n, 3), float),
                ('mass', self.mass, (n,), float),
                ('pinned', np.zeros(n) if self.pinned is None else self.pinned, (n,), bool),
                ('gravity', self.gravity, (3,), float),
                ('edges', self.edges, (m, 2), np.int64),
                ('rest_length', self.rest_length, (m,), float),
                ('stiffness', self.stiffness, (m,), float),
                ('bends', self.bends, (h, 4), np.int64),
                ('weight', self.weight, (h, 4), float),
                ('bend_stiffness', self.bend_stiffness, (h,), float)):
            array = np.array(value, kind, order='C')
            if array.size == 0:
                array = array.reshape(shape) if 0 in shape else array
            if array.shape != shape:
                raise ValueError(f'{name}: must have shape {shape} (got {array.shape})')
            if kind is float and not np.isfinite(array).all():
                raise ValueError(f'{name}: must be finite')
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for name in ('mass', 'stiffness', 'bend_stiffness'):
            if (getattr(self, name) <= 0.0).any():
                raise ValueError(f'{name}: must be > 0 (got {getattr(self, name).min():g})')
        if (self.rest_length < 0.0).any():
            raise ValueError(f'rest_length: must be >= 0 m (got {self.rest_length.min():g})')
        if not 0.0 <= self.damping < np.inf:
            raise ValueError(f'damping: must be >= 0 1/s (got {self.damping:g})')
        if self.interval is not None and not 0.0 < self.interval < np.inf:
            raise ValueError(f'interval: must be > 0 s (got {self.interval:g})')
        for name in ('edges', 'bends'):
            array = getattr(self, name)
            if array.size and not (array.min() >= 0 and array.max() < n):
                raise ValueError(f'{name}: particles must be from 0 to {n - 1} '
                                 f'(got {array.min()} to {array.max()})')
        if self.pinned.all():
            raise ValueError('pinned: no particle is free')
        if (self.edges[:, 0] == self.edges[:, 1]).any():
            raise ValueError('edges: an edge must join two particles')
        if self.motion is not None and self.at(0.0).shape != (self.pinned.sum(), 3):
            raise ValueError(f'motion: must give shape {(int(self.pinned.sum()), 3)} '
                             f'(got {self.at(0.0).shape})')

    def at(self, t: float) -> Array:
        """Return the positions of the pinned particles [m], shape (p, 3)."""
        return self.x[self.pinned] if self.motion is None else np.array(self.motion(t), float)


def rms(difference: Array) -> float:
    """Return the root mean square of the lengths of vectors, shape (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(np.square(difference), -1)))) if len(difference) else 0.0


def potential(problem: Problem, x: Array) -> float:
    """Return E(x) - Σ m g·x [J]."""
    return elastic(problem, x) - float(problem.mass @ (x @ problem.gravity))


def elastic(problem: Problem, x: Array) -> float:
    """Return E(x), the energy stored in edges and hinges [J]."""
    d, l, _ = _edge(problem, x)
    C = _hinge(problem, x)
    return float(0.5 * (problem.stiffness * (l - problem.rest_length)**2).sum()
                 + 0.5 * (problem.bend_stiffness * np.square(C).sum(1)).sum())


def kinetic(problem: Problem, v: Array) -> float:
    """Return Σ m v² / 2 over the free particles [J]."""
    free = ~problem.pinned
    return float(0.5 * (problem.mass[free] * np.square(v[free]).sum(1)).sum())


def gradient(problem: Problem, x: Array) -> Array:
    """Return the gradient of ``potential`` [N], shape (n, 3): minus the forces."""
    d, _, slack = _edge(problem, x)
    pull = (problem.stiffness * slack)[:, None] * d
    bend = (problem.weight[:, :, None]
            * (problem.bend_stiffness[:, None] * _hinge(problem, x))[:, None, :])
    total = -problem.mass[:, None] * problem.gravity
    for k in range(3):
        n = len(x)
        total[:, k] += np.bincount(problem.edges[:, 0], pull[:, k], n)
        total[:, k] -= np.bincount(problem.edges[:, 1], pull[:, k], n)
        total[:, k] += np.bincount(problem.bends.ravel(), bend[:, :, k].ravel(), n)
    return total


def force_rounding(problem: Problem, x: Array, pull: float = 0.0) -> float:
    """
    Return how far rounded positions alone take the gradient from 0 [N].

    ``pull`` [1/s²] times its mass holds each particle in place as well.
    """
    n = len(x)
    k = pull * problem.mass
    k += np.bincount(problem.edges.ravel(), np.repeat(problem.stiffness, 2), n)
    w = np.abs(problem.weight)
    k += np.bincount(problem.bends.ravel(),
                     (problem.bend_stiffness[:, None] * w * w.sum(1, keepdims=True)).ravel(), n)
    return float(4.0 * EPS * k.max() * np.abs(x).max())


def energy_rounding(problem: Problem, x: Array) -> float:
    """Return what rounding makes of ``potential`` [J]: Σ |force| |x| eps, term by term."""
    _, l, _ = _edge(problem, x)
    tension = problem.stiffness * np.abs(l - problem.rest_length)
    moment = (problem.bend_stiffness * np.abs(_hinge(problem, x)).sum(1)
              * np.abs(problem.weight).sum(1))
    weight = problem.mass.sum() * np.abs(problem.gravity).sum()
    return float(8.0 * EPS * np.abs(x).max() * (tension.sum() + moment.sum() + weight))


def highest_frequency_bound(problem: Problem, x: Array) -> float:
    """
    Return an angular frequency that no vibration about x exceeds [rad/s].

    For each edge zᵀ H z ≤ κ |z_i - z_j|² ≤ 2 κ (|z_i|² + |z_j|²), where κ = k max(1, |1 - L / l|)
    bounds the block's eigenvalues; for each hinge B |Σ w z|² ≤ B Σ|w| Σ |w_p| |z_p|². Summed by
    particle this bounds M⁻¹ H. On a flat sheet it is √2 times too high.
    """
    _, _, slack = _edge(problem, x)
    n = len(x)
    kappa = 2.0 * problem.stiffness * np.maximum(1.0, np.abs(slack))
    total = np.bincount(problem.edges.ravel(), np.repeat(kappa, 2), n)
    w = np.abs(problem.weight)
    total += np.bincount(problem.bends.ravel(), (
        problem.bend_stiffness[:, None] * w * w.sum(1, keepdims=True)).ravel(), n)
    return float(np.sqrt((total / problem.mass)[~problem.pinned].max(initial=0.0)))


def _edge(problem: Problem, x: Array) -> tuple[Array, Array, Array]:
    """Return x_i - x_j [m] (m, 3), its length l [m] and 1 - L / l (m,); 0 where l is 0."""
    d = x[problem.edges[:, 0]] - x[problem.edges[:, 1]]
    l = np.sqrt(np.square(d).sum(1))
    slack = 1.0 - np.divide(problem.rest_length, l, out=np.zeros_like(l), where=l > 0.0)
    slack[(l == 0.0) & (problem.rest_length > 0.0)] = 0.0
    return d, l, slack


def _hinge(problem: Problem, x: Array) -> Array:
    """Return C, shape (h, 3)."""
    return np.einsum('hp,hpk->hk', problem.weight, x[problem.bends])


class Stiffness:
    """
    The Hessian over the free particles, and the solution of systems with it.

    The pattern of non-zeros is found once, and the particles are numbered once so that the factors
    stay sparse (minimum degree).
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self.free = np.flatnonzero(~problem.pinned)
        f = len(self.free)
        rank = np.full(len(problem.x), -1)
        rank[self.free] = np.arange(f)
        i, j = rank[problem.edges].T
        hinge = rank[problem.bends]
        p, q = (np.repeat(hinge, 4, axis=1).ravel(), np.tile(hinge, 4).ravel())
        rows = np.concatenate([i, j, i, j, p, np.arange(f)])
        columns = np.concatenate([i, j, j, i, q, np.arange(f)])
        kept = (rows >= 0) & (columns >= 0)
        order = _minimum_degree(rows[kept], columns[kept], f)
        self.particles = np.empty(f, np.int64)
        self.particles[order] = self.free
        rows, columns = order[rows[kept]], order[columns[kept]]
        key, where = np.unique(columns * f + rows, return_inverse=True)
        columns, rows = np.divmod(key, f)
        # A block (3, 3) for each pair of particles that meet, in a fixed place.
        place = np.full(len(kept), -1)
        place[kept] = where
        m, w = len(problem.edges), problem.weight
        self._blocks = len(key)
        self._edge_place, bend_place = place[:4 * m], place[4 * m:-f]
        bend = np.einsum('h,hp,hq->hpq', problem.bend_stiffness, w, w).ravel()
        self._bend = np.bincount(bend_place[bend_place >= 0], bend[bend_place >= 0], len(key))
        self._mass = np.bincount(place[-f:], problem.mass[self.free], len(key))
        self._shape = (3 * f, 3 * f)
        a, b = np.arange(3)[:, None], np.arange(3)
        entry = sparse.coo_matrix(
            (np.arange(1.0, 9 * len(key) + 1),
             ((3 * rows[:, None, None] + a + 0 * b).ravel(),
              (3 * columns[:, None, None] + 0 * a + b).ravel())), shape=self._shape).tocsc()
        entry.sort_indices()
        self._take = entry.data.astype(np.int64) - 1
        self._indices, self._indptr = entry.indices, entry.indptr

    def matrix(self, x: Array, *, mass: float = 0.0, clamp: bool = False) -> sparse.csc_matrix:
        """
        Return the Hessian of E at x plus ``mass`` [1/s²] times the masses [N/m].

        Rows are x, y, z of each of ``self.particles`` in turn. ``clamp`` leaves out what may be
        negative, which is the stiffness of compressed edges across their direction.
        """
        d, l, slack = _edge(self.problem, x)
        u = np.divide(d, l[:, None], out=np.zeros_like(d), where=l[:, None] > 0.0)
        if clamp:
            slack = np.maximum(slack, 0.0)
        k = self.problem.stiffness
        block = (((k * (1.0 - slack))[:, None, None] * u[:, :, None] * u[:, None, :])
                 + (k * slack)[:, None, None] * np.eye(3)).reshape(-1, 9)
        values = np.zeros((self._blocks, 9))
        signed = np.concatenate([block, block, -block, -block])
        kept = self._edge_place >= 0
        for c in range(9):
            values[:, c] = np.bincount(self._edge_place[kept], signed[kept, c], self._blocks)
        values[:, [0, 4, 8]] += (self._bend + mass * self._mass)[:, None]
        return sparse.csc_matrix((values.ravel()[self._take], self._indices, self._indptr),
                                 shape=self._shape)

    def factor(self, x: Array, mass: float) -> SuperLU:
        """Factor the Hessian plus ``mass`` times the masses; clamped unless it is positive."""
        for clamp in (False, True):
            try:
                lu = splu(self.matrix(x, mass=mass, clamp=clamp), permc_spec='NATURAL', **LU)
            except RuntimeError:    # exactly singular
                if clamp:
                    raise
                continue
            if clamp or is_positive(lu):
                return lu
        raise AssertionError

    def stable(self, x: Array) -> bool:
        """Return whether the Hessian of E at x has no negative eigenvalue beyond rounding."""
        try:
            return is_positive(splu(self.matrix(x, mass=1e-6), permc_spec='NATURAL', **LU))
        except RuntimeError:
            return False

    def solve(self, lu: SuperLU, force: Array) -> Array:
        """Solve for displacements of all particles [m], given forces [N]; both (n, 3)."""
        step = np.zeros_like(force)
        step[self.particles] = lu.solve(force[self.particles].ravel()).reshape(-1, 3)
        return step


def is_positive(lu: SuperLU) -> bool:
    """Return whether the symmetric matrix that was factored is positive definite (Sylvester)."""
    return bool(np.array_equal(lu.perm_r, lu.perm_c) and (lu.U.diagonal() > 0.0).all())


def _minimum_degree(rows: Array, columns: Array, count: int) -> Array:
    """Return the rank of each of ``count`` particles in an order that leaves little fill-in."""
    if count == 0:
        return np.zeros(0, np.int64)
    graph = sparse.coo_matrix((np.full(len(rows), -1.0), (rows, columns)), (count, count)).tocsc()
    graph.data[:] = -1.0
    degree = np.asarray(np.abs(graph).sum(0)).ravel()
    dominant = graph + sparse.diags(degree + 1.0)
    return splu(dominant.tocsc(), permc_spec='MMD_AT_PLUS_A', **LU).perm_c.astype(np.int64)
