"""The arithmetic behind the page: picking, colours, wrenches."""

import numpy as np
import pytest

from xpbd_ros.view.picking import particle_at
from xpbd_ros.view.stage import full_force, on_axis, ramp, Wrench
from xpbd_ros.view.surface import BANDS, bands_of, colour_of, parts_of, sheets_of

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
TWO = np.array([[0, 1, 2], [1, 3, 2]])


@pytest.mark.parametrize('particle', range(4))
def test_a_ray_picks_the_particle_next_to_it(particle):
    origin = np.array([0.3, 0.4, 5.0])
    way = SQUARE[particle] + [0.1, -0.1, 0.0] - origin
    assert particle_at(SQUARE, origin, way / np.linalg.norm(way), 1.0) == particle


def test_a_ray_picks_the_front_one_of_two_layers():
    layers = np.concatenate([SQUARE, SQUARE + [0.0, 0.0, 0.2]])
    assert particle_at(layers, np.array([1.0, 1.0, 3.0]), np.array([0.0, 0.0, -1.0]), 1.0) == 7
    assert particle_at(layers, np.array([1.0, 1.0, -3.0]), np.array([0.0, 0.0, 1.0]), 1.0) == 3


def test_a_ray_picks_nothing_behind_it():
    assert particle_at(SQUARE, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]), 1.0) is None


def test_colours_run_from_white_to_red():
    white, between, red = ramp(np.array([0.0, 0.5, 1.0])).astype(int)
    assert (white == 255).all()
    assert red[0] > 2 * red[1]
    assert (red < between).all()
    assert (between < white).all()


def test_a_wrench_on_its_axis_has_the_same_force_and_torque():
    rng = np.random.default_rng(1)
    wrench = Wrench(*rng.standard_normal((3, 3)))
    found = on_axis(wrench, 100.0)
    assert np.array_equal(found.force, wrench.force)
    assert np.cross(found.torque, found.force) == pytest.approx(np.zeros(3)), 'parallel'
    arm = np.subtract(found.point, wrench.point)
    assert arm @ wrench.force == pytest.approx(0.0), 'the next point of the axis'
    assert found.torque + np.cross(arm, found.force) == pytest.approx(wrench.torque)


def test_a_wrench_whose_axis_is_far_away_stays_at_its_point():
    couple = Wrench((1.0, 2.0, 3.0), (0.0, 0.0, 0.0), (0.0, 0.1, 0.0))
    assert on_axis(couple, 1.0) is couple
    nearly = couple._replace(force=(0.01, 0.0, 0.0))    # its axis is 10 m away
    assert on_axis(nearly, 1.0) is nearly
    assert on_axis(nearly, 11.0).point == pytest.approx((1.0, 2.0, 13.0))


def test_edges_of_triangles_are_there_once():
    kite = SQUARE * [1.0, 2.0, 1.0] + [[0.0, 0.1, 0.0], *np.zeros((3, 3))]
    sheet, = sheets_of(['kite'], [TWO], [kite])
    assert sheet.edges.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    for triangle, sides in zip(TWO, sheet.sides):
        assert set(sheet.edges[sides].ravel()) == set(triangle)
    assert sheet.rest_length[2:] == pytest.approx([5.0**0.5, 2.0, 1.0])


def test_edges_of_a_grid_are_those_along_warp_and_weft():
    sheet, = sheets_of(['sheet'], [TWO], [SQUARE])
    assert sheet.edges.tolist() == [[0, 1], [0, 2], [1, 3], [2, 3]]
    assert sheet.rest_length == pytest.approx(np.ones(4))
    assert sheet.edges[sheet.sides].tolist() == [[[0, 1], [0, 2]], [[1, 3], [2, 3]]]


def test_the_strain_of_a_triangle_is_that_of_its_most_strained_edge():
    sheet, = sheets_of(['sheet'], [TWO], [SQUARE])
    x = SQUARE.copy()
    x[3] = 1.3, 1.0, 0.0    # moves two of the edges
    x[0] = 0.0, 0.1, 0.0
    long, short = 1.3, 0.9
    found = sheet.strains(x)
    assert found[1] == pytest.approx(short - 1.0)
    assert found[3] == pytest.approx(long - 1.0)
    assert sheet.strains_of_triangles(x) == pytest.approx([short - 1.0, long - 1.0])


def test_bands_are_from_blue_over_grey_to_red():
    values = np.array([-2.0, -1.0, 0.0, 0.04, 1.0, 3.0, np.nan])
    assert bands_of(values).tolist() == [-BANDS, -BANDS, 0, 0, BANDS, BANDS, 0]
    blue, grey, red = (colour_of(band).astype(int) for band in (-BANDS, 0, BANDS))
    assert blue[2] > 2 * blue[0]
    assert red[0] > 2 * red[2]
    assert np.ptp(grey) < 10


def test_parts_of_a_mesh_have_its_triangles():
    rng = np.random.default_rng(3)
    triangles = np.array([rng.permutation(20)[:3] for _ in range(30)])
    bands, x = rng.integers(-2, 3, 30), rng.standard_normal((20, 3))
    parts = parts_of(triangles, bands, 20)
    assert parts.keys() == set(bands.tolist())
    for band, (particles, corners) in parts.items():
        assert np.array_equal(x[particles][corners], x[triangles[bands == band]])
        assert len(particles) == len(np.unique(corners)), 'no particle without a triangle'


def test_the_darkest_colour_is_not_that_of_one_particle():
    forces = np.concatenate([np.zeros(50), np.linspace(0.1, 1.0, 100), [50.0]])
    assert 0.9 < full_force(forces) <= 1.0
    assert full_force(np.zeros(3)) > 0.0
