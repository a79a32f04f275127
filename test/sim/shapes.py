"""Small meshes, and one as OBJ text."""

import numpy as np


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


def obj_text(vertices, triangles) -> str:
    """Return a mesh as OBJ."""
    return ''.join([*(f'v {x!r} {y!r} {z!r}\n' for x, y, z in np.asarray(vertices).tolist()),
                    *(f'f {a + 1} {b + 1} {c + 1}\n' for a, b, c in triangles)])
