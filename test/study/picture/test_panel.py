"""What hides what, and which side is seen."""

import numpy as np
import pytest

from support.pictures import (
    BLUE,
    colour_at,
    GREY,
    is_blue,
    is_red,
    look,
    RED,
    SQUARE,
    square,
    TWO,
)
from xpbd_ros.study.picture import Body, Camera, fit, Instant, render, Surface


@pytest.mark.parametrize('first', [0, 1])
def test_the_near_one_hides_the_far_one_whatever_their_order(first):
    """Seen from above the higher square is in front; drawn first or last, it wins."""
    pair = [square(0.3, RED, back_colour=RED), square(-0.3, BLUE, back_colour=BLUE)]
    view, seen = look(Instant(surfaces=[pair[first], pair[1 - first]]))
    assert is_red(colour_at(view, seen.image, [0, 0, 0]))
    view, seen = look(Instant(surfaces=pair), Camera(azimuth=-90, elevation=-89.9))
    assert is_blue(colour_at(view, seen.image, [0, 0, 0]))


def test_squares_that_cross_are_each_seen_where_they_are_higher():
    """No order of whole triangles can draw this one: it takes a comparison at each sample."""
    tilt = SQUARE * [1, 1, 0] + np.outer(SQUARE[:, 0], [0, 0, 0.4])
    view, seen = look(Instant(surfaces=[Surface(tilt, TWO, RED),
                                        Surface(tilt * [1, 1, -1], TWO, BLUE)]))
    assert is_red(colour_at(view, seen.image, [0.5, -0.8, 0]))    # both in the first triangles
    assert is_blue(colour_at(view, seen.image, [-0.5, -0.8, 0]))


def test_a_plane_hides_all_below_it_but_no_cloth_on_it():
    ground = Body('plane', colour=GREY)
    view, seen = look(Instant(surfaces=[square(-0.5, RED)], bodies=[ground]))
    assert not is_red(colour_at(view, seen.image, [0, 0, 0]))
    view, seen = look(Instant(surfaces=[square(-1e-5, RED)], bodies=[ground]))
    assert is_red(colour_at(view, seen.image, [0, 0, 0]))


def test_cloth_covers_a_body_it_bridges_but_not_a_thin_one():
    """A flat triangle on a ball lies inside it by up to half its edge; a thin post stays whole."""
    cap = square(0.5 - 0.02, RED, scale=0.05)
    ball = Body('sphere', 0.5, colour=BLUE)
    view, seen = look(Instant(surfaces=[cap], bodies=[ball]))
    assert is_red(colour_at(view, seen.image, [0, 0, 0.5]))
    coarse, post = square(0.0, RED), Body('capsule', (0.03, 1.5), (0, 0, 0.04),
                                          (0, np.sqrt(0.5), 0, np.sqrt(0.5)), colour=BLUE)
    view, seen = look(Instant(surfaces=[coarse], bodies=[post]), pixels=200)
    assert is_blue(colour_at(view, seen.image, [0, 0, 0.04]))


def test_depth_is_the_distance_along_the_view():
    view, seen = look(Instant(surfaces=[square(0.3, RED)]))
    column, row = view.project([0.2, 0.1, 0.3])[0][0].astype(int)
    assert seen.depth[row, column] == pytest.approx(view.project([0, 0, 0.3])[1][0], rel=1e-3)
    assert np.isinf(seen.depth[0, 0])


def test_the_two_sides_of_a_cloth_have_their_own_colours():
    cloth = Instant(surfaces=[square(0.0, RED, back_colour=BLUE)])
    view, seen = look(cloth)
    assert is_red(colour_at(view, seen.image, [0, 0, 0]))
    view, seen = look(cloth, Camera(azimuth=-90, elevation=-89.9))
    assert is_blue(colour_at(view, seen.image, [0, 0, 0]))


def test_turning_the_triangles_swaps_the_sides():
    cloth = Surface(SQUARE, TWO[:, ::-1], RED, BLUE)
    view, seen = look(Instant(surfaces=[cloth]))
    assert is_blue(colour_at(view, seen.image, [0, 0, 0]))


def test_what_lies_behind_the_camera_is_left_out():
    view = fit(SQUARE, Camera(), 60, 60)
    behind = Surface(SQUARE + 2 * view.eye, TWO, RED)
    image = render(Instant(surfaces=[behind]), view).image
    assert image.min() == pytest.approx(1)
