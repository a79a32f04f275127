"""Small scenes, and what is seen of them."""

import numpy as np

from xpbd_ros.study.picture import Surface
from xpbd_ros.study.picture.camera import Camera, fit

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
TWO = np.array([[0, 1, 2], [0, 2, 3]])
RED, BLUE = '#cc1a1a', '#1a1acc'
ABOVE, BELOW = Camera(-90, 89.9), Camera(-90, -89.9)
PIXELS = 80


def square(height, colour='#b0b0b0', *, scale=1.0):
    return Surface(scale * SQUARE + [0, 0, height], TWO, colour)


def pixel(camera, eye, point, pixels=PIXELS):
    """Return the column and row where a square picture shows a point: a pinhole's projection."""
    right, up, back = camera.axes @ (np.asarray(point) - eye)
    focal = pixels / 2 / np.tan(np.radians(camera.view_angle) / 2)
    return int(pixels / 2 - focal * right / back), int(pixels / 2 + focal * up / back)


class Picture:
    """An instant as a camera sees it that is fitted to some points."""

    def __init__(self, instant, camera=ABOVE, *, shown=SQUARE, pixels=PIXELS):
        from xpbd_ros.study.picture.panel import render
        self.camera, self.pixels = camera, pixels
        self.eye, _ = fit(np.asarray(shown, float), camera, 1.0, 1.0)
        self.image = render(instant, camera, self.eye, pixels, pixels, np.zeros(3), 2.0)

    def at(self, point):
        """Return the mean colour (3,) of the pixels around the one that shows a point."""
        column, row = pixel(self.camera, self.eye, point, self.pixels)
        assert 1 <= row < self.pixels - 1 and 1 <= column < self.pixels - 1
        return self.image[row - 1:row + 2, column - 1:column + 2].mean(axis=(0, 1))


def is_red(colour):
    return colour[0] > 1.5 * colour[2]


def is_blue(colour):
    return colour[2] > 1.5 * colour[0]
