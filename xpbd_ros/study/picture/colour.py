"""Colours as light, which adds up, and as sRGB, which screens show."""

from matplotlib.colors import to_rgb
import numpy as np

from xpbd_ros.study.picture.vectors import Array

Colour = str | tuple[float, float, float]
"""whatever matplotlib takes for a colour"""


def linear(colour: Colour) -> Array:
    """Return a colour as light, (3,) (sRGB, IEC 61966-2-1)."""
    value = np.array(to_rgb(colour))
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def pressed(light: Array) -> Array:
    """Return light with its brightest part pressed together below 1 rather than cut."""
    knee = 0.8
    over = np.maximum(light - knee, 0)
    return np.minimum(light, knee) + (1 - knee) * (1 - np.exp(-over / (1 - knee)))


def encoded(light: Array) -> Array:
    """Return light as sRGB in [0, 1]."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
