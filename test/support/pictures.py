"""Surfaces to render, and colours of the rendered image."""

import numpy as np

from xpbd_ros.study.picture import Camera, fit, render, Surface
from xpbd_ros.study.picture.bounds import shown_points

RED, BLUE, GREY = (0.8, 0.1, 0.1), (0.1, 0.1, 0.8), (0.7, 0.7, 0.7)
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
TWO = np.array([[0, 1, 2], [0, 2, 3]])
ABOVE = Camera(azimuth=-90, elevation=89.9)


def square(height, colour, *, scale=1.0, **colours):
    return Surface(scale * SQUARE + [0, 0, height], TWO, colour, **colours)


def look(instant, camera=ABOVE, pixels=80, **options):
    view = fit(shown_points(instant), camera, pixels, pixels)
    return view, render(instant, view, over=2, **options)


def colour_at(view, image, point):
    """Return the mean colour of the few pixels around where a point is seen."""
    column, row = view.project(point)[0][0].astype(int)
    assert 1 <= row < view.height - 1 and 1 <= column < view.width - 1
    return image[row - 1:row + 2, column - 1:column + 2].mean(axis=(0, 1))


def is_red(colour):
    return colour[0] > 1.5 * colour[2]


def is_blue(colour):
    return colour[2] > 1.5 * colour[0]
