"""
Signed distance to a closed triangle mesh on a regular grid, computed once.

Near the surface each node has the exact distance to its nearest triangle. From there the index of
the nearest triangle is propagated from node to neighbour, in sweeps along all eight diagonals
(Tsai 2002), and each node keeps the nearest one. A node is inside if a ray along x that ends there
has entered more surfaces than it has left, so that overlapping pieces form one body.

Between nodes φ is trilinear. Parts thinner than about twice the spacing have no node deep enough
inside, and particles would pass through them; so the grid is refined until only sharp edges are
lost.

Limits: edges are rounded. Edges sharper than some 20° lose up to ROUNDED spacings.
"""

from dataclasses import dataclass, replace
from math import ceil, prod, sqrt

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.mesh_repair import orient

MOST_NODES = 16_000_000
"""largest number of nodes of a grid: 64 MB of float32"""
FINEST = 96
"""most nodes along the longest side, unless a spacing is given"""
DEEP = 0.6
"""depth of a node that particles do not pass [spacings]: of 2000 particles that fell on plates of
random orientation at up to 30 m/s, none passed plates 1.28 spacings thick, and one passed those of
1.12"""
ROUNDED = 6.0
"""largest distance by which the solid part may fall short of an edge [spacings of the unrefined
grid]"""
ASIDE = (0.37e-4, 0.61e-4)
"""offset of the rays from the nodes along y and z [spacings], so that they meet no edges of
axis-aligned meshes"""


@dataclass(frozen=True, eq=False)
class Field:
    """Signed distance field of one surface, in its own axes."""

    values: np.ndarray
    """φ [m], float32, shape (nx, ny, nz)"""
    origin: np.ndarray
    """position of node (0, 0, 0) [m], shape (3,)"""
    spacing: float
    """[m]"""
    clearance: float
    """least distance from the boundary of the grid to the surface [m]"""
    reach: float
    """radius of the bounding sphere around the origin [m]"""
    size: tuple[float, float, float]
    """extents of the surface [m]"""
    gap: float
    """largest distance from the surface that contacts may use [m]"""
    surface: tuple[np.ndarray, np.ndarray]
    """vertices and triangles that it was made from"""
    given: float | None = None
    """spacing that was asked for [m]"""

    def for_gap(self, gap: float) -> 'Field':
        """Return the field of the same surface for another gap [m]; itself if that is its own."""
        return self if gap == self.gap else distance_field(
            *self.surface, gap=gap, spacing=self.given)


class NoRoomError(InputError):
    """A grid needs more nodes than are available."""

    def __init__(self, shape, spacing: float, room: int):
        self.nodes = prod(shape)
        super().__init__(f'a spacing of {spacing:g} m takes {" × ".join(map(str, shape))} nodes, '
                         f'more than {room}; use a larger one')


def distance_field(vertices: np.ndarray, triangles: np.ndarray, *, gap: float,
                   spacing: float | None = None, room: int = MOST_NODES) -> Field:
    """
    Return the signed distance field of a closed surface.

    Raise InputError for an open surface, or one with parts too thin for the largest grid.

    Parameters
    ----------
    vertices : [m], shape (vertices, 3)
    triangles : vertex indices, shape (triangles, 3)
    gap : largest distance from the surface that contacts use, the thickness [m]
    spacing : of the grid [m]; by default the larger of the gap and the longest side over FINEST,
        halved until no thin part is lost
    room : largest number of nodes

    """
    surface = np.asarray(vertices, float), triangles
    vertices, triangles = _closed(*surface)
    usual = grid_around(vertices, gap=gap)[1]
    field = _field(vertices, triangles, gap, spacing, room)
    while not _is_resolved(field, usual):
        try:
            field = _field(vertices, triangles, gap, 0.5 * field.spacing, room)
        except NoRoomError as error:
            if error.nodes <= MOST_NODES:
                raise
            raise InputError(
                f'is so thin in places that particles pass it on a grid of {field.spacing:.3g} m, '
                f'and a finer one takes more than {MOST_NODES} nodes; make it thicker, or of '
                'boxes') from None
    if spacing is not None and field.spacing < spacing:
        raise InputError(f'is so thin in places that particles pass it on a grid of {spacing:g} '
                         f'm; use a spacing of {field.spacing:.3g} m, or leave it out')
    return replace(field, surface=surface, given=spacing)


def _is_resolved(field: Field, usual: float) -> bool:
    """
    Return True if all of the surface except sharp edges is close to nodes deeper than DEEP.

    ``usual`` is the spacing of the unrefined grid [m].
    """
    from scipy.ndimage import distance_transform_edt
    values, spacing = field.values, field.spacing
    deep = values <= -DEEP * spacing
    if not deep.any():
        return False
    away = distance_transform_edt(~deep)[np.abs(values) <= 0.5 * spacing]
    return away.max(initial=0.0) * spacing <= ROUNDED * max(usual, spacing)


def _field(vertices, triangles, gap: float, spacing: float | None, room: int) -> Field:
    low, high = vertices.min(0), vertices.max(0)
    shape, spacing, clearance = grid_around(vertices, gap=gap, spacing=spacing)
    if prod(shape) > room:
        raise NoRoomError(shape, spacing, room)
    origin = low - 0.5 * (spacing * (np.array(shape) - 1) - (high - low))
    corners = np.ascontiguousarray((vertices[triangles] - origin) / spacing)
    distance, nearest = np.full(shape, np.inf), np.full(shape, -1)
    _stamp(corners, distance, nearest)
    for _ in range(2):
        for turn in range(8):
            _propagate(corners, distance, nearest, *(1 - 2 * (turn >> k & 1) for k in range(3)))
    crossings = np.zeros(shape, np.int32)
    _count_crossings(corners, crossings, *ASIDE)
    inside = crossings.cumsum(0) > 0
    values = (np.where(inside, -distance, distance) * spacing).astype(np.float32)
    return Field(values, origin, spacing, clearance, float(np.sqrt((vertices**2).sum(1).max())),
                 tuple((high - low).tolist()), gap, (vertices, triangles))


def grid_around(vertices: np.ndarray, *, gap: float, spacing: float | None = None):
    """Return shape, spacing [m] and padding [m] of a surface's grid."""
    extent = vertices.max(0) - vertices.min(0)
    spacing = spacing or max(gap, float(extent.max()) / FINEST)
    clearance = max(4.0 * gap, 2.0 * spacing)
    shape = tuple(ceil(c / spacing) + 1 for c in (extent + 2.0 * clearance).tolist())
    return shape, spacing, clearance


def _closed(vertices, triangles):
    """Return vertices and triangles of a closed surface, oriented outward, or raise InputError."""
    if not np.isfinite(vertices).all() or not len(triangles):
        raise InputError('has no triangles' if not len(triangles) else 'has vertices that are not '
                         'finite')
    if triangles.max() >= len(vertices):
        raise InputError(f'names vertex {triangles.max()}, and has {len(vertices)}')
    vertices, same = np.unique(vertices, axis=0, return_inverse=True)
    triangles = same.reshape(-1)[triangles]
    sides = np.sort(triangles, axis=1)
    triangles = triangles[(sides[:, 1:] > sides[:, :-1]).all(1)]
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    single = int((np.unique(edges, axis=0, return_counts=True)[1] % 2).sum())
    if single or not len(triangles):
        raise InputError(f'is not closed ({single} open edges), so it has no inside; close it, or '
                         'use a box')
    return vertices, orient(vertices, triangles)[0]


@jit
def _stamp(corners, distance, nearest):
    """
    Write the exact distance [spacings] and the triangle to the nodes around each triangle.

    ``corners`` are in units of the spacing, shape (triangles, 3, 3).
    """
    nx, ny, nz = distance.shape
    for t in range(len(corners)):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        i0, i1 = _around(a[0], b[0], c[0], nx)
        j0, j1 = _around(a[1], b[1], c[1], ny)
        k0, k1 = _around(a[2], b[2], c[2], nz)
        for i in range(i0, i1):
            for j in range(j0, j1):
                for k in range(k0, k1):
                    d = _to_triangle(i, j, k, a, b, c)
                    if d < distance[i, j, k]:
                        distance[i, j, k], nearest[i, j, k] = d, t


@jit(inline=True)
def _around(a, b, c, count):
    """Return the range of nodes (first, last + 1) around three coordinates along one axis."""
    return (max(0, int(min(a, b, c)) - 1), min(count, int(max(a, b, c)) + 3))


@jit
def _propagate(corners, distance, nearest, dx, dy, dz):
    """Propagate nearest triangles from node to node in a sweep along the diagonal (dx, dy, dz)."""
    nx, ny, nz = distance.shape
    for p in range(nx):
        i = p if dx > 0 else nx - 1 - p
        for q in range(ny):
            j = q if dy > 0 else ny - 1 - q
            for r in range(nz):
                k = r if dz > 0 else nz - 1 - r
                for axis in range(3):
                    u = i - (dx if axis == 0 else 0)
                    v = j - (dy if axis == 1 else 0)
                    w = k - (dz if axis == 2 else 0)
                    if not (0 <= u < nx and 0 <= v < ny and 0 <= w < nz):
                        continue
                    t = nearest[u, v, w]
                    if t < 0 or t == nearest[i, j, k]:
                        continue
                    d = _to_triangle(i, j, k, corners[t, 0], corners[t, 1], corners[t, 2])
                    if d < distance[i, j, k]:
                        distance[i, j, k], nearest[i, j, k] = d, t


@jit
def _to_triangle(x, y, z, a, b, c):
    """Return the distance of a point to a triangle abc (Ericson 2005, 5.1)."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    px, py, pz = x - a[0], y - a[1], z - a[2]
    uu, vv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
    uv = ux * vx + uy * vy + uz * vz
    up, vp = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    area = uu * vv - uv * uv
    s, t = vv * up - uv * vp, uu * vp - uv * up
    if area > 0.0 and s >= 0.0 and t >= 0.0 and s + t <= area:
        s, t = s / area, t / area
        ex, ey, ez = px - s * ux - t * vx, py - s * uy - t * vy, pz - s * uz - t * vz
        return sqrt(ex * ex + ey * ey + ez * ez)
    return min(_to_edge(px, py, pz, ux, uy, uz), _to_edge(px, py, pz, vx, vy, vz),
               _to_edge(px - ux, py - uy, pz - uz, vx - ux, vy - uy, vz - uz))


@jit(inline=True)
def _to_edge(px, py, pz, ux, uy, uz):
    """Return the distance of a point p to the segment from 0 to u."""
    square = ux * ux + uy * uy + uz * uz
    s = min(max((px * ux + py * uy + pz * uz) / square, 0.0), 1.0) if square > 0.0 else 0.0
    ex, ey, ez = px - s * ux, py - s * uy, pz - s * uz
    return sqrt(ex * ex + ey * ey + ez * ez)


@jit
def _count_crossings(corners, crossings, aside_y, aside_z):
    """Add to the first node behind each crossing of a ray along x: 1 on entry, -1 on exit."""
    nx, ny, nz = crossings.shape
    for t in range(len(corners)):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        area = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
        if area == 0.0:
            continue
        j0, j1 = _around(a[1], b[1], c[1], ny)
        k0, k1 = _around(a[2], b[2], c[2], nz)
        for j in range(j0, j1):
            for k in range(k0, k1):
                y, z = j + aside_y, k + aside_z
                s = ((y - a[1]) * (c[2] - a[2]) - (z - a[2]) * (c[1] - a[1])) / area
                r = ((b[1] - a[1]) * (z - a[2]) - (b[2] - a[2]) * (y - a[1])) / area
                if s > 0.0 and r > 0.0 and s + r < 1.0:
                    x = a[0] + s * (b[0] - a[0]) + r * (c[0] - a[0])
                    i = max(0, int(ceil(x)))
                    if i < nx:
                        crossings[i, j, k] += -1 if area > 0.0 else 1
