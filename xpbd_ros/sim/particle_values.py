"""Values of single particles: surface normals, strains and tensions; for clouds and colours."""

import numpy as np

from xpbd_ros.sim.effect import Cloth
from xpbd_ros.sim.geometry.mesh import cross, length


def normals(cloth: Cloth, x: np.ndarray) -> np.ndarray:
    """
    Return unit normals, the sum of area × normal of the triangles around each particle.

    Parameters
    ----------
    cloth : whose particles
    x : their positions [m], shape (particles, 3)

    Returns
    -------
    shape (particles, 3); 0 without triangles of an area

    """
    triangles = cloth.mesh.triangles
    a, b, c = (x[triangles[:, k]] for k in range(3))
    areas = cross(b - a, c - a)
    found = np.stack([sum(np.bincount(triangles[:, k], areas[:, axis], len(x)) for k in range(3))
                      for axis in range(3)], axis=1)
    size = length(found)
    return np.divide(found, size[:, None], out=np.zeros_like(found), where=size[:, None] > 0.0)


def strains(cloth: Cloth, x: np.ndarray) -> np.ndarray:
    """
    Return the largest |l - L| / L of the edges of each particle, with rest length L.

    On grids only warp and weft edges count, as in ``measure.largest_strain``.

    Parameters
    ----------
    cloth : whose particles
    x : their positions [m], shape (particles, 3)

    Returns
    -------
    shape (particles,)

    """
    found = np.zeros(len(x))
    grid = cloth.mesh.grid
    if grid is None:
        a, b = cloth.mesh.edges.T
        rest = length(cloth.mesh.positions[a] - cloth.mesh.positions[b])
        strain = np.abs(length(x[a] - x[b]) / rest - 1.0)
        for ends in (a, b):
            np.maximum.at(found, ends, strain)
        return found
    assert cloth.mesh.spacing is not None
    place, largest = x.reshape(*grid.shape, 3), found.reshape(grid.shape)
    for axis, rest in ((1, cloth.mesh.spacing[0]), (0, cloth.mesh.spacing[1])):
        edges = np.diff(place, axis=axis)
        strain = np.abs(length(edges.reshape(-1, 3)).reshape(edges.shape[:2]) / rest - 1.0)
        for part in (largest.swapaxes(0, axis)[1:], largest.swapaxes(0, axis)[:-1]):
            np.maximum(part, strain.swapaxes(0, axis), out=part)
    return found


def has_tensions(simulation) -> bool:
    """Return whether the simulation keeps the forces of its edges."""
    return any(built.loaded_edges for built in simulation.effects.values())


def tensions(simulation) -> np.ndarray:
    """
    Return the largest force among the edges of each particle [N], in natural order.

    Returns
    -------
    shape (particles,); 0 where the simulation keeps no forces

    """
    found = np.zeros(simulation.state.x.shape[1])
    for force, edges in (pair for built in simulation.effects.values()
                         for pair in built.loaded_edges):
        size = np.abs(force[edges.index].astype(float))
        for ends in edges.particles.T:
            np.maximum.at(found, ends, size)
    return found[simulation.slot]
