"""
The law of artificial compliance: how far constraints give under given forces in XPBD at rest.

A substep starts with multipliers at 0 and stops after K iterations, so that constraints give more
than their compliance says. With tensions T, mobilities m = w H² and A = J M Jᵀ, a cloth that hangs
still starts each substep moved by M JᵀT; its iterations, errors of which go f -> G f, must take
exactly this back: -T = (I - G^K) f∞ with (A + α) f∞ = -(C + A T). Hence

    C = α y + A G^K y,   (I - G^K) y = T

per constraint and for any sweep, linearised about where the cloth is. One Gauss-Seidel pass makes
of it C_j = α_j T_j - Σ A_jk T_k over the k that are swept after j (doc/numerics.md 4.1): a
constraint gives what later ones take from it. Lines, solved whole, take nothing from one another.
What a triangle has three of is solved together: T and C are vectors, and α is their block.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import gmres, LinearOperator, splu

from xpbd_ros.sim.constraints.line_solver import TINY

FORTH, BACK, WHOLE, APART = 'forth', 'back', 'whole', 'apart'
"""Gauss-Seidel in order, in reverse, all solved at once, or each for itself (Jacobi)"""
REFINEMENTS = 3
"""solutions of what is left, each to 1e-5"""


@dataclass(frozen=True, eq=False)
class Law:
    """Constraints about a place, and how a substep sweeps them."""

    jacobian: sparse.csr_matrix
    """J, rows in sweep order; shape (constraints, 3 particles)"""
    compliance: np.ndarray | sparse.csr_matrix
    """α [m/N], shape (constraints,); a matrix where several are coupled"""
    mobility: np.ndarray
    """w H² of each particle [m/N], shape (particles,)"""
    passes: tuple[tuple[str, np.ndarray], ...]
    """of one iteration: FORTH, BACK, WHOLE or APART, and the rows that it takes; none: forces are
    those where the substep starts, and there is no artefact"""
    iterations: int = 1
    relaxation: float = 1.0
    """ω of APART"""
    block: np.ndarray | None = None
    """which block each row is solved in, rising; None: each in its own"""
    coupling: sparse.csr_matrix = field(init=False)
    """A [m/N], shape (constraints, constraints)"""

    def __post_init__(self):
        """Work out A and the factors of each pass."""
        m = sparse.diags(np.repeat(self.mobility, 3))
        coupling = (self.jacobian @ m @ self.jacobian.T).tocsr()
        object.__setattr__(self, 'coupling', coupling)
        if not sparse.issparse(self.compliance):
            object.__setattr__(self, 'compliance', sparse.diags(self.compliance).tocsr())
        if self.block is None:
            object.__setattr__(self, 'block', np.arange(coupling.shape[0]))

    def stretches(self, tension: np.ndarray) -> np.ndarray:
        """Return C of each constraint [m] under these tensions [N]."""
        alpha, A = self.compliance, self.coupling
        if not self.passes:
            return alpha @ tension
        if self.iterations == 1 and len(self.passes) == 1 and self.passes[0][0] == FORTH:
            return alpha @ tension - (A - _kept(A, self.block, FORTH)) @ tension
        system = (A + alpha).tocsr()
        factors = [(rows, system[rows], _factor(kind, A[rows][:, rows], alpha[rows][:, rows],
                                                self.block[rows], self.relaxation))
                   for kind, rows in self.passes if len(rows)]

        def left(e):
            e = e.copy()
            for _ in range(self.iterations):
                for rows, part, factor in factors:
                    e[rows] -= factor.solve(part @ e)
            return e

        operator = LinearOperator(system.shape, lambda e: e - left(np.ravel(e)), dtype=float)
        y = np.zeros_like(tension)
        for _ in range(REFINEMENTS):    # scipy's names for a tolerance change; its default stays
            y += gmres(operator, tension - (y - left(y)), restart=60, maxiter=20)[0]
        return alpha @ y + A @ left(y)


def _kept(A, block: np.ndarray, kind: str):
    """Return the entries of rows that a pass solves before (FORTH), after (BACK) or with them."""
    A = A.tocoo()
    i, j = block[A.row], block[A.col]
    kept = {FORTH: i >= j, BACK: i <= j, APART: i == j}[kind]
    return sparse.csr_matrix((A.data[kept], (A.row[kept], A.col[kept])), A.shape)


def _factor(kind: str, A, alpha, block: np.ndarray, relaxation: float):
    """Return the factors of what one pass solves exactly; what cannot move does nothing."""
    A = A + sparse.diags((A.diagonal() + alpha.diagonal() == 0.0).astype(float))
    if kind == WHOLE:
        split = A + sparse.diags(np.maximum(alpha.diagonal(), TINY * A.diagonal()))
        return splu(split.tocsc())
    split = _kept(A + alpha, block, kind)
    if kind == APART:
        return splu((split / relaxation).tocsc())
    return splu(split.tocsc(), permc_spec='NATURAL', diag_pivot_thresh=0.0,
                options={'SymmetricMode': True})
