"""The edges whose strain a study measures."""

from dataclasses import dataclass

import numpy as np

from xpbd_ros.sim.geometry.mesh import length


@dataclass(frozen=True, eq=False)
class Edges:
    """Edges of a scene's cloths: all of a mesh, those along warp and weft of a grid."""

    particles: np.ndarray
    """natural indices of both ends, shape (edges, 2)"""
    rest: np.ndarray
    """rest lengths [m], shape (edges,)"""

    def strain(self, x: np.ndarray) -> np.ndarray:
        """Return l / L - 1, shape (edges,), at positions ``x`` in natural order [m]."""
        i, j = self.particles.T
        return length(x[i] - x[j]) / self.rest - 1.0


def edges_of(simulation) -> Edges:
    """Return the edges of all cloths of a simulation."""
    pairs, rest = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
    for cloth in simulation.cloths:
        mesh = cloth.mesh
        if mesh.grid is None:
            ends = mesh.edges
        else:
            ends = np.concatenate([np.stack([lines[:, :-1].ravel(), lines[:, 1:].ravel()], 1)
                                   for lines in (mesh.grid, mesh.grid.T)])
        pairs.append(cloth.first + ends)
        rest.append(length(mesh.positions[ends[:, 0]] - mesh.positions[ends[:, 1]]))
    return Edges(np.concatenate(pairs), np.concatenate(rest))
