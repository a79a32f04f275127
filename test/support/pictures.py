"""Small scenes, given as the camera sees them: to the right, up and towards it."""

from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import Rotation

from xpbd_ros.study.picture import Surface
from xpbd_ros.study.picture.camera import AXES, fit, VIEW_ANGLE

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
TWO = np.array([[0, 1, 2], [0, 2, 3]])
RED, BLUE = '#cc1a1a', '#1a1acc'
FACING = tuple(Rotation.from_matrix(AXES[[1, 2, 0]].T).as_quat())
"""turns z towards the camera"""
PIXELS = 80
COARSE = 30
"""of surfaces (``panel.FINENESS``) in small pictures, where light need not be smooth"""


def world(local):
    return np.asarray(local, float) @ AXES[[1, 2, 0]]


def square(near, colour='#b0b0b0', *, scale=1.0, triangles=TWO):
    """Return a square that faces the camera."""
    return Surface(world(scale * SQUARE + [0, 0, near]), triangles, colour)


class Picture:
    """An instant as the camera sees it that is fitted to some points."""

    def __init__(self, instant, *, shown=SQUARE, pixels=PIXELS):
        from xpbd_ros.study.picture.panel import render
        self.pixels = pixels
        self.eye, _ = fit(world(shown), 1.0, 1.0)
        with patch('xpbd_ros.study.picture.panel.FINENESS', COARSE):
            self.image = render(instant, self.eye, pixels, pixels, np.zeros(3), 2.0)

    def at(self, point):
        """Return the mean colour (3,) around where a pinhole camera sees a point of the world."""
        back, right, up = AXES @ (np.asarray(point) - self.eye)
        focal = self.pixels / 2 / np.tan(np.radians(VIEW_ANGLE) / 2)
        column = int(self.pixels / 2 - focal * right / back)
        row = int(self.pixels / 2 + focal * up / back)
        assert 1 <= row < self.pixels - 1 and 1 <= column < self.pixels - 1
        return self.image[row - 1:row + 2, column - 1:column + 2].mean(axis=(0, 1))


def is_red(colour):
    return colour[0] > 1.5 * colour[2]


def is_blue(colour):
    return colour[2] > 1.5 * colour[0]
