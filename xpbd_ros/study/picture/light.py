"""Light: how much of the sun and of the sky the points of a scene see."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
import pyvista
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkFloatArray

GROUND = 0.5
"""light that comes from below, as a share of the sky's"""
SUN_RADIUS = np.tan(np.radians(2.2))
"""wider than the real sun's 0.27 deg: a studio lamp, so that penumbrae show"""


def unit(vectors: ArrayLike) -> NDArray:
    """Return vectors (..., 3) of length 1; zeros stay."""
    vectors = np.asarray(vectors, dtype=float)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def sphere(count: int) -> NDArray:
    """Return unit vectors (count, 3) that are spread evenly, on a spiral."""
    index = np.arange(count)
    z, turn = 1 - (2 * index + 1) / count, index * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


class Lamps:
    """Far lights and, for each, how near to it meshes reach, by place across its rays."""

    def __init__(self, casters: Sequence[pyvista.PolyData], directions: NDArray,
                 strengths: ArrayLike, texels: int):
        points = np.concatenate([mesh.points for mesh in casters] or [np.zeros((1, 3))])
        low, high = points.min(axis=0), points.max(axis=0)
        self._centre, radius = (low + high) / 2, np.linalg.norm(high - low) / 2 + 1e-6
        self._texels, self._texel = texels, 2.02 * radius / texels
        self._maps = []
        plotter = pyvista.Plotter(off_screen=True, window_size=(texels, texels), lighting=None)
        plotter.disable_anti_aliasing()
        for mesh in casters:
            plotter.add_mesh(mesh, lighting=False, reset_camera=False)
        camera = plotter.camera
        camera.focal_point, camera.parallel_projection = self._centre, True
        camera.parallel_scale = 1.01 * radius
        plotter.show(auto_close=False)
        for towards, strength in zip(directions, np.broadcast_to(strengths, len(directions))):
            right = unit(np.cross([0, 0, 1] if abs(towards[2]) < 0.9 else [0, 1, 0], towards))
            axes, values = np.stack([right, np.cross(towards, right), towards]), vtkFloatArray()
            camera.position, camera.up = self._centre + 2 * radius * towards, axes[1]
            camera.clipping_range = near, far = 0.99 * radius, 3.01 * radius
            plotter.render_window.Render()
            plotter.render_window.GetZbufferData(0, 0, texels - 1, texels - 1, values)
            depth = vtk_to_numpy(values)
            nearest = np.where(depth < 1, 2 * radius - near - (far - near) * depth, -np.inf)
            self._maps.append([np.asarray(value, np.float32) for value in (
                towards, strength, axes.T / self._texel, nearest / self._texel)])
        plotter.close()

    def light(self, points: NDArray, normals: NDArray) -> NDArray:
        """Return the light (n,) on points (n, 3), by Lambert's law, less where meshes shade it."""
        points = np.asarray(points - self._centre, np.float32)
        normals = np.asarray(normals, np.float32)
        light = np.zeros(len(points), np.float32)
        for towards, strength, axes, nearest in self._maps:
            slant = normals @ towards
            lit = np.flatnonzero(slant > 0)
            place = (points[lit] + 1.5 * self._texel * normals[lit]) @ axes
            column, row = np.clip(place[:, :2] + self._texels / 2, 0,
                                  self._texels - 1).astype(np.int32).T
            gap = nearest[row * self._texels + column] - place[:, 2]
            light[lit] += strength * slant[lit] * np.clip(2 - gap, 0, 1)
        return light


def sunlight(casters: Sequence[pyvista.PolyData], towards: NDArray, count: int = 20) -> Lamps:
    """Return a disc that gives light 1 to a surface that faces it."""
    return Lamps(casters, unit(towards + SUN_RADIUS * sphere(count)), 1 / count, 640)


def skylight(casters: Sequence[pyvista.PolyData], count: int = 80) -> Lamps:
    """Return lights all around that give light 1 to a level surface, and less from below."""
    around = sphere(count)
    return Lamps(casters, around, 4 / count * np.where(around[:, 2] > 0, 1.0, GROUND), 192)
