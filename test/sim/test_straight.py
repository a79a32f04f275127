"""Straight lines over triangles, against lines in the plane and on a body's unfolded net."""

import numpy as np
import pytest

from support.meshes import ball, box_surface, disc
from xpbd_ros.sim.geometry.geodesics import straight_lines


@pytest.mark.parametrize('across', [1, 2, 4])
def test_in_the_plane_a_line_is_as_long_as_it_is_straight(across):
    """Also where triangles are turned over; each pair comes once."""
    vertices, triangles = disc(5)
    random = np.random.default_rng(across)
    vertices = vertices + np.pad(random.normal(0.0, 0.01, (len(vertices), 2)), ((0, 0), (0, 1)))
    over = random.random(len(triangles)) < 0.5
    triangles = np.where(over[:, None], triangles[:, ::-1], triangles)
    pairs, lines = straight_lines(vertices, triangles, across)
    assert len(pairs) > 100 * across
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    np.testing.assert_allclose(lines, np.linalg.norm(
        vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1), rtol=1e-12)


def test_over_the_edge_of_a_box_it_is_that_of_the_net():
    """From corner to far corner: over the one of three edges that makes it shortest."""
    vertices, triangles = box_surface(0.5, 1.0, 1.5)
    pairs, lines = straight_lines(vertices, triangles, 3)
    between = {tuple(pair): line for pair, line in zip(pairs.tolist(), lines.tolist())}
    a, b, c = 1.0, 2.0, 3.0
    assert between[0, 7] == pytest.approx(min(np.hypot(a + b, c), np.hypot(a + c, b),
                                              np.hypot(b + c, a)), rel=1e-12)


def test_on_a_ball_it_is_between_chord_and_slightly_above_arc():
    vertices, triangles = ball(3)
    pairs, lines = straight_lines(vertices, triangles, 4)
    radius = np.linalg.norm(vertices[0])
    chord = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    assert (lines >= chord * (1.0 - 1e-12)).all()
    assert (lines <= 2.0 * radius * np.arcsin(0.5 * chord / radius) * 1.01).all()


def test_nothing_is_across_nothing_or_an_edge_of_three():
    assert len(straight_lines(*disc(2), 0)[0]) == 0
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, -1, 0], [0, 0, 1]])
    three = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    assert len(straight_lines(x, three, 4)[0]) == 0
    assert straight_lines(x, three[:2], 4)[0].tolist() == [[2, 3]]
