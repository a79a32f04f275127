"""
Hinges of a cloth: two triangles that share an edge, their dihedral angle, and what bends them.

A hinge of stiffness B |e|² / (A0 + A1) makes a sheet of bending rigidity B (doc/numerics.md 5.7;
Grinspun et al. 2003 up to the factor), with a B of its own on a mesh
(``constraints.plate_rigidity``). A grid has the hinges of both of its triangulations, the one with
alternating diagonals and its mirror image, each with half the stiffness: those of one alone bend
only about every other particle, and a sheet that may choose would come out a third too soft. A
cell's diagonals see κxy alone and count half of that again.
"""

import numpy as np

from xpbd_ros.sim.constraints.plate_rigidity import across
from xpbd_ros.sim.geometry.mesh import cross, dot, hinges, length, Mesh


def all_hinges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """
    Return hinges and the share of its stiffness that each has.

    Returns
    -------
    particles (edge start, edge end, opposite, opposite), shape (hinges, 4), and shares (hinges,)

    """
    if mesh.grid is None:
        return mesh.hinges, np.ones(len(mesh.hinges))
    found = np.concatenate([mesh.hinges, hinges(_mirrored(mesh))])
    return found, np.where(_is_diagonal(mesh, found), 0.25, 0.5)


def _mirrored(mesh: Mesh) -> np.ndarray:
    """Return the triangles of a grid whose diagonals run the other way."""
    pairs = mesh.triangles.reshape(-1, 2, 3)    # a b c, a c d; or a b d, b c d
    rising = (pairs[:, 0, 0] == pairs[:, 1, 0])[:, None, None]
    (a, b, c), (_, _, d) = pairs[:, 0].T, pairs[:, 1].T
    c = np.where(rising[:, 0, 0], c, pairs[:, 1, 1])
    falling = np.stack([np.stack([a, b, d], 1), np.stack([b, c, d], 1)], 1)
    return np.where(rising, falling,
                    np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1)).reshape(-1, 3)


def _is_diagonal(mesh: Mesh, particles: np.ndarray) -> np.ndarray:
    columns = mesh.grid.shape[1]
    row, column = np.divmod(particles[:, :2], columns)
    return (row[:, 0] != row[:, 1]) & (column[:, 0] != column[:, 1])


def rigidity(mesh: Mesh, particles: np.ndarray, along_warp: float,
             along_weft: float) -> np.ndarray:
    """
    Return the bending rigidity that each hinge of a grid stands for [N m], shape (hinges,).

    The diagonals see twist, so sqrt(B1 B2).
    """
    return np.where(_is_diagonal(mesh, particles), np.sqrt(along_warp) * np.sqrt(along_weft),
                    across(mesh, particles, along_warp, along_weft))


def slenderness(corners: np.ndarray) -> np.ndarray:
    """Return |e|² / (A0 + A1) of hinges; corners have shape (hinges, 4, 3)."""
    e, a, b = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    return 2.0 * dot(e, e) / (length(cross(e, a)) + length(cross(e, b)))


def dihedral(corners: np.ndarray) -> np.ndarray:
    """Return the angle of hinges, 0 where flat [rad], shape (hinges,); corners (hinges, 4, 3)."""
    e, a, b = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    n1, n2 = cross(e, a), cross(b, e)
    return np.arctan2(dot(cross(n1, n2), e) / length(e), dot(n1, n2))
