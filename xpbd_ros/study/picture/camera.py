"""The camera, and where it stands."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MARGIN = 0.06
"""share of the picture that is left free on each side"""


@dataclass(frozen=True)
class Camera:
    """Which way the picture looks; its place is fitted to what is shown."""

    azimuth: float = -60.0
    """where the camera stands as seen from what it looks at, from x towards y [deg]"""
    elevation: float = 24.0
    """above the horizon [deg]"""
    view_angle: float = 24.0
    """vertical, of the whole panel [deg]"""

    @property
    def axes(self) -> NDArray:
        """Return right, up and backward as rows (3, 3)."""
        back = direction(self.azimuth, self.elevation)
        right = direction(self.azimuth + 90, 0)
        return np.stack([right, np.cross(back, right), back])

    @property
    def sun(self) -> NDArray:
        """Return the direction (3,) to a sun on the left of the camera and behind it."""
        return direction(self.azimuth - 75, 50)


def direction(azimuth: float, elevation: float) -> NDArray:
    """Return the unit vector (3,) to a point of the sky [deg]."""
    azimuth, elevation = np.radians([azimuth, elevation])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                     np.sin(elevation)])


def fit(points: NDArray, camera: Camera, low: float, high: float) -> tuple[NDArray, float]:
    """
    Return the eye (3,) from which all points (n, 3) just fit, and the panel's width over height.

    The ratio, within bounds, is the one that the points fill both ways. A side of the frustum is
    a plane: with r right and b backward, points are inside the left one where r - b t >= a, inside
    the right one where r + b t <= c. The tightest a and c meet where the eye is; of the two
    distances, from the sides and from above and below, the larger holds.
    """
    local = points @ camera.axes.T
    for aspect in np.linspace(low, high, 50):
        slope = ((1 - 2 * MARGIN) * np.tan(np.radians(camera.view_angle) / 2)
                 * np.array([aspect, 1.0]))
        left = (local[:, :2] - local[:, 2:] * slope).min(axis=0)
        right = (local[:, :2] + local[:, 2:] * slope).max(axis=0)
        back = (right - left) / (2 * slope)
        if back[0] <= back[1]:
            break
    distance = max(*back, local[:, 2].max() + 1e-3)
    return np.append((left + right) / 2, distance) @ camera.axes, float(aspect)
