"""
Hinges of a cloth: pairs of triangles that share an edge, dihedral angles, bending stiffness.

Hinges of stiffness B |e|² / (A0 + A1) give a sheet the bending rigidity B (doc/numerics.md 5.7;
Grinspun et al. 2003 up to the factor); on a mesh each hinge has a B of its own, fitted in
``constraints.plate_rigidity``. A grid has the hinges of two triangulations, the one with
alternating diagonals and its mirror image, each with half the stiffness. Those of a single one
resist bending only about every other particle, and a sheet that relaxes would be a third too soft.
The diagonals of cells resist the twist κxy alone, and have half of that stiffness again.
"""

import numpy as np

from xpbd_ros.sim.constraints.plate_rigidity import across
from xpbd_ros.sim.geometry.mesh import cross, dot, hinges, length, Mesh


def all_hinges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the hinges of a mesh and the fraction of the stiffness B |e|² / (A0 + A1) of each.

    Returns
    -------
    particles (edge start, edge end, opposite, opposite), shape (hinges, 4); fractions, (hinges,)

    """
    if mesh.grid is None:
        return mesh.hinges, np.ones(len(mesh.hinges))
    found = np.concatenate([mesh.hinges, hinges(_mirrored(mesh))])
    return found, np.where(_is_diagonal(mesh, found), 0.25, 0.5)


def _mirrored(mesh: Mesh) -> np.ndarray:
    """Return the triangles of a grid with the other diagonal of each cell."""
    pairs = mesh.triangles.reshape(-1, 2, 3)    # a b c, a c d; or a b d, b c d
    rising = (pairs[:, 0, 0] == pairs[:, 1, 0])[:, None, None]
    (a, b, c), (_, _, d) = pairs[:, 0].T, pairs[:, 1].T
    c = np.where(rising[:, 0, 0], c, pairs[:, 1, 1])
    falling = np.stack([np.stack([a, b, d], 1), np.stack([b, c, d], 1)], 1)
    return np.where(rising, falling,
                    np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1)).reshape(-1, 3)


def _is_diagonal(mesh: Mesh, particles: np.ndarray) -> np.ndarray:
    assert mesh.grid is not None
    columns = mesh.grid.shape[1]
    row, column = np.divmod(particles[:, :2], columns)
    return (row[:, 0] != row[:, 1]) & (column[:, 0] != column[:, 1])


def rigidity(mesh: Mesh, particles: np.ndarray, along_warp: float,
             along_weft: float) -> np.ndarray:
    """
    Return the bending rigidity B of each hinge of a grid [N m], shape (hinges,).

    Diagonals resist twist and have sqrt(B1 B2).
    """
    return np.where(_is_diagonal(mesh, particles), np.sqrt(along_warp) * np.sqrt(along_weft),
                    across(mesh, particles, along_warp, along_weft))


def slenderness(corners: np.ndarray) -> np.ndarray:
    """Return |e|² / (A0 + A1) of hinges, shape (hinges,); corners [m], (hinges, 4, 3)."""
    e, a, b = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    return 2.0 * dot(e, e) / (length(cross(e, a)) + length(cross(e, b)))


def dihedral(corners: np.ndarray) -> np.ndarray:
    """Return dihedral angles, 0 if flat [rad], shape (hinges,); corners [m], (hinges, 4, 3)."""
    e, a, b = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    n1, n2 = cross(e, a), cross(b, e)
    return np.arctan2(dot(cross(n1, n2), e) / length(e), dot(n1, n2))
