"""What hides what, and which side is seen."""

import numpy as np
import pytest
from study.picture.scenes import (
    ABOVE,
    BELOW,
    BLUE,
    is_blue,
    is_red,
    Picture,
    RED,
    SQUARE,
    square,
    TWO,
)

from xpbd_ros.study.picture import Body, Instant, Path, Surface
from xpbd_ros.study.picture.camera import Camera


@pytest.fixture(autouse=True)
def _pyvista(pyvista):
    pass


@pytest.mark.parametrize('camera', [ABOVE, Camera(), Camera(30, 60, 60)])
def test_cloth_is_seen_where_it_projects_to_and_nowhere_else(camera):
    around = 1.5 * np.concatenate([SQUARE, [[0, 0, -0.5], [0, 0, 0.5]]])
    seen = Picture(Instant(surfaces=[square(0.0, RED)]), camera, shown=around)
    for x in (-0.9, 0.0, 0.9):
        for y in (-0.9, 0.0, 0.9):
            assert is_red(seen.at([x, y, 0]))
    for point in ([-1.3, 0, 0], [1.3, 0, 0], [0, -1.4, 0], [0, 1.4, 0]):
        np.testing.assert_array_equal(seen.at(point), 255)


@pytest.mark.parametrize('first', [0, 1])
def test_the_near_one_hides_the_far_one_whatever_their_order(first):
    pair = [square(0.3, RED), square(-0.3, BLUE)]
    instant = Instant(surfaces=[pair[first], pair[1 - first]])
    assert is_red(Picture(instant).at([0, 0, 0]))
    assert is_blue(Picture(instant, BELOW).at([0, 0, 0]) - 90)    # its back is paler


def test_squares_that_cross_are_each_seen_where_they_are_higher():
    tilt = SQUARE * [1, 1, 0] + np.outer(SQUARE[:, 0], [0, 0, 0.4])
    seen = Picture(Instant(surfaces=[Surface(tilt, TWO, RED),
                                     Surface(tilt * [1, 1, -1], TWO, BLUE)]))
    assert is_red(seen.at([0.5, -0.8, 0])) and is_blue(seen.at([-0.5, -0.8, 0]))


def test_a_plane_hides_what_is_below_it_but_not_a_cloth_that_lies_on_it():
    for depth, hidden in ((0.5, True), (1e-5, False)):
        seen = Picture(Instant(surfaces=[square(-depth, RED)], bodies=[Body('plane')]))
        assert is_red(seen.at([0, 0, 0])) != hidden


def test_cloth_that_bridges_a_body_covers_it_but_never_shows_through_a_thin_one():
    """A flat triangle on a ball lies a little inside it; a thin post stays whole."""
    instant = Instant(surfaces=[square(0.5 - 0.005, RED, scale=0.03)],
                      bodies=[Body('sphere', (0.5,))])
    assert is_red(Picture(instant).at([0, 0, 0.5]))
    post = Body('capsule', (0.03, 1.5), (0, 0, 0.04), (0, np.sqrt(0.5), 0, np.sqrt(0.5)))
    seen = Picture(Instant(surfaces=[square(0.0, RED)], bodies=[post]), pixels=200)
    assert not is_red(seen.at([0, 0, 0.04]))


def test_the_two_sides_of_a_cloth_differ_and_turning_the_triangles_swaps_them():
    cloth = square(0.0, RED)
    turned = Surface(cloth.points, TWO[:, ::-1], RED)
    front, back = (Picture(Instant(surfaces=[one])).at([0, 0, 0]) for one in (cloth, turned))
    assert is_red(front) and not is_red(back)
    assert back[1] > 2 * front[1], 'paler'
    assert not is_red(Picture(Instant(surfaces=[cloth]), BELOW).at([0, 0, 0]))
    assert is_red(Picture(Instant(surfaces=[turned]), BELOW).at([0, 0, 0]))


def test_a_plane_receives_shadows_and_fades_to_white():
    ball = Body('sphere', (0.3,), (0, 0, 0.8))
    camera = Camera(-90, 70)
    seen = Picture(Instant(bodies=[Body('plane'), ball]), camera)
    away = -0.8 * camera.sun / camera.sun[2] + [0, 0, 0.8]
    assert seen.at(away).sum() < 0.85 * seen.at(-away).sum()
    wide = Picture(Instant(bodies=[Body('plane'), ball]), camera, shown=5 * SQUARE)
    np.testing.assert_array_equal(wide.at([4, 4, 0]), 255)


def test_a_path_is_drawn_in_its_colour_and_hidden_by_what_is_before_it():
    path = Path([[-0.9, 0.1, 0.2], [0.9, 0.1, 0.2]], '#00ff00')

    def greens(*surfaces):
        image = Picture(Instant(surfaces=surfaces, paths=[path]), pixels=120).image.astype(int)
        return (image[..., 1] > 1.3 * image[..., [0, 2]].max(axis=2)).sum()

    assert greens() > 60
    assert greens(square(0.1)) > 60
    assert greens(square(0.6)) == 0


def test_what_lies_behind_the_camera_is_left_out():
    behind = Surface(SQUARE + [0, 0, 100], TWO, RED)
    assert Picture(Instant(surfaces=[behind])).image.min() == 255
