"""The camera: which way it looks is fixed, its place is fitted to what is shown."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

AZIMUTH, ELEVATION = -60.0, 24.0
"""where the camera stands: from x towards y, and above the horizon [deg]"""
VIEW_ANGLE = 24.0
"""vertical, of the whole panel [deg]"""
MARGIN = 0.06
"""share of the panel that is left free on each side"""


def axes_from(azimuth: float, elevation: float) -> NDArray:
    """Return backward, right and up as rows (3, 3) for a camera that stands there [deg]."""
    return Rotation.from_euler('ZY', [azimuth, -elevation], degrees=True).as_matrix().T


AXES = axes_from(AZIMUTH, ELEVATION)
SUN = axes_from(AZIMUTH - 75, 50)[0]
"""direction (3,) to a sun on the left of the camera and behind it"""


def fit(points: NDArray, low: float, high: float) -> tuple[NDArray, float]:
    """
    Return the eye (3,) from which all points (n, 3) just fit, and the panel's width over height.

    The ratio, within bounds, is the one that the points fill both ways. A side of the frustum is
    a plane: with r right and b backward, points are inside the left one where r - b t >= a, inside
    the right one where r + b t <= c. The tightest a and c meet where the eye is; of the two
    distances, from the sides and from above and below, the larger holds.
    """
    local = points @ AXES.T
    for aspect in np.linspace(low, high, 50):
        slope = (1 - 2 * MARGIN) * np.tan(np.radians(VIEW_ANGLE) / 2) * np.array([aspect, 1.0])
        first = (local[:, 1:] - local[:, :1] * slope).min(axis=0)
        last = (local[:, 1:] + local[:, :1] * slope).max(axis=0)
        back = (last - first) / (2 * slope)
        if back[0] <= back[1]:
            break
    distance = max(*back, local[:, 0].max() + 1e-3)
    return np.append(distance, (first + last) / 2) @ AXES, float(aspect)
