"""Small meshes, as arrays, texts and files."""

import atexit
from pathlib import Path
import shutil
import tempfile

import numpy as np
import pytest
from scipy import spatial

BOX_FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5], [2, 3, 7],
                  [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 7, 3], [1, 5, 7]])
"""of ``box_surface``, outward"""


def disc(rings: int = 4, radius: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """
    Return vertices and triangles of a flat disc about the origin, facing up.

    Six particles more in each ring, all triangles of about the same size.
    """
    vertices, triangles, first = [(0.0, 0.0, 0.0)], [], [0]
    for k in range(1, rings + 1):
        first.append(len(vertices))
        for j in range(6 * k):
            angle = 2.0 * np.pi * j / (6 * k)
            r = radius * k / rings
            vertices.append((r * np.cos(angle), r * np.sin(angle), 0.0))
    for k in range(1, rings + 1):
        for side in range(6):
            for j in range(k):
                outer = [first[k] + (side * k + j + d) % (6 * k) for d in (0, 1)]
                inner = [first[k - 1] + (side * (k - 1) + j + d) % max(6 * (k - 1), 1)
                         for d in (0, 1)]
                triangles.append((outer[0], outer[1], inner[0]))
                if j < k - 1:
                    triangles.append((inner[0], outer[1], inner[1]))
    return np.array(vertices), np.array(triangles)


def irregular(cells: int = 12, size: float = 1.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """
    Return vertices and triangles of a square about the origin, with edges of about size / cells.

    Vertices inside are off the points of a lattice by up to 0.35 of an edge along each axis; the
    sides have one vertex at each multiple of size / cells.
    """
    h, half = size / cells, 0.5 * size
    side = np.linspace(-half, half, cells, endpoint=False)
    rim = np.concatenate([np.stack(ends, 1) for ends in (
        (side, 0.0 * side - half), (0.0 * side + half, side), (-side, 0.0 * side + half),
        (0.0 * side - half, -side))])
    rows = np.arange(-half + 0.87 * h, half - 0.5 * h, 0.87 * h)
    inside = np.concatenate([np.stack([side + 0.5 * h * (1 + n % 2), 0.0 * side + y], 1)
                             for n, y in enumerate(rows)])
    inside += np.random.default_rng(seed).uniform(-0.35 * h, 0.35 * h, inside.shape)
    inside = inside[(np.abs(inside) < half - 0.4 * h).all(1)]
    points = np.concatenate([rim, inside])
    triangles = spatial.Delaunay(points).simplices
    a, b = points[triangles[:, 1:]].transpose(1, 0, 2) - points[triangles[:, 0]]
    twice = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    triangles[twice < 0.0] = triangles[twice < 0.0][:, ::-1]
    return np.pad(points, ((0, 0), (0, 1))), triangles[np.abs(twice) > 1e-3 * h * h]


def arch(along: int = 25, across: int = 9, radius: float = 0.1, width: float = 0.12
         ) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of half a tube that stands on both its edges, along y."""
    angle, y = np.linspace(np.pi, 0.0, along), np.linspace(0.0, width, across)
    vertices = np.array([(radius * np.cos(a), b, radius * np.sin(a)) for b in y for a in angle])
    triangles = []
    for row, column in np.ndindex(across - 1, along - 1):
        a = row * along + column
        b, c, d = a + 1, a + along, a + along + 1
        triangles += [(a, b, d), (a, d, c)] if (row + column) % 2 else [(a, b, c), (b, d, c)]
    return vertices, np.array(triangles)


def box(cells: tuple[int, int, int] = (2, 2, 3), size: float = 0.1):
    """Return vertices and tetrahedra of a box of cubes, six tetrahedra in each."""
    counts = np.array(cells) + 1
    number = np.arange(counts.prod()).reshape(counts)
    vertices = np.stack(np.meshgrid(*(np.arange(n) * size for n in counts), indexing='ij'),
                        -1).reshape(-1, 3)
    tetrahedra = []
    for corner in np.ndindex(*cells):
        for first, second in ((0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1)):
            steps = np.array([corner] * 4)
            steps[1:, first] += 1
            steps[2:, second] += 1
            steps[3:, 3 - first - second] += 1
            cell = [number[tuple(step)] for step in steps]
            even = (first, second) in ((0, 1), (1, 2), (2, 0))
            tetrahedra.append(cell if even else [cell[1], cell[0], *cell[2:]])
    return vertices, np.array(tetrahedra)


def ball(splits: int = 1, radius: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of an icosahedron whose edges are halved some times."""
    golden = 0.5 * (1.0 + 5.0**0.5)
    vertices = np.array([np.roll([0.0, a, b * golden], k) for k in range(3)
                         for a in (-1.0, 1.0) for b in (-1.0, 1.0)]) / np.hypot(1.0, golden)
    near = np.linalg.norm(vertices[:, None] - vertices, axis=-1) < 1.2
    triangles = np.array([(i, j, k) for i in range(12) for j in range(i) for k in range(j)
                          if near[i, j] and near[j, k] and near[i, k]])
    inward = np.linalg.det(vertices[triangles]) < 0.0
    triangles[inward] = triangles[inward][:, ::-1]
    for _ in range(splits):
        sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
        edges, number = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
        middles = vertices[edges].sum(1)
        (i, j, k), (a, b, c) = triangles.T, len(vertices) + number.reshape(-1, 3).T
        vertices = np.concatenate(
            [vertices, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
        triangles = np.concatenate([np.stack(corners, 1) for corners in (
            (i, a, c), (a, j, b), (c, b, k), (a, b, c))])
    return radius * vertices, triangles


def box_surface(a=0.3, b=0.5, c=0.2):
    """Return the surface of a box of half extents a, b, c."""
    return np.array([[x, y, z] for x in (-a, a) for y in (-b, b) for z in (-c, c)]), BOX_FACES


def octahedral_ball(radius=0.3, rounds=5):
    """Return the surface of a ball as an octahedron, divided a few times."""
    points = [np.array(p, float) for p in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1),
                                           (0, 0, -1))]
    faces = [(a, b, c) for a in (0, 1) for b in (2, 3) for c in (4, 5)]
    for _ in range(rounds):
        middle, found = {}, []
        for f in faces:
            m = []
            for p, q in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0])):
                key = min(p, q), max(p, q)
                if key not in middle:
                    middle[key] = len(points)
                    points.append(points[p] + points[q])
                    points[-1] /= np.linalg.norm(points[-1])
                m.append(middle[key])
            found += [(f[0], m[0], m[2]), (m[0], f[1], m[1]), (m[2], m[1], f[2]), tuple(m)]
        faces = found
    return radius * np.array(points), np.array(faces)


def obj_text(vertices, triangles) -> str:
    """Return a mesh as OBJ."""
    return ''.join([*(f'v {x!r} {y!r} {z!r}\n' for x, y, z in np.asarray(vertices).tolist()),
                    *(f'f {a + 1} {b + 1} {c + 1}\n' for a, b, c in triangles)])


def vtk_text(vertices, tetrahedra) -> str:
    """Return a body as legacy VTK."""
    return ''.join([
        '# vtk DataFile Version 3.0\nbody\nASCII\nDATASET UNSTRUCTURED_GRID\n',
        f'POINTS {len(vertices)} double\n',
        *(f'{x!r} {y!r} {z!r}\n' for x, y, z in np.asarray(vertices).tolist()),
        f'CELLS {len(tetrahedra)} {5 * len(tetrahedra)}\n',
        *(f'4 {a} {b} {c} {d}\n' for a, b, c, d in tetrahedra),
        f'CELL_TYPES {len(tetrahedra)}\n', '10\n' * len(tetrahedra)])


_FOLDER = []


def file_of(vertices, cells) -> str:
    """
    Return a file that holds triangles or tetrahedra, and is gone when the tests are over.

    What reads tetrahedra is an extra: without it, a test that asks for them is skipped.
    """
    if not _FOLDER:
        _FOLDER.append(Path(tempfile.mkdtemp(prefix='xpbd_ros_shapes_')))
        atexit.register(shutil.rmtree, _FOLDER[0], ignore_errors=True)
    solid = len(cells[0]) == 4
    if solid:
        pytest.importorskip('meshio', reason="meshio is missing: pip install '.[mesh]'")
    text = (vtk_text if solid else obj_text)(vertices, cells)
    file = _FOLDER[0] / f'{len(list(_FOLDER[0].iterdir()))}.{"vtk" if solid else "obj"}'
    file.write_text(text)
    return str(file)
