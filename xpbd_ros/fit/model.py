"""The residuals of a recording: measured points minus those of the simulation."""

from collections.abc import Mapping, Sequence

import numpy as np

from xpbd_ros.fit.clouds import Cloud
from xpbd_ros.fit.surface import to_points
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Simulation


class Model:
    """
    A scene, its inputs, and the clouds that it is compared with.

    Parameters
    ----------
    scene : with the solver setting of all runs
    clouds : measured points
    commands : inputs by frame

    """

    def __init__(self, scene: Scene, clouds: Sequence[Cloud],
                 commands: Mapping[int, Sequence] | None = None):
        self.scene = scene
        self.clouds = clouds
        self.commands = commands or {}
        self.numbers = sum(len(cloud.points) * (1 if cloud.particles is None else 3)
                           for cloud in clouds)
        """measured numbers: coordinates of particles, or distances from the surface"""
        self.points = sum(len(cloud.points) for cloud in clouds)
        self._frames = max(cloud.frame for cloud in clouds)

    def scene_with(self, values: Mapping[str, float]) -> Scene:
        """Return the scene with values of some keys; raise InputError if it refuses them."""
        return scene_from_mapping(self.scene.raw, where=self.scene.where, name=self.scene.name,
                                  overrides=dict(values))

    def residuals(self, values: Mapping[str, float]) -> np.ndarray:
        """
        Run the scene with values of some keys, and return its residuals [m].

        Returns
        -------
        shape (3 × points,); from the particle of a point, or the closest point of the surface

        """
        simulation = compile_scene(self.scene_with(values))
        by_frame: dict[int, list[int]] = {}
        for k, cloud in enumerate(self.clouds):
            by_frame.setdefault(cloud.frame, []).append(k)
        found: list[np.ndarray] = [np.empty(0)] * len(self.clouds)
        for index in range(1, self._frames + 1):
            frame = simulation.step(self.commands.get(index, ()))
            for k in by_frame.get(index, ()):
                found[k] = _apart(simulation, frame.x, self.clouds[k]).ravel()
        return np.concatenate(found)


def _apart(simulation: Simulation, x: np.ndarray, cloud: Cloud) -> np.ndarray:
    """Return measured points minus the simulation's [m], shape (points, 3)."""
    cloth = simulation.cloths[cloud.cloth]
    x = x[cloth.particles]
    if cloud.particles is not None:
        return cloud.points - x[cloud.particles]
    return to_points(x, cloth.mesh.triangles, cloud.points)
