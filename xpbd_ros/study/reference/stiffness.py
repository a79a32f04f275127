"""
The Hessian of a problem's energy over the free particles, and linear systems with it.

The Hessian is S + U A⁻¹ Uᵀ, with S sparse and one column of U for each gas-filled surface. By the
Woodbury formula

    (S + U A⁻¹ Uᵀ)⁻¹ = S⁻¹ - S⁻¹ U C⁻¹ Uᵀ S⁻¹,   C = A + Uᵀ S⁻¹ U

Its number of negative eigenvalues is that of S less that of C (Haynsworth), so definiteness can be
decided also where S alone is indefinite, as for a surface that only its gas holds open.
"""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, splu

from xpbd_ros.study.reference.problem import Array, Problem

LU = {'diag_pivot_thresh': 0.0, 'options': {'SymmetricMode': True}}
"""options of SuperLU that keep the diagonal of a symmetric matrix as pivots"""


class Stiffness:
    """
    The Hessian as a function of positions.

    The sparsity pattern and a fill-reducing order of the particles (minimum degree) are computed
    once.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self.free = np.flatnonzero(~problem.pinned)
        f = len(self.free)
        rank = np.full(len(problem.x), -1)
        rank[self.free] = np.arange(f)
        rows, columns = [np.arange(f)], [np.arange(f)]
        for part in problem.elements:
            k = part.particles.shape[1]
            named = rank[part.particles]
            rows.append(np.repeat(named, k, axis=1).ravel())
            columns.append(np.tile(named, k).ravel())
        ends = np.cumsum([len(part) for part in rows])
        rows, columns = np.concatenate(rows), np.concatenate(columns)
        kept = (rows >= 0) & (columns >= 0)
        order = _minimum_degree(rows[kept], columns[kept], f)
        self.particles = np.empty(f, np.int64)
        self.particles[order] = self.free
        rows, columns = order[rows[kept]], order[columns[kept]]
        key, where = np.unique(columns * f + rows, return_inverse=True)
        columns, rows = np.divmod(key, f)
        # one (3, 3) block for each pair of particles that share an element
        place = np.full(len(kept), -1)
        place[kept] = where
        self._blocks = len(key)
        diagonal, *self._places = np.split(place, ends[:-1])
        self._mass = np.bincount(diagonal, problem.mass[self.free], len(key))
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
        Return S at x plus ``mass`` [1/s²] times the mass matrix [N/m].

        Rows are x, y, z of each of ``self.particles`` in turn. ``clamp`` sets negative eigenvalues
        of each element to 0.
        """
        values = np.zeros((self._blocks, 9))
        for part, place in zip(self.problem.elements, self._places):
            block = part.blocks(x, clamp=clamp).reshape(-1, 9)
            kept = place >= 0
            for c in range(9):
                values[:, c] += np.bincount(place[kept], block[kept, c], self._blocks)
        values[:, [0, 4, 8]] += (mass * self._mass)[:, None]
        return sparse.csc_matrix((values.ravel()[self._take], self._indices, self._indptr),
                                 shape=self._shape)

    def outer(self, x: Array) -> tuple[Array, Array]:
        """Return U, shape (3 free particles, surfaces), and the diagonal of A."""
        found = [pair for part in self.problem.elements if (pair := part.outer(x)) is not None]
        columns = [u[self.particles].ravel() for u, _ in found]
        return (np.array(columns).reshape(len(found), self._shape[0]).T,
                np.array([a for _, a in found]))

    def operator(self, x: Array) -> LinearOperator:
        """Return the Hessian at x as a linear operator."""
        S, (U, a) = self.matrix(x), self.outer(x)
        return LinearOperator(self._shape, lambda z: S @ z + U @ ((U.T @ z) / a), dtype=float)

    def factor(self, x: Array, mass: float) -> 'Factor':
        """Factorize the Hessian plus ``mass`` times the mass matrix; clamped if indefinite."""
        U, a = self.outer(x)
        for clamp in (False, True):
            try:
                found = Factor(self.matrix(x, mass=mass, clamp=clamp), U, a)
            except RuntimeError:    # exactly singular
                if clamp:
                    raise
                continue
            if clamp or found.positive:
                return found
        raise AssertionError

    def stable(self, x: Array) -> bool:
        """Return whether the Hessian at x has no negative eigenvalues, up to rounding."""
        try:
            return Factor(self.matrix(x, mass=1e-6), *self.outer(x)).positive
        except RuntimeError:
            return False

    def solve(self, factor: 'Factor', force: Array) -> Array:
        """Return the displacements by forces, with those of pinned particles 0; both (n, 3)."""
        step = np.zeros_like(force)
        step[self.particles] = factor.solve(force[self.particles].ravel()).reshape(-1, 3)
        return step


class Factor:
    """A factorization of S + U A⁻¹ Uᵀ."""

    def __init__(self, S: sparse.csc_matrix, U: Array, a: Array):
        self._lu = splu(S, permc_spec='NATURAL', **LU)
        self._U, self._left = U, self._lu.solve(U) if len(a) else U
        self._inner = np.diag(a) + U.T @ self._left

    @property
    def positive(self) -> bool:
        """True if the matrix is positive definite (Sylvester, Haynsworth)."""
        lu = self._lu
        if not np.array_equal(lu.perm_r, lu.perm_c):
            return False
        inner = np.linalg.eigvalsh(self._inner) if len(self._inner) else np.zeros(0)
        return int((lu.U.diagonal() <= 0.0).sum()) == int((inner < 0.0).sum())

    def solve(self, right: Array) -> Array:
        """Return the solution of the linear system with a right-hand side."""
        first = self._lu.solve(right)
        if not len(self._inner):
            return first
        return first - self._left @ np.linalg.solve(self._inner, self._U.T @ first)


def _minimum_degree(rows: Array, columns: Array, count: int) -> Array:
    """Return the rank of each of ``count`` particles in an order with little fill-in."""
    if count == 0:
        return np.zeros(0, np.int64)
    graph = sparse.coo_matrix((np.full(len(rows), -1.0), (rows, columns)), (count, count)).tocsc()
    graph.data[:] = -1.0
    degree = np.asarray(np.abs(graph).sum(0)).ravel()
    dominant = graph + sparse.diags(degree + 1.0)
    return splu(dominant.tocsc(), permc_spec='MMD_AT_PLUS_A', **LU).perm_c.astype(np.int64)
