"""
``~/set_state``: place a cloth where a point cloud saw it, at rest.

A cloud of the same rows and columns as ``~/particles`` maps to the particles one to one. A missing
point (NaN, in a cloud with ``is_dense: false``) becomes the mean of its neighbours on the grid, or
along the edges of a mesh, ring by ring from the points that are there; with fewer than LEAST_SHARE
of the points it is refused. Positions are taken as they are: noise of them is strain.

Any other cloud is registered to the present cloth, with each particle's nearest point of the cloud
within a radius:

1. rigid: the rotation and translation that bring the particles nearest to their points, in least
   squares (Kabsch 1976), at most RIGID_ROUNDS times;
2. elastic: ROUNDS times each particle moves to its point within twice the radius, and the
   simulation projects its constraints PROJECTIONS times: frames of one substep from rest, without
   gravity, all pins and colliders at a standstill;
3. SETTLING such frames in the end, so that noise of the cloud leaves no strain that would set the
   cloth in motion.

The residual is the distance of the particles from their points at the end. Points of the cloud
further than the radius from every particle are counted: the cloth is not where they are. The
result is refused if fewer than LEAST_SHARE of the particles have a point.

Limits: the method finds the nearest alignment, not the global one. Parts of the cloth that are
further than about the radius from their place in the cloud, such as a fold that the cloth does not
have yet, are not found. A displacement along the surface by a few particles is seen at the edges
alone, and is made up for only in part. Nothing tells front from back, or one layer from another.
Pinned particles stay at their pins.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from sensor_msgs.msg import PointCloud2

from xpbd_ros.errors import counted, InputError
from xpbd_ros.ros.clouds import points_of
from xpbd_ros.ros.inputs import check_frame
from xpbd_ros.sim.command_check import FAR
from xpbd_ros.sim.commands import SetState
from xpbd_ros.sim.effect import Cloth
from xpbd_ros.sim.simulation import SavedState, Simulation

LEAST_SHARE = 0.5
"""share of the particles that must have a point"""
RIGID_ROUNDS = 50
STILL = 1e-6
"""largest motion of a particle in the last rigid round [m]"""
ROUNDS = 30
PROJECTIONS = 2
SETTLING = 20


@dataclass(frozen=True)
class Registered:
    """A cloth at the points of a cloud."""

    x: np.ndarray
    """positions [m], shape (particles, 3)"""
    distance: np.ndarray
    """of each particle that has a point from it [m], shape (n,)"""
    left: int
    """number of points without a particle within the radius"""

    @property
    def rms(self) -> float:
        """Return the residual, RMS over the particles that have a point [m]."""
        return float(np.sqrt(np.mean(self.distance**2)))


class CloudStates:
    """
    Read the clouds of ``~/set_state``.

    Parameters
    ----------
    saved : returns the present state
    radius : returns the largest distance of a particle from its point [m]
    tell : is given a text for each cloud that was taken

    """

    def __init__(self, saved: Callable[[], SavedState], radius: Callable[[], float],
                 tell: Callable[[str], None]):
        self.values: dict[str, float] = {}
        """numbers of the last cloud, for ``/diagnostics``"""
        self._saved, self._radius, self._tell = saved, radius, tell

    def read(self, message: PointCloud2, frame_id: str, cloth: Cloth) -> list[SetState]:
        """Return the command that places a cloth at a cloud."""
        check_frame(message.header, frame_id, 'header')
        points = points_of(message)
        missing = np.isnan(points).any(axis=2)
        if not (np.abs(points[~missing]) <= FAR).all():
            raise InputError(f'a point is infinite, or further than {FAR:g} m away')
        if message.is_dense and missing.any():
            raise InputError(f'NaN in {counted(missing.sum(), "point")}, and the cloud says '
                             'is_dense')
        grid = cloth.mesh.grid
        if points.shape[:2] == ((1, len(cloth.slots)) if grid is None else grid.shape):
            x, holes = filled(points.reshape(-1, 3), cloth), int(missing.sum())
            self.values = {'set_state_points': len(x), 'set_state_filled': holes}
            self._tell(f"'{cloth.name}' is at {len(x)} points, one to one"
                       + (f', {holes} of them from their neighbours' if holes else ''))
        else:
            x = self._register(points[~missing], cloth)
        return [SetState(cloth.name, tuple(x.ravel().tolist()))]

    def _register(self, points: np.ndarray, cloth: Cloth) -> np.ndarray:
        count = len(cloth.slots)
        if len(points) < count:
            raise InputError(f"{counted(len(points), 'point')}, and '{cloth.name}' has {count} "
                             'particles: too few to register')
        found = registered(points, self._saved().simulation(), cloth, self._radius())
        self.values = {'set_state_points': len(points),
                       'set_state_particles': len(found.distance),
                       'set_state_residual_m': found.rms,
                       'set_state_residual_max_m': float(found.distance.max()),
                       'set_state_points_left': found.left}
        self._tell(f"'{cloth.name}' is registered to {len(points)} points: "
                   f'{len(found.distance)} of {count} particles, residual {found.rms:.3g} m RMS, '
                   f'{found.distance.max():.3g} m at most; {counted(found.left, "point")} further '
                   f'than {self._radius():g} m from the cloth')
        return found.x


def filled(points: np.ndarray, cloth: Cloth) -> np.ndarray:
    """
    Return points with missing ones from their neighbours, ring by ring.

    Parameters
    ----------
    points : of each particle, NaN where it is missing [m], shape (particles, 3)
    cloth : gives the neighbours

    """
    points = points.copy()
    missing = np.isnan(points).any(axis=1)
    if missing.sum() > (1.0 - LEAST_SHARE) * len(points):
        raise InputError(f'{missing.sum()} of {len(points)} points are missing: too many to fill '
                         'from their neighbours')
    grid = cloth.mesh.grid
    pairs = cloth.mesh.edges if grid is None else np.concatenate([
        np.stack([a.ravel(), b.ravel()], 1) for a, b in (
            (grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:]))])
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    while missing.any():
        to, source = pairs[missing[pairs[:, 0]] & ~missing[pairs[:, 1]]].T
        if not len(to):
            raise InputError(f'{missing.sum()} missing points have no neighbours')
        count = np.bincount(to, minlength=len(points))
        here = count > 0
        for axis in range(3):
            total = np.bincount(to, points[source, axis], len(points))
            points[here, axis] = total[here] / count[here]
        missing &= ~here
    return points


def registered(points: np.ndarray, simulation: Simulation, cloth: Cloth,
               radius: float) -> Registered:
    """
    Return a cloth at a cloud, by the method above.

    Parameters
    ----------
    points : [m], shape (n, 3)
    simulation : with the present state; is stepped
    cloth : of the simulation
    radius : largest distance of a particle from its point [m]

    """
    from scipy.spatial import cKDTree

    tree, count = cKDTree(points), len(cloth.slots)

    def near(x: np.ndarray, radius: float = radius) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which particles have a point, these points, and how far they are."""
        distance, index = tree.query(x, distance_upper_bound=radius)
        has = np.isfinite(distance)
        if has.sum() < LEAST_SHARE * count:
            raise InputError(f"{has.sum()} of {count} particles of '{cloth.name}' have a point "
                             f'within {radius:g} m: too few to register')
        return has, points[index[has]], distance[has]

    x = simulation.frame().x[cloth.particles]
    for _ in range(RIGID_ROUNDS):
        has, there, _ = near(x)
        before, x = x, rigidly_moved(x, x[has], there)
        if np.abs(x - before).max() < STILL:
            break
    for effect, bodies in (('pin', 'held'), ('contact', 'placed')):
        for body in getattr(simulation.effects.get(effect), bodies, {}).values():
            body.motion.stop()
    simulation.state.gravity[:] = 0.0
    simulation.solver = replace(simulation.solver, substeps=1)
    for k in range(ROUNDS):
        has, there, _ = near(x, 2.0 * radius)
        x[has] = there
        for _ in range(PROJECTIONS if k < ROUNDS - 1 else SETTLING):
            simulation.state.v[:] = 0.0
            simulation.apply([SetState(cloth.name, tuple(x.ravel().tolist()))])
            x = simulation.step().x[cloth.particles]
    apart, _ = cKDTree(x).query(points, distance_upper_bound=radius)
    return Registered(x, near(x)[2], int(np.isinf(apart).sum()))


def rigidly_moved(x: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Return x after the rigid motion that best maps ``here`` to ``there``; shapes (n, 3)."""
    centre, goal = here.mean(0), there.mean(0)
    u, _, v = np.linalg.svd((here - centre).T @ (there - goal))
    u[:, 2] *= np.sign(np.linalg.det(u @ v))
    return (x - centre) @ (u @ v) + goal
