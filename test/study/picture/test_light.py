"""Laws that hold for any correct light, not the pixels of one picture."""

import numpy as np
import pytest

from support.pictures import ABOVE, colour_at, GREY, look, SQUARE, square
from xpbd_ros.study.picture import Body, Camera, fit, Instant, render
from xpbd_ros.study.picture.light import DepthMap, directions, sky_light


@pytest.mark.parametrize('sun', [(1, 0, 0.3), (-1, 0, 0.3), (0, 1, 0.3), (0, -1, 0.3)])
def test_a_ball_is_brighter_on_the_side_of_the_sun(sun):
    view, seen = look(Instant(bodies=[Body('sphere', 1.0, colour=GREY)]), sun=sun)
    side = 0.8 * np.array(sun) * [1, 1, 0] + [0, 0, 0.55]
    lit = colour_at(view, seen.image, side).sum()
    dark = colour_at(view, seen.image, side * [-1, -1, 1]).sum()
    assert lit > 1.2 * dark


@pytest.mark.parametrize('sun', [(1, 0, 1), (-1, 0, 1), (0, 1, 1), (0.7, -0.7, 1)])
def test_a_shadow_falls_away_from_the_sun(sun):
    """The centre's shadow lies one height further on; the mirrored place stays as bright."""
    high, away = 1.0, np.array([-sun[0], -sun[1], 0]) * 1.0
    scene = Instant(surfaces=[square(0.01, GREY, scale=2.5)],
                    bodies=[Body('plane', colour=GREY), Body('sphere', 0.3, (0, 0, high))])
    view, seen = look(scene, sun=sun)
    shadow = colour_at(view, seen.image, away + [0, 0, 0.01]).sum()
    mirror = colour_at(view, seen.image, -away + [0, 0, 0.01]).sum()
    assert shadow < 0.85 * mirror
    view, seen = look(Instant(bodies=scene.bodies), Camera(-90, 60), sun=sun)    # on the plane
    wide = fit([[-2, -2, 0], [2, 2, 1]], Camera(-90, 60), 80, 80)
    image = render(Instant(bodies=scene.bodies), wide, sun=sun,
                   box=(np.full(3, -2.0), np.full(3, 2.0))).image
    assert colour_at(wide, image, away).sum() < 0.85 * colour_at(wide, image, -away).sum()


def test_a_penumbra_widens_with_the_height_of_what_casts_it():
    def soft(height):
        scene = Instant(surfaces=[square(height, GREY, scale=0.5)],
                        bodies=[Body('plane', colour='white')])
        view = fit([[-1, -1, 0], [1, 1, 0]], ABOVE, 400, 400)
        image = render(scene, view, sun=(0.8, 0, 1), box=(np.full(3, -2.0), np.full(3, 2.0)),
                       over=1).image
        line = np.linspace(-0.98, -0.56, 400)    # across the shadow's edge, clear of the square
        points = np.stack([line, np.full(400, 0.13), np.zeros(400)], axis=1)
        where = view.project(points)[0].astype(int)
        value = image[where[:, 1], where[:, 0]].sum(axis=1)
        low, high = value.min(), value.max()
        assert low < 0.85 * high
        return ((value > low + 0.2 * (high - low)) & (value < high - 0.2 * (high - low))).sum()

    assert soft(0.45) > 2 * soft(0.1)


def test_a_low_roof_blocks_the_light_of_the_sky():
    roof = Instant(surfaces=[square(0.5, GREY)])
    points, triangles = roof.surfaces[0].points, roof.surfaces[0].triangles
    maps = [DepthMap(points, triangles, direction, 64)
            for direction in directions(32)]
    up = np.array([[0.0, 0, 1]])
    below = sky_light(maps, np.array([[0.0, 0, 0]]), up)[0]
    beside = sky_light(maps, np.array([[6.0, 0, 0]]), up)[0]
    assert beside > 0.95
    assert below < 0.5


def test_cloth_in_the_open_does_not_shade_itself():
    """Too small a bias shows as stripes; here every pixel of a flat cloth has one colour."""
    view, seen = look(Instant(surfaces=[square(0.0, GREY)]), sun=(0.6, 0.3, 0.5))
    inside = seen.image[20:60, 20:60].sum(axis=2)
    assert np.ptp(inside) < 0.02


def test_an_unloaded_plane_is_as_bright_as_a_remote_one():
    """A scene of planes alone has no depth maps, and must not go dark for it."""
    view = fit(SQUARE, Camera(), 60, 60)
    box = (np.full(3, -1.0), np.full(3, 1.0))
    plane = Body('plane', colour=GREY)
    alone = render(Instant(bodies=[plane]), view, box=box)
    loaded = render(Instant(bodies=[plane, Body('sphere', 0.01, (0, 0, 0.01))]), view, box=box)
    assert np.median(alone.image) == pytest.approx(np.median(loaded.image), abs=0.02)
