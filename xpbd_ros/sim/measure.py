"""Diagnostics of a state: momentum, energy, strain, effective stiffness; values of particles."""

import numpy as np

from xpbd_ros.sim.effect import Cloth
from xpbd_ros.sim.geometry.mesh import cross, length
from xpbd_ros.sim.particles.state import places

ROUNDINGS = 8
"""assumed error of an edge's length, relative to the largest coordinate times machine epsilon"""


def momentum(state) -> np.ndarray:
    """Return Σ m v [kg m/s], shape (3,)."""
    return (state.mass[:, None] * places(state.v)).sum(0)


def angular_momentum(state) -> np.ndarray:
    """Return Σ m x × v about the origin [kg m²/s], shape (3,)."""
    return cross(places(state.x), state.mass[:, None] * places(state.v)).sum(0)


def kinetic_energy(state) -> float:
    """Return Σ m v² / 2 [J]."""
    return float(0.5 * (state.mass * (places(state.v)**2).sum(1)).sum())


def potential_energy(state) -> float:
    """Return -Σ m g·x [J]."""
    return float(-(state.mass * (places(state.x) * state.gravity).sum(1)).sum())


def elastic_energy(simulation) -> float:
    """Return the elastic energy of all constraints [J]."""
    return sum(built.constraints.energy(simulation.state.x)
               for built in simulation.effects.values() if built.constraints is not None)


def largest_strain(simulation) -> float:
    """
    Return the largest |l - L| / L over the edges of all cloths, with rest length L.

    On grids only warp and weft edges count.
    """
    return max(float(strains(cloth, places(simulation.state.x, cloth.slots)).max(initial=0.0))
               for cloth in simulation.cloths)


def stiffness_given(simulation) -> tuple[float, float] | None:
    """
    Return the effective stiffness of edges relative to the requested one, and the residual.

    The ratio is Σ α |f| / Σ -C sign f over the edges, with forces f: the elongations that the
    compliance asks for over those that the edges have. Unconverged sweeps leave |C| > α |f|
    (doc/numerics.md 4.1). The ratio is 1 where both sums are within the rounding error of the
    lengths. The residual is the RMS of C + α f [m]. None if no multipliers are kept or no edge is
    compliant.
    """
    asked = given = squares = 0.0
    count = 0
    for force, edges in (pair for built in simulation.effects.values()
                         for pair in built.loaded_edges):
        f, alpha = force[edges.index].astype(float), edges.compliance
        residual = edges.residual(simulation.state.x)
        asked += (alpha * np.abs(f)).sum()
        given -= (residual * np.sign(f)).sum()
        squares += ((residual + alpha * f)**2).sum()
        count += len(f)
    x = simulation.state.x
    rounding = count * ROUNDINGS * float(np.finfo(x.dtype).eps * np.abs(x).max())
    if max(asked, abs(given)) <= rounding and count:
        return 1.0, float(np.sqrt(squares / count))
    if not (asked > 0.0 and given > 0.0):
        return None
    return float(asked / given), float(np.sqrt(squares / count))


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
    return np.divide(found, size[:, None], out=np.zeros(found.shape), where=size[:, None] > 0.0)


def strains(cloth: Cloth, x: np.ndarray) -> np.ndarray:
    """
    Return the largest |l - L| / L of the edges of each particle, with rest length L.

    On grids only warp and weft edges count, as in ``largest_strain``.

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


def touching(simulation) -> np.ndarray:
    """Return whether each particle touches a collider, in natural order; shape (particles,)."""
    found = np.zeros(simulation.state.x.shape[1], bool)
    if 'contact' in simulation.effects:
        contacts = simulation.effects['contact'].contacts
        count = max(0, contacts.count[0])
        found[contacts.particle[:count][contacts.push[:count] > 0.0]] = True
    return found[simulation.slot]


def contact_forces(simulation) -> np.ndarray:
    """
    Return the force between each particle and colliders [N], in natural order.

    |d n + s| / m, with the push d along the normal n, the displacement s by friction and the
    mobility m, summed over the colliders that the particle touches; of the last substep. So a
    particle between two fingers has the force of both.

    Returns
    -------
    shape (particles,); 0 without the effect ``contact``

    """
    state = simulation.state
    found = np.zeros(state.x.shape[1])
    if 'contact' in simulation.effects:
        contacts = simulation.effects['contact'].contacts
        these = slice(max(0, contacts.count[0]))
        particle, mobility = contacts.particle[these], state.mobility[contacts.particle[these]]
        moved = length(contacts.push[these, None] * contacts.normal[these] + contacts.slip[these])
        free = mobility > 0.0
        np.add.at(found, particle[free], moved[free] / mobility[free])
    return found[simulation.slot]
