"""The arithmetic behind the page: picking, colours, lines of action."""

import numpy as np
import pytest

from xpbd_ros.view.picking import particle_at
from xpbd_ros.view.stage import line_of_action, ramp, sheets_of

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])


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


def test_a_wrench_has_the_same_torque_at_its_line_of_action():
    rng = np.random.default_rng(1)
    position, force, arm = rng.standard_normal((3, 3))
    torque = np.cross(arm, force)
    point = line_of_action(position, force, torque)
    assert np.cross(point - position, force) == pytest.approx(torque)
    assert (line_of_action(position, np.zeros(3), torque) == position).all()


def test_edges_of_triangles_are_there_once():
    sheet, = sheets_of(['sheet'], [np.array([[0, 1, 2], [1, 3, 2]])], [SQUARE])
    assert {tuple(sorted(edge)) for edge in sheet.edges.tolist()} == {
        (0, 1), (0, 2), (1, 2), (1, 3), (2, 3)}
    assert len(sheet.edges) == 5
    assert sorted(sheet.rest_length) == pytest.approx([1.0, 1.0, 1.0, 1.0, 2.0**0.5])
