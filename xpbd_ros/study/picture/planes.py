"""The light that planes send to the camera, with a grid and fading far away."""

from collections.abc import Sequence

import numpy as np

from xpbd_ros.study.picture.camera import View
from xpbd_ros.study.picture.colour import linear, pressed
from xpbd_ros.study.picture.content import Body
from xpbd_ros.study.picture.light import Lamps, PLANE_TAPS, SKY, sky_light, spiral, SUN, sun_share
from xpbd_ros.study.picture.vectors import Array, rotation


def shade_planes(bodies: Sequence[Body], view: View, lamps: Lamps, centre: Array,
                 radius: float, spacing: float) -> tuple[Array, Array]:
    """Return the light (pixels, 3) of the planes against white, and their 1/depth (pixels,)."""
    count = view.width * view.height
    light = np.ones((count, 3))
    nearness = np.zeros(count)
    down, right = np.mgrid[0:view.height, 0:view.width] + 0.5
    rays = view.rays(right, down).reshape(-1, 3)
    for body in bodies:
        turn = rotation(body.orientation)
        normal, origin = turn[:, 2], np.asarray(body.position)
        height = float(normal @ (view.eye - origin))
        if height == 0:
            continue
        key = -(rays @ normal) / height
        shown = np.flatnonzero(key > np.maximum(nearness, 1e-9))
        middle = turn.T @ (centre - origin)
        place = (view.eye + rays[shown] / key[shown, None] - origin) @ turn
        far = np.hypot(place[:, 0] - middle[0], place[:, 1] - middle[1]) / radius
        near = far < 3.2
        shown, place, far = shown[near], place[near], far[near]
        nearness[shown] = key[shown]
        facing = normal * np.sign(height)
        sky = _sky_table(lamps, place, middle, radius, origin, turn, facing)
        shade = np.outer(0.1 + 0.9 * sky, SKY)
        slant = float(facing @ lamps.towards)
        if slant > 0:
            lit = np.ones(len(place))
            if lamps.sun is not None:
                taps = spiral(PLANE_TAPS).astype(np.float32)[None]
                for begin in range(0, len(place), 1 << 16):
                    part = slice(begin, begin + (1 << 16))
                    lit[part] = sun_share(lamps.sun, origin + place[part] @ turn.T,
                                          np.broadcast_to(facing, (len(place[part]), 3)), taps)
            shade += np.outer(slant * lit, SUN)
        ink = _grid_ink(place, shown, count, view.width, spacing)
        fade = np.clip((3.2 - far) / 2.0, 0, 1)
        fade = (fade * fade * (3 - 2 * fade))[:, None]
        assert body.colour is not None
        tone = pressed(linear(body.colour) * (1 - 0.16 * ink[:, None]) * shade)
        light[shown] = light[shown] * (1 - fade) + tone * fade
    return light, nearness


def _sky_table(lamps: Lamps, place: Array, middle: Array, radius: float, origin: Array,
               turn: Array, facing: Array, cells: int = 72) -> Array:
    """Return the sky's light at points of a plane, from a table around the middle."""
    extent = 1.6 * radius
    line = np.linspace(-extent, extent, cells)
    table = np.zeros((cells * cells, 3))
    table[:, 0] = np.repeat(line, cells) + middle[0]
    table[:, 1] = np.tile(line, cells) + middle[1]
    value = sky_light(lamps.sky, origin + table @ turn.T,
                      np.broadcast_to(facing, table.shape)).reshape(cells, cells)
    for _ in range(3):    # the few directions leave spots
        wide = np.pad(value, 1, mode='edge')
        value = (wide[:-2, 1:-1] + 2 * value + wide[2:, 1:-1]) / 4
        wide = np.pad(value, 1, mode='edge')
        value = (wide[1:-1, :-2] + 2 * value + wide[1:-1, 2:]) / 4
    clear = value.max()
    edge = np.clip(8 * (1 - np.abs(line) / extent), 0, 1)
    value = clear + (value - clear) * edge[:, None] * edge
    at = np.clip((place[:, :2] - middle[:2] + extent) / (2 * extent) * (cells - 1),
                 0, cells - 1.001)
    i, j = at.astype(np.int64).T
    s, t = (at - np.stack([i, j], axis=1)).T
    return ((value[i, j] * (1 - s) + value[i + 1, j] * s) * (1 - t)
            + (value[i, j + 1] * (1 - s) + value[i + 1, j + 1] * s) * t)


def _grid_ink(place: Array, shown: Array, count: int, width: int, spacing: float) -> Array:
    """Return how much of each pixel is grid line, thin lines a pixel wide."""
    ink = np.zeros(len(place))
    for axis in range(2):
        along = np.zeros(count)
        along[shown] = place[:, axis] / spacing
        picture = along.reshape(-1, width)
        step = np.hypot(*np.gradient(picture)).ravel()[shown]
        line = along[shown]
        off = np.abs(line - np.round(line)) / np.maximum(step, 1e-9)
        ink = np.maximum(ink, np.clip(1.2 - off, 0, 1) * np.clip(0.35 - step, 0, 0.25) * 4)
    return ink
