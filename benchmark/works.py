"""What is computed: particles and the constraint list that every candidate gets."""

from dataclasses import dataclass

import numpy as np

from xpbd_ros.study import reference

FRAME_DT = 1 / 60
"""[s]"""
SUBSTEPS = 10
"""per frame, with one iteration each"""


@dataclass(frozen=True, eq=False)
class Edges:
    """Distance constraints, in the order in which one would write them down."""

    particles: np.ndarray
    """shape (edges, 2)"""
    rest_length: np.ndarray
    """[m], shape (edges,)"""
    compliance: np.ndarray
    """[m/N], shape (edges,)"""

    def ordered(self, order: np.ndarray) -> 'Edges':
        """Return the same edges in another order."""
        return Edges(self.particles[order], self.rest_length[order], self.compliance[order])


@dataclass(frozen=True, eq=False)
class Hinges:
    """Bending as linear vector constraints: C = Σ weight x."""

    particles: np.ndarray
    """shape (hinges, 4)"""
    weight: np.ndarray
    """shape (hinges, 4)"""
    compliance: np.ndarray
    """[m/N], shape (hinges,)"""


@dataclass(frozen=True, eq=False)
class Work:
    """Particles at rest, and what holds them together."""

    n: int
    """particles along a side"""
    x: np.ndarray
    """[m], shape (particles, 3)"""
    inv_mass: np.ndarray
    """[1/kg], shape (particles,); 0 where pinned"""
    gravity: tuple[float, float, float]
    """[m/s²]"""
    edges: Edges | None = None
    hinges: Hinges | None = None
    kinds: tuple = ()
    """(rest length, compliance) of structural, diagonal and next-but-one edges of the grid work"""

    @property
    def projections(self) -> int:
        """Constraints."""
        return sum(len(batch.particles) for batch in (self.edges, self.hinges) if batch)


GRAVITY = (0.0, 0.0, -9.81)
FAMILIES = ((0, (0, 0), (0, 1)), (0, (0, 0), (1, 0)), (1, (0, 0), (1, 1)), (1, (0, 1), (1, 0)),
            (2, (0, 0), (0, 2)), (2, (0, 0), (2, 0)))
"""edges of the grid work, in its order: kind, (row, column) of both particles from a cell"""


def grid_work(n: int) -> Work:
    """
    Return the list of MEASURED.md: structural, both diagonals, and next but one.

    1 m², 0.2 kg spread evenly, two corners pinned, let go from the horizontal. Family by family,
    each by rising cell.
    """
    d = 1 / (n - 1)
    kinds = ((d, 1e-6), (2**0.5 * d, 1e-5), (2 * d, 1e-2))
    grid = np.arange(n * n).reshape(n, n)
    pairs, rest, compliance = [], [], []
    for kind, a, b in FAMILIES:
        rows, columns = (n - max(ends) for ends in zip(a, b))
        ends = [grid[i:i + rows, j:j + columns].ravel() for i, j in (a, b)]
        pairs.append(np.stack(ends, 1))
        rest.append(np.full(rows * columns, kinds[kind][0]))
        compliance.append(np.full(rows * columns, kinds[kind][1]))
    return Work(n, _flat(n), _even_mass(n), GRAVITY,
                Edges(*map(np.concatenate, (pairs, rest, compliance))), kinds=kinds)


def irregular_work(n: int) -> Work:
    """Return the edges of a Delaunay triangulation of n² jittered points; two corners pinned."""
    from scipy.spatial import Delaunay
    random = np.random.default_rng(0)
    x = _flat(n)
    x[:, :2] += random.uniform(-0.35, 0.35, (n * n, 2)) / (n - 1)
    triangles = np.sort(Delaunay(x[:, :2]).simplices, axis=1)
    pairs = np.unique(triangles[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=0)
    rest = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    inside = rest < 3 / (n - 1)    # not the slivers along the rim
    pairs, rest = pairs[inside], rest[inside]
    return Work(n, x, _even_mass(n), GRAVITY,
                Edges(pairs.astype(np.int64), rest, np.full(len(rest), 1e-6)))


@dataclass(frozen=True, eq=False)
class LineWork:
    """
    The lines of one direction of an n × n grid, with masses of any value.

    A line's edges are alike in length and compliance, all lines alike in length.
    An edge stands where its first particle does, so the last place of a line is empty.
    """

    n: int
    h: float
    """substep [s]"""
    along: bool
    """whether a line is a row of the arrays below, not a column"""
    x: np.ndarray
    """[m], shape (n, n, 3)"""
    inv_mass: np.ndarray
    """[1/kg], shape (n, n)"""
    rest_length: np.ndarray
    """[m], shape (n, n)"""
    compliance: np.ndarray
    """[m/N], shape (n, n)"""

    @property
    def projections(self) -> int:
        """Edges."""
        return self.n * (self.n - 1)

    def as_work(self) -> Work:
        """Return the same edges as a list, by rising first particle."""
        first, second = ((slice(None), slice(None, -1)), (slice(None), slice(1, None)))
        if not self.along:
            first, second = first[::-1], second[::-1]
        grid = np.arange(self.n**2).reshape(self.n, self.n)
        edges = Edges(np.column_stack([grid[first].ravel(), grid[second].ravel()]),
                      self.rest_length[first].ravel(), self.compliance[first].ravel())
        return Work(self.n, self.x.reshape(-1, 3), self.inv_mass.ravel(), GRAVITY, edges)


def line_work(n: int, *, along: bool) -> LineWork:
    """Return a wrinkled sheet of about 5 kN/m and 0.2 kg/m², with pins on its rim and inside."""
    random = np.random.default_rng(1)
    d = 1 / (n - 1)
    x = _flat(n).reshape(n, n, 3) + 0.05 * d * random.standard_normal((n, n, 3))
    inv_mass = random.uniform(0.5, 2.0, (n, n)) / (0.2 * d * d)
    inv_mass[0, 0] = inv_mass[0, -1] = inv_mass[n // 2, n // 3] = 0.0
    compliance = random.uniform(0.5, 2.0, n) / 5000.0
    return LineWork(n, FRAME_DT / 32, along, x, inv_mass, np.full((n, n), 1.01 * d),
                    np.ascontiguousarray(np.broadcast_to(
                        compliance[:, None] if along else compliance, (n, n))))


def bend_work(n: int) -> Work:
    """Return what resists bending in a grid, crumpled, its masses uneven."""
    random = np.random.default_rng(2)
    d = 1 / (n - 1)
    particles, weight = bends_of_grid(n)
    x = _flat(n) + 0.1 * d * random.standard_normal((n * n, 3))
    inv_mass = random.uniform(0.5, 2.0, n * n) / (0.2 * d * d)
    inv_mass[[0, n - 1]] = 0.0
    return Work(n, x, inv_mass, GRAVITY, hinges=Hinges(
        particles, weight, np.full(len(particles), 1e-3)))


def bends_of_grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Return three in a row, three in a column, and the four of a cell; and their weights.

    Of three, the one in the middle comes first too, with no weight.
    """
    p = np.arange(n * n).reshape(n, n)
    lists = [((p[:, 1:-1], p[:, :-2], p[:, 1:-1], p[:, 2:]), (0.0, 1.0, -2.0, 1.0)),
             ((p[1:-1], p[:-2], p[1:-1], p[2:]), (0.0, 1.0, -2.0, 1.0)),
             ((p[:-1, :-1], p[:-1, 1:], p[1:, :-1], p[1:, 1:]), (1.0, -1.0, -1.0, 1.0))]
    particles = [np.stack([q.ravel() for q in corners], 1) for corners, _ in lists]
    return np.concatenate(particles), np.concatenate(
        [np.tile(weight, (len(q), 1)) for q, (_, weight) in zip(particles, lists)])


def scene_work(problem, n: int) -> Work:
    """
    Return a compiled scene of one n × n cloth as the list that one would have written by hand.

    Parameters
    ----------
    problem : what ``xpbd_ros.study.reference.problem_of`` says of the simulation

    Bending comes first, then the diagonals, then warp and weft (what is projected last holds
    best); within each kind the constraints are sorted by their first particle.
    """
    ends, rest_length, stiffness = problem.all_of(reference.Edges)
    first, second = np.sort(ends, axis=1).T
    kind = np.select([second - first == d for d in (n + 1, n - 1, 1, n)], range(4), 4)
    order = np.lexsort((first, kind))
    edges = Edges(ends, rest_length, 1.0 / stiffness).ordered(order)
    hinges = None
    if bends := problem.all_of(reference.LinearSums):
        particles, weight, stiffness = bends
        order = np.argsort(particles[:, 0], kind='stable')
        hinges = Hinges(particles[order], weight[order], 1.0 / stiffness[order])
    return Work(n, problem.x, np.where(problem.pinned, 0.0, 1.0 / problem.mass),
                tuple(problem.gravity), edges, hinges)


def _flat(n: int) -> np.ndarray:
    i, j = np.indices((n, n)) / (n - 1)
    return np.stack([j, i, np.zeros((n, n))], -1).reshape(-1, 3)


def _even_mass(n: int) -> np.ndarray:
    inv_mass = np.full(n * n, n * n / 0.2)
    inv_mass[[0, n - 1]] = 0.0
    return inv_mass
