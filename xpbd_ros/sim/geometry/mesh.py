"""Rest shape of a cloth or body: positions, triangles, hinges, tributary areas; flat grids."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from xpbd_ros.sim.backend.simd_vector3 import cross, dot, length  # noqa: F401  (for users of meshes)

SQUARE = 1e-3
"""largest relative difference of the sides of a square cell"""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangulated rest shape in its own coordinates: a grid, a surface or the skin of a body."""

    positions: np.ndarray
    """[m], shape (particles, 3)"""
    triangles: np.ndarray
    """particle indices, counter-clockwise seen from outside (of a grid: from +z), shape
    (triangles, 3)"""
    area: np.ndarray
    """tributary area of each particle [m²], or tributary volume of tetrahedra [m³]; shape
    (particles,)"""
    grid: np.ndarray | None = None
    """particle index by row (weft) and column (warp), shape (rows, columns); None if no grid"""
    spacing: tuple[float, float] | None = None
    """rest distance of neighbours along warp and weft [m]; None if no grid"""
    tetrahedra: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), np.int64))
    """particle indices, positive volume, shape (tetrahedra, 4); empty for cloth"""
    warp: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """direction of the warp, a unit vector"""
    notes: tuple[str, ...] = ()
    """repairs and suspicious shapes, messages for the user"""

    @cached_property
    def edges(self) -> np.ndarray:
        """Unique edges, particle indices in rising order, shape (edges, 2)."""
        return edges(np.concatenate([cells[:, pairs].reshape(-1, 2) for cells, pairs in (
            (self.triangles, [[0, 1], [1, 2], [2, 0]]),
            (self.tetrahedra, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]))]))

    @cached_property
    def gap(self) -> float:
        """Largest rest distance of neighbours [m]."""
        if self.spacing is not None:
            return max(self.spacing)
        a, b = (self.positions[self.edges[:, k]] for k in (0, 1))
        return float(length(a - b).max())

    @cached_property
    def hinges(self) -> np.ndarray:
        """Edge start, edge end and the two opposite particles, shape (hinges, 4)."""
        return hinges(self.triangles)

    @cached_property
    def rank(self) -> np.ndarray:
        """Position of each particle in Cuthill-McKee order, shape (particles,)."""
        return cuthill_mckee(self.edges, len(self.positions))


def grid_mesh(size: tuple[float, float], resolution: tuple[int, int]) -> Mesh:
    """
    Return a flat rectangular grid with its corner at the origin and alternating diagonals.

    Each cell gives a quarter of its area to each of its corners, so that particles on the boundary
    have half the mass of interior ones and a hanging strip stretches exactly as the continuum does
    (doc/numerics.md 5.12).

    Parameters
    ----------
    size : extent along warp (x) and weft (y) [m]
    resolution : particles along warp and weft, each at least 1

    """
    columns, rows = resolution
    dx, dy = spacing = grid_spacing(size, resolution)
    grid = np.arange(rows * columns).reshape(rows, columns)
    positions = np.zeros((rows, columns, 3))
    positions[..., 0] = np.arange(columns) * dx if columns > 1 else 0.0
    positions[..., 1] = (np.arange(rows) * dy if rows > 1 else np.zeros(1))[:, None]
    a, b, c, d = (corner.ravel() for corner in (
        grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    row, column = np.divmod(np.arange(a.size), max(columns - 1, 1))
    even = ((row + column) % 2 == 0)[:, None, None]
    rising = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1)
    falling = np.stack([np.stack([a, b, d], 1), np.stack([b, c, d], 1)], 1)
    triangles = np.where(even, rising, falling).reshape(-1, 3)
    return Mesh(positions.reshape(-1, 3), triangles,
                np.outer(_share(rows, dy), _share(columns, dx)).ravel(), grid, spacing)


def grid_spacing(size: tuple[float, float], resolution: tuple[int, int]) -> tuple[float, float]:
    """Return the distance of neighbours along warp and weft [m]; the extent if there are none."""
    along_warp, along_weft = (s / (n - 1) if n > 1 else s for s, n in zip(size, resolution))
    return along_warp, along_weft


def is_square(spacing: tuple[float, float]) -> bool:
    """Return True if the sides of a cell are equal within the relative tolerance SQUARE."""
    return abs(spacing[0] - spacing[1]) <= SQUARE * max(spacing)


def _share(count: int, spacing: float) -> np.ndarray:
    """Return the tributary length of each point of a row [m]: half a spacing at the ends."""
    share = np.full(count, spacing)
    if count > 1:
        share[[0, -1]] = 0.5 * spacing
    return share


def edges(pairs: np.ndarray) -> np.ndarray:
    """Return unique pairs of particles, indices in rising order, shape (edges, 2)."""
    return np.unique(np.sort(pairs, axis=1), axis=0)


def cuthill_mckee(edges: np.ndarray, count: int) -> np.ndarray:
    """
    Return the position of each particle in the order of Cuthill and McKee (1969), shape (count,).

    The order is breadth first from a particle of least degree, neighbours of lower degree first;
    it places neighbours near each other. Implemented here because the order determines the bits of
    a run: scipy's implementation sorts with an algorithm that depends on the CPU.
    """
    both = np.concatenate([edges, edges[:, ::-1]])
    degree = np.bincount(both[:, 0], minlength=count)
    both = both[np.lexsort((both[:, 1], degree[both[:, 1]], both[:, 0]))]
    start = np.concatenate([[0], np.cumsum(degree)]).tolist()
    neighbours = both[:, 1].tolist()
    order: list[int] = []
    seen = [False] * count
    for root in np.argsort(degree, kind='stable').tolist():
        if seen[root]:
            continue
        seen[root] = True
        done = len(order)
        order.append(root)
        while done < len(order):
            i = order[done]
            done += 1
            for j in neighbours[start[i]:start[i + 1]]:
                if not seen[j]:
                    seen[j] = True
                    order.append(j)
    rank = np.zeros(count, np.int64)
    rank[order] = np.arange(count)
    return rank


def hinges(triangles: np.ndarray) -> np.ndarray:
    """
    Return the hinges of a mesh: pairs of triangles that share an edge.

    Returns
    -------
    particle indices (edge start, edge end, opposite, opposite), shape (hinges, 4), in the order in
    which the edges first appear

    """
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    opposite = triangles[:, [2, 0, 1]].ravel()
    key = np.sort(edges, axis=1)
    order = np.lexsort((np.arange(len(key)), key[:, 1], key[:, 0]))
    key, opposite = key[order], opposite[order]
    shared = np.flatnonzero((key[:-1] == key[1:]).all(1))
    found = np.column_stack([key[shared], opposite[shared], opposite[shared + 1]])
    return found[np.argsort(order[shared], kind='stable')]


def edge_areas(triangles: np.ndarray, edges: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """
    Return the total area of the triangles at each edge [m²], shape (edges,).

    Parameters
    ----------
    triangles : particle indices, shape (triangles, 3)
    edges : particle indices of all edges of the triangles, shape (edges, 2)
    positions : [m], shape (particles, 3)

    """
    area = triangle_areas(positions[triangles])
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    count = len(positions)
    keys = np.sort(edges, 1) @ [count, 1]
    order = np.argsort(keys)
    place = order[np.searchsorted(keys, sides @ [count, 1], sorter=order)]
    return np.bincount(place, np.repeat(area, 3), len(edges))


def triangle_areas(corners: np.ndarray) -> np.ndarray:
    """Return areas [m²], shape (triangles,); corners [m], (triangles, 3, 3)."""
    return 0.5 * length(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
