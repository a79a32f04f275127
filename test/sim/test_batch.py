"""Colouring: what may be projected side by side, and in which order."""

import numpy as np
import pytest

from xpbd_ros.sim.batch import colour_order, hold


def check_colours(particles, order, starts):
    """Assert that colours partition the constraints and that none shares a particle within."""
    assert sorted(order.tolist()) == list(range(len(particles)))
    assert starts[0] == 0
    assert starts[-1] == len(particles)
    assert (np.diff(starts) > 0).all()
    for begin, end in zip(starts[:-1], starts[1:]):
        members = particles[order[begin:end]].ravel()
        assert len(np.unique(members)) == len(members)


@pytest.mark.parametrize('width', [2, 3, 4])
def test_no_two_constraints_of_a_colour_share_a_particle(width):
    rng = np.random.default_rng(width)
    particles = np.array([rng.choice(40, width, replace=False) for _ in range(300)])
    check_colours(particles, *colour_order(particles, 40))


def test_a_star_needs_a_colour_per_ray_however_many():
    """More than 64, the bits of one word."""
    rays = 200
    particles = np.column_stack([np.zeros(rays, int), np.arange(1, rays + 1)])
    order, starts = colour_order(particles, rays + 1)
    check_colours(particles, order, starts)
    assert len(starts) == rays + 1


def test_a_line_needs_two_colours_and_keeps_its_order_in_each():
    particles = np.column_stack([np.arange(9), np.arange(1, 10)])
    order, starts = colour_order(particles, 10)
    assert order.tolist() == [0, 2, 4, 6, 8, 1, 3, 5, 7]
    assert starts.tolist() == [0, 5, 9]


@pytest.mark.parametrize('width', [2, 4])
def test_nothing_to_colour_is_fine(width):
    order, starts = colour_order(np.zeros((0, width), np.int64), 5)
    assert order.shape == (0,)
    assert starts.tolist() == [0]


def test_held_lists_the_constraints_at_a_pinned_particle_and_forgets_the_last_list():
    particles = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    held = np.zeros(5, np.int64)
    hold(particles, np.array([0.0, 1.0, 1.0, 1.0]), held)
    assert held[:3].tolist() == [2, 0, 3]
    hold(particles, np.ones(4), held)
    assert held[0] == 0
