"""
Conversion of triangles and tetrahedra from a file to a ``Mesh``, with repair or refusal.

Repaired, with a note: coincident vertices, duplicate and collapsed cells, unused vertices,
inverted cells. Refused, with the index of the cell in the file (from 0): non-finite coordinates,
degenerate cells, edges with three triangles, faces with three tetrahedra. All tolerances are
relative to the mesh, independent of the unit of length.
"""

import numpy as np

from xpbd_ros.errors import counted, InputError, plural
from xpbd_ros.sim.geometry.mesh import cross, dot, length, Mesh

FLAT = 1e-4
"""height over longest edge of a triangle (6 volume over cubed edge), below which it is refused"""
NEEDLE = 0.02
"""the same ratio, below which the mesh gets a note"""


def surface_mesh(vertices: np.ndarray, triangles: np.ndarray,
                 warp: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> Mesh:
    """
    Return the mesh of a cloth, repaired.

    Parameters
    ----------
    vertices : [m], shape (vertices, 3)
    triangles : vertex indices, shape (triangles, 3)
    warp : direction of the warp, of any length > 0

    """
    positions, triangles, notes = _clean(vertices, triangles, 'triangle')
    _refuse_shared_thrice(triangles[:, [[0, 1], [1, 2], [2, 0]]], 'edge', 'triangle')
    triangles, found = orient(positions, triangles)
    size = _size(positions)
    area = 0.5 * length(_normals(positions / size, triangles)) * size * size
    return Mesh(positions, triangles, _tributary(area / 3.0, triangles, len(positions)),
                warp=_unit(warp), notes=(*notes, *found))


def solid_mesh(vertices: np.ndarray, tetrahedra: np.ndarray,
               warp: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> Mesh:
    """
    Return the mesh of a solid body, repaired; its triangles are its boundary.

    Parameters
    ----------
    vertices : [m], shape (vertices, 3)
    tetrahedra : vertex indices, shape (tetrahedra, 4)
    warp : direction of the warp, of any length > 0

    """
    positions, tetrahedra, notes = _clean(vertices, tetrahedra, 'tetrahedron')
    size = _size(positions)
    volume = _volumes(positions / size, tetrahedra) * size * size * size
    turned = volume < 0.0
    tetrahedra[turned] = tetrahedra[turned][:, [1, 0, 2, 3]]
    if turned.any():
        notes.append(f'{counted(turned.sum(), "tetrahedron")} inside out; turned')
    faces = tetrahedra[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]]
    _refuse_shared_thrice(faces, 'face', 'tetrahedron')
    faces = faces.reshape(-1, 3)
    _, inverse, times = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True,
                                  return_counts=True)
    skin = faces[times[inverse.ravel()] == 1]
    return Mesh(positions, skin,
                _tributary(np.abs(volume) / 4.0, tetrahedra, len(positions)),
                tetrahedra=tetrahedra, warp=_unit(warp), notes=tuple(notes))


def _clean(vertices, cells, kind: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """
    Return positions and cells without duplicate, collapsed and unused parts, and notes on these.

    Parameters
    ----------
    vertices : [m], shape (vertices, 3)
    cells : vertex indices, shape (cells, corners)
    kind : 'triangle' or 'tetrahedron', for messages

    """
    notes = []
    vertices, cells = np.asarray(vertices, float), np.array(cells, np.int64)
    if not len(cells):
        raise InputError(f'has no {plural(kind)}')
    if cells.min() < 0 or cells.max() >= len(vertices):
        bad = np.flatnonzero(((cells < 0) | (cells >= len(vertices))).any(1))[0]
        raise InputError(f'{kind} {bad} names a vertex that does not exist '
                         f'(got {cells[bad].tolist()}, there are {len(vertices)} vertices)')
    used = np.unique(cells)
    bad = used[~np.isfinite(vertices[used]).all(1)]
    if len(bad):
        raise InputError(f'vertex {bad[0]} must be finite (got {vertices[bad[0]].tolist()} m)')
    place = np.zeros_like(vertices)
    place[used] = vertices[used]
    number, merged = _merge(place, used)
    if merged:
        notes.append(f'{counted(merged, "vertex")} at the place of another; merged')
    cells = number[cells]
    which = np.arange(len(cells))    # indices in the file
    ordered = np.sort(cells, axis=1)
    collapsed = (ordered[:, 1:] == ordered[:, :-1]).any(1)
    if collapsed.any():
        notes.append(f'{counted(collapsed.sum(), kind)} with an edge of length zero; left out')
    _, first = np.unique(ordered, axis=0, return_index=True)
    double = np.ones(len(cells), bool)
    double[first] = False
    double &= ~collapsed
    if double.any():
        notes.append(f'{counted(double.sum(), kind)} there twice; left out')
    keep = ~(collapsed | double)
    cells, which = cells[keep], which[keep]
    if not len(cells):
        raise InputError(f'has no {kind} with corners in different places')
    used = np.unique(cells)
    unused = len(vertices) - merged - len(used)
    if unused:
        notes.append(f'{counted(unused, "vertex")} that no {kind} uses; left out')
    if merged or unused:
        number = np.zeros(len(vertices), np.int64)
        number[used] = np.arange(len(used))
        cells = number[cells]
        notes.append('particles are numbered without what is left out')
    positions = vertices[used]
    notes += _check_shapes(positions, cells, which, kind)
    return positions, cells, notes


def _merge(place: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the first used vertex at the position of each one, and the number of duplicates."""
    _, first, inverse = np.unique(place[used], axis=0, return_index=True, return_inverse=True)
    number = np.arange(len(place))
    number[used] = used[first[inverse.ravel()]]
    return number, len(used) - len(first)


def _check_shapes(positions, cells, which, kind: str) -> list[str]:
    """Raise InputError for degenerate cells; return notes on thin ones (FLAT, NEEDLE)."""
    positions = positions / _size(positions)
    corners = cells.shape[1]
    longest = np.max([length(positions[cells[:, a]] - positions[cells[:, b]])
                      for a in range(corners) for b in range(a)], axis=0)
    shape = (length(_normals(positions, cells)) / longest**2 if corners == 3
             else 6.0 * np.abs(_volumes(positions, cells)) / longest**3)
    flat = np.flatnonzero(~(shape > FLAT))
    if len(flat):
        how = 'its corners lie in line' if corners == 3 else 'its corners are flat'
        raise InputError(
            f'{kind} {which[flat[0]]} is degenerate: {how} ({counted(len(flat), kind)} so); '
            'remove or remesh such cells in the program that made the file')
    needles = (shape < NEEDLE).sum()
    if needles:
        return [f'{counted(needles, kind)} like needles (worst {shape.min():.2g} high on 1 long); '
                'accuracy suffers there, remesh']
    return []


def _refuse_shared_thrice(facets: np.ndarray, facet: str, kind: str) -> None:
    """Raise InputError if an edge has three triangles, or a face three tetrahedra."""
    ends = np.sort(facets.reshape(-1, facets.shape[2]), axis=1)
    found, times = np.unique(ends, axis=0, return_counts=True)
    bad = found[times > 2]
    if len(bad):
        raise InputError(
            f'{counted(len(bad), facet)} with more than two {plural(kind)}, the first between '
            f'particles {", ".join(map(str, bad[0]))}; split the mesh there, or remove what is '
            'double in the program that made the file')


def orient(positions: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """
    Orient neighbouring triangles consistently, and closed surfaces outward.

    Returns
    -------
    triangles, and notes on the changes

    """
    directed = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    owner = np.repeat(np.arange(len(triangles)), 3)
    key = np.sort(directed, axis=1)
    order = np.lexsort((owner, key[:, 1], key[:, 0]))
    at = np.flatnonzero((key[order][:-1] == key[order][1:]).all(1))
    one, other = order[at], order[at + 1]
    against = (directed[one] == directed[other]).all(1)    # same direction: opposite orientation
    neighbours: list[list[tuple[int, bool]]] = [[] for _ in triangles]
    for s, t, disagree in zip(owner[one].tolist(), owner[other].tolist(), against.tolist()):
        neighbours[s].append((t, disagree))
        neighbours[t].append((s, disagree))
    turned, piece, twisted = _propagate_orientation(neighbours)
    pieces = piece.max() + 1
    wrong = np.bincount(piece, turned, pieces) * 2.0 > np.bincount(piece, minlength=pieces)
    turned = (turned ^ wrong[piece]) & (not twisted)
    notes = []
    if turned.any():
        notes.append(f'{counted(turned.sum(), "triangle")} turned over; mended')
    triangles = np.where(turned[:, None], triangles[:, ::-1], triangles)
    if twisted:
        notes.append('the surface has one side only, like a Möbius strip')
    count = np.bincount(piece, minlength=pieces)
    closed = np.bincount(piece[owner[one]], minlength=pieces) * 2 == 3 * count
    scaled = (positions - positions[0]) / _size(positions)
    a, b, c = (scaled[triangles[:, k]] for k in range(3))
    inward = closed & (np.bincount(piece, dot(a, cross(b, c)), pieces) < 0.0) & (not twisted)
    if inward.any():
        notes.append(f'{counted(inward.sum(), "closed surface")} inside out; turned')
        triangles = np.where(inward[piece][:, None], triangles[:, ::-1], triangles)
    apart = 1 if pieces == 1 else _count_pieces(triangles)
    if apart > 1:
        notes.append(f'{apart} separate pieces; nothing joins them')
    return triangles, notes


def _propagate_orientation(neighbours: list) -> tuple[np.ndarray, np.ndarray, bool]:
    """
    Propagate the orientation of a first triangle over each connected piece.

    Parameters
    ----------
    neighbours : for each triangle, a list of (neighbour, True if oriented oppositely)

    Returns
    -------
    triangles to flip; piece of each triangle; True if a piece has no consistent orientation

    """
    count = len(neighbours)
    turned, piece, twisted, pieces = [False] * count, [-1] * count, False, 0
    for root in range(count):
        if piece[root] >= 0:
            continue
        piece[root] = pieces
        to_do = [root]
        while to_do:
            s = to_do.pop()
            for t, disagree in neighbours[s]:
                if piece[t] < 0:
                    piece[t], turned[t] = pieces, turned[s] ^ disagree
                    to_do.append(t)
                elif turned[t] != turned[s] ^ disagree:
                    twisted = True
        pieces += 1
    return np.array(turned), np.array(piece), twisted


def _count_pieces(triangles: np.ndarray) -> int:
    """Return the number of groups of triangles that share no particle with others."""
    from scipy import sparse
    number, corners = np.unique(triangles, return_inverse=True)
    a, b, c = corners.reshape(-1, 3).T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    graph = sparse.coo_matrix((np.ones(len(ends[0])), ends), (len(number), len(number)))
    return sparse.csgraph.connected_components(graph, directed=False)[0]


def _size(positions) -> float:
    """Return the extent rounded down to a power of two [m]: division by it is exact."""
    extent = np.ptp(positions, axis=0).max()
    if not np.isfinite(extent):
        raise InputError('must have a finite extent (got one beyond all numbers)')
    return float(np.ldexp(1.0, np.frexp(extent)[1] - 1))


def _normals(positions, triangles) -> np.ndarray:
    """Return normals whose length is twice the area, shape (triangles, 3)."""
    a, b, c = (positions[triangles[:, k]] for k in range(3))
    return cross(b - a, c - a)


def _volumes(positions, tetrahedra) -> np.ndarray:
    a, b, c, d = (positions[tetrahedra[:, k]] for k in range(4))
    return dot(cross(b - a, c - a), d - a) / 6.0


def _tributary(share, cells, count: int) -> np.ndarray:
    """Return the sum of ``share`` over the cells of each particle, shape (count,)."""
    return np.bincount(cells.ravel(), np.repeat(share, cells.shape[1]), count)


def _unit(direction) -> tuple[float, float, float]:
    size = max(map(abs, direction))
    if not size > 0.0:
        raise InputError('warp: must not be zero (a direction, such as [1, 0, 0])')
    scaled = np.array(direction) / size
    return tuple((scaled / length(scaled)).tolist())
