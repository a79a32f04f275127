"""What hides what, and which side is seen."""

import numpy as np
import pytest

from support.pictures import (
    BLUE,
    FACING,
    is_blue,
    is_red,
    Picture,
    RED,
    SQUARE,
    square,
    TWO,
    world,
)
from xpbd_ros.study.picture import Body, Instant, Path, Surface
from xpbd_ros.study.picture.camera import SUN


@pytest.fixture(autouse=True)
def _pyvista(pyvista):
    pass


@pytest.mark.parametrize('turn', [np.eye(3), [[0, 0.8, 0.6], [0.6, 0, 0], [0, 0.6, -0.8]]])
def test_cloth_is_seen_where_it_projects_to_and_nowhere_else(turn):
    around = 1.5 * np.concatenate([SQUARE, [[0, 0, -0.5], [0, 0, 0.5]]])
    seen = Picture(Instant(surfaces=[Surface(world(SQUARE @ turn), TWO, RED)]), shown=around)
    for x in (-1.3, -0.85, 0.0, 0.85, 1.3):
        for y in (-1.3, -0.85, 0.0, 0.85, 1.3):
            colour = seen.at(world([x, y, 0] @ np.asarray(turn)))
            if max(abs(x), abs(y)) < 1:
                assert colour[0] > 1.15 * colour[2]
            else:
                np.testing.assert_array_equal(colour, 255)


@pytest.mark.parametrize('first', [0, 1])
def test_the_near_one_hides_the_far_one_whatever_their_order(first):
    pair = [square(0.3, RED), square(-0.3, BLUE)]
    assert is_red(Picture(Instant(surfaces=[pair[first], pair[1 - first]])).at([0, 0, 0]))


def test_squares_that_cross_are_each_seen_where_they_are_nearer():
    tilt = SQUARE * [1, 1, 0] + np.outer(SQUARE[:, 0], [0, 0, 0.4])
    seen = Picture(Instant(surfaces=[Surface(world(tilt), TWO, RED),
                                     Surface(world(tilt * [1, 1, -1]), TWO, BLUE)]))
    assert is_red(seen.at(world([0.5, -0.8, 0]))) and is_blue(seen.at(world([-0.5, -0.8, 0])))


def test_a_plane_hides_all_behind_it_but_no_cloth_on_it():
    for depth, hidden in ((0.5, True), (1e-5, False)):
        seen = Picture(Instant(surfaces=[square(-depth, RED)],
                               bodies=[Body('plane', orientation=FACING)]))
        assert is_red(seen.at([0, 0, 0])) != hidden


def test_cloth_covers_a_body_it_bridges_but_not_a_thin_one():
    """A flat triangle on a ball lies a little inside it; a thin post stays whole."""
    instant = Instant(surfaces=[square(0.5 - 0.005, RED, scale=0.03)],
                      bodies=[Body('sphere', (0.5,))])
    assert is_red(Picture(instant, pixels=200).at(world([0, 0, 0.5])))
    post = Body('capsule', (0.03, 1.5), world([0, 0, 0.04]))
    seen = Picture(Instant(surfaces=[square(0.0, RED)], bodies=[post]), pixels=200)
    assert not is_red(seen.at(world([0, 0, 0.04])))


def test_the_back_of_a_cloth_is_paler():
    front, back = (Picture(Instant(surfaces=[square(0.0, RED, triangles=triangles)])).at([0, 0, 0])
                   for triangles in (TWO, TWO[:, ::-1]))
    assert is_red(front) and not is_red(back)
    assert back[1] > 2 * front[1]


def test_a_plane_receives_shadows_and_fades_to_white():
    instant = Instant(bodies=[Body('plane'), Body('sphere', (0.3,), (0, 0, 0.6))])
    seen = Picture(instant)
    away = -0.6 * SUN / SUN[2] + [0, 0, 0.6]
    assert seen.at(away).sum() < 0.85 * seen.at(-away).sum()
    wide = Picture(instant, shown=5 * SQUARE)
    np.testing.assert_array_equal(wide.at([3, 3, 0]), 255)


def test_a_path_has_its_colour_and_is_hidden_by_cloth():
    path = Path(world([[-0.7, 0.1, 0.2], [0.7, 0.1, 0.2]]), '#00ff00')

    def greens(*surfaces):
        image = Picture(Instant(surfaces=surfaces, paths=[path]), pixels=120).image.astype(int)
        return (image[..., 1] > 1.3 * image[..., [0, 2]].max(axis=2)).sum()

    assert greens() > 60
    assert greens(square(0.0)) > 60
    assert greens(square(0.6)) == 0


def test_what_lies_behind_the_camera_is_left_out():
    assert Picture(Instant(surfaces=[square(100.0, RED)])).image.min() == 255
