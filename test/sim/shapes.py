"""Small meshes, and their texts and files."""

import atexit
from pathlib import Path
import shutil
import tempfile

import numpy as np
import pytest


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
