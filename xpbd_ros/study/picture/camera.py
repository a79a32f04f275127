"""The camera, and where it stands."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from xpbd_ros.study.picture.vectors import Array


@dataclass(frozen=True)
class Camera:
    """Which way the picture looks; its place is fitted to what is shown."""

    azimuth: float = -60.0
    """where the camera stands as seen from what it looks at, from x towards y [deg]"""
    elevation: float = 24.0
    """above the horizon [deg]"""
    field_of_view: float = 24.0
    """vertical, of the whole panel [deg]"""


@dataclass(frozen=True, eq=False)
class View:
    """A camera in its place, with a picture of so many pixels."""

    eye: Array
    """(3,) [m]"""
    axes: Array
    """(3, 3), rows: right, up and forward in the world"""
    focal: float
    """focal length [px]"""
    width: int
    height: int

    def project(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return pixels (n, 2), x to the right and y down, and the depth (n,) of points [m]."""
        local = (np.asarray(points, dtype=float).reshape(-1, 3) - self.eye) @ self.axes.T
        depth = local[:, 2]
        with np.errstate(divide='ignore', invalid='ignore'):
            right = self.width / 2 + self.focal * local[:, 0] / depth
            down = self.height / 2 - self.focal * local[:, 1] / depth
        return np.stack([right, down], axis=1), depth

    def rays(self, right: Array, down: Array) -> Array:
        """Return directions (..., 3) through pixels, one metre deep."""
        side = (right - self.width / 2) / self.focal
        rise = (self.height / 2 - down) / self.focal
        return (side[..., None] * self.axes[0] + rise[..., None] * self.axes[1] + self.axes[2])


def _camera_axes(camera: Camera) -> Array:
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    forward = -np.array([np.cos(elevation) * np.cos(azimuth),
                         np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(right, forward), forward])


def fit(points: ArrayLike, camera: Camera, width: int, height: int, *,
        margin: float = 0.06) -> View:
    """
    Place a camera so that all points just fit, with a margin of the picture on each side.

    A side of the frustum is a plane: with r right and f forward, points are inside the left one
    where r + f t >= a, inside the right one where r - f t <= b. The tightest a and b meet where
    the eye is; of the two distances, from the sides and from above and below, the larger holds.
    """
    axes = _camera_axes(camera)
    slope = np.tan(np.radians(camera.field_of_view) / 2)
    focal = height / 2 / slope
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    points = points if len(points) else np.zeros((1, 3))
    local = points @ axes.T
    inner = slope * (1 - 2 * margin) * np.array([width / height, 1.0])
    low = (local[:, :2] + local[:, 2:] * inner).min(axis=0)
    high = (local[:, :2] - local[:, 2:] * inner).max(axis=0)
    eye = np.append((low + high) / 2, ((low - high) / (2 * inner)).min())
    eye[2] = min(eye[2], local[:, 2].min() - 1e-3)
    return View(eye @ axes, axes, focal, width, height)


def best_aspect(points: Array, camera: Camera, low: float, high: float) -> float:
    """Return the width over height, within bounds, of a panel that the points fill both ways."""
    local = points[::max(1, len(points) // 4000)] @ _camera_axes(camera).T
    slope = 0.88 * np.tan(np.radians(camera.field_of_view) / 2)

    def distance(axis: int, t: float) -> float:
        return float((local[:, axis] - local[:, 2] * t).max()
                     - (local[:, axis] + local[:, 2] * t).min()) / t

    wanted = distance(1, slope)
    for _ in range(30):
        middle = (low + high) / 2
        if distance(0, slope * middle) > wanted:
            low = middle
        else:
            high = middle
    return low


def sun_beside(camera: Camera) -> Array:
    """Return a sun to the left of the camera and behind it."""
    azimuth, elevation = np.radians([camera.azimuth - 75, 50])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                     np.sin(elevation)])
