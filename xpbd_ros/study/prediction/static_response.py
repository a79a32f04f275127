"""
Static response of XPBD: the residuals of constraints at rest under given tensions.

A substep starts with zero multipliers and stops after K iterations, so constraints yield more
than their compliance alone would allow. Let T be the tensions, m = w H² the mobilities and
A = J M Jᵀ. In a cloth at rest, external forces displace the particles by M JᵀT in each substep.
The iterations, which map the error f of the multipliers to G f, must undo exactly this
displacement: -T = (I - G^K) f∞ with (A + α) f∞ = -(C + A T). Hence

    C = α y + A G^K y,   (I - G^K) y = T

for each constraint and any sweep, linearised about the present positions. For a single
Gauss-Seidel pass this is C_j = α_j T_j - Σ A_jk T_k over the constraints k that are swept after j
(doc/numerics.md 4.1): later constraints displace the particles of earlier ones. The edges of a
line, solved directly, do not disturb one another. The three constraints of a triangle are solved
as one block: there T and C are vectors, and α is a matrix.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import gmres, LinearOperator, splu

from xpbd_ros.sim.constraints.line_solver import TINY
from xpbd_ros.sim.constraints.mesh_paths import LEAST

FORWARD, BACKWARD, JACOBI = 'forward', 'backward', 'jacobi'
LINES, PATHS, ONCE = 'lines', 'paths', 'once'
"""kinds of passes: Gauss-Seidel in order or in reverse order, Jacobi, direct solution of lines of
a grid or of paths of a mesh; Gauss-Seidel in order, with half of the diagonal of A"""
SOFTEST = {LINES: TINY, PATHS: LEAST}
"""least α in the matrix of a direct solution, relative to the mobilities"""
REFINEMENTS = 3
"""steps of iterative refinement, each to a relative residual of 1e-5"""


@dataclass(frozen=True, eq=False)
class StaticResponse:
    """Linearised constraints, and the passes with which a substep solves them."""

    jacobian: sparse.csr_matrix
    """J, rows in sweep order, shape (constraints, 3 particles)"""
    compliance: np.ndarray | sparse.csr_matrix
    """α [m/N], shape (constraints,); a block-diagonal matrix for coupled constraints"""
    mobility: np.ndarray
    """w H² of each particle [m/N], shape (particles,)"""
    passes: tuple[tuple[str, np.ndarray], ...]
    """passes of one iteration: kind and rows; without passes, as in an explicit solver, the
    residuals are those of the compliance alone"""
    iterations: int = 1
    """K, per substep"""
    relaxation: float = 1.0
    """ω of JACOBI"""
    block: np.ndarray | None = None
    """block in which each row is solved, ascending; None: each row in its own"""
    coupling: sparse.csr_matrix = field(init=False)
    """A [m/N], shape (constraints, constraints)"""

    def __post_init__(self):
        """Compute A; give ``compliance`` and ``block`` their general form."""
        m = sparse.diags(np.repeat(self.mobility, 3))
        coupling = (self.jacobian @ m @ self.jacobian.T).tocsr()
        object.__setattr__(self, 'coupling', coupling)
        if not sparse.issparse(self.compliance):
            object.__setattr__(self, 'compliance', sparse.diags(self.compliance).tocsr())
        if self.block is None:
            object.__setattr__(self, 'block', np.arange(coupling.shape[0]))

    def residuals(self, tension: np.ndarray) -> np.ndarray:
        """Return C [m] under tensions [N], both of shape (constraints,)."""
        alpha, A = self.compliance, self.coupling
        if not self.passes:
            return alpha @ tension
        assert self.block is not None
        if self.iterations == 1 and len(self.passes) == 1 and self.passes[0][0] == FORWARD:
            return alpha @ tension - (A - _solved_part(A, self.block, FORWARD)) @ tension
        system = (A + alpha).tocsr()
        factors = [(rows, system[rows], _factor(kind, A[rows][:, rows], alpha[rows][:, rows],
                                                self.block[rows], self.relaxation))
                   for kind, rows in self.passes if len(rows)]

        def remaining(e):    # G^K e
            e = e.copy()
            for _ in range(self.iterations):
                for rows, part, factor in factors:
                    e[rows] -= factor.solve(part @ e)
            return e

        operator = LinearOperator(system.shape, lambda e: e - remaining(np.ravel(e)), dtype=float)
        y = np.zeros_like(tension)
        for _ in range(REFINEMENTS):    # SciPy versions name the tolerance differently
            y += gmres(operator, tension - (y - remaining(y)), restart=60, maxiter=20)[0]
        return alpha @ y + A @ remaining(y)


def _solved_part(A, block: np.ndarray, kind: str):
    """Return the lower (FORWARD), upper (BACKWARD) or only diagonal (JACOBI) blocks of A."""
    A = A.tocoo()
    i, j = block[A.row], block[A.col]
    kept = {FORWARD: i >= j, BACKWARD: i <= j, JACOBI: i == j}[kind]
    return sparse.csr_matrix((A.data[kept], (A.row[kept], A.col[kept])), A.shape)


def _factor(kind: str, A, alpha, block: np.ndarray, relaxation: float):
    """Return the factorization of the part of A + α that a pass solves; immobile rows are 1."""
    A = A + sparse.diags((A.diagonal() + alpha.diagonal() == 0.0).astype(float))
    if kind in SOFTEST:
        split = A + sparse.diags(np.maximum(alpha.diagonal(), SOFTEST[kind] * A.diagonal()))
        return splu(split.tocsc())
    if kind == JACOBI:
        return splu((_solved_part(A, block, kind) / relaxation + alpha).tocsc())
    if kind == ONCE:
        split = (_solved_part(A, block, FORWARD) - 0.5 * _solved_part(A, block, JACOBI) + alpha)
    else:
        split = _solved_part(A + alpha, block, kind)
    return splu(split.tocsc(), permc_spec='NATURAL', diag_pivot_thresh=0.0,
                options={'SymmetricMode': True})
