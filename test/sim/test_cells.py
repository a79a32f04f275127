"""Points in cells, against all points: near, far and nowhere."""

import numpy as np
import pytest

from xpbd_ros.sim.self_collision.spatial_hash import fill, in_order, look_up, new_cells


@pytest.mark.parametrize('count', [0, 1, 2, 5, 100, 3000])
def test_numbers_are_put_in_order_and_the_rest_is_left_alone(count):
    numbers = np.random.default_rng(count).permutation(count + 7)
    expected = np.append(np.sort(numbers[:count]), numbers[count:])
    in_order(numbers, count)
    assert (numbers == expected).all()


@pytest.mark.parametrize('far', [0.0, 1e6, 1e12])
def test_a_box_holds_what_brute_force_finds(far):
    """Also 1e12 m away, and with points about that no cell has a number for."""
    points = far + np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3))
    points[::20] = [[np.nan, np.inf, 0.0], [-np.inf, 1e300, -1e300]] * 5
    cells = new_cells(len(points))
    fill(cells, points, 0.25)
    for low in points[1:20]:
        high = low + 0.6
        count = look_up(cells, points, 0.25, tuple(low), tuple(high), 0)
        found = set(cells.found[:count].tolist())
        with np.errstate(invalid='ignore'):
            assert found == set(np.flatnonzero(
                ((points >= low) & (points <= high)).all(1)).tolist())
        assert found


@pytest.mark.parametrize(('low', 'high'), [
    ((-np.inf, -1.0, -1.0), (1.0, np.inf, 1.0)), ((0.0, 0.0, 0.0), (np.inf, np.inf, np.inf)),
    ((-1e300, 0.0, -1e300), (1e300, 1e300, 0.0)), ((0.0, 0.0, 0.0), (1e5, 1e5, 1e5))])
def test_a_box_of_too_many_cells_is_compared_with_every_point(low, high):
    """Such as that of a triangle with a corner at infinity; cell by cell it would take years."""
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3))
    points[::20] = [[np.nan, np.inf, 0.0], [-np.inf, 1e300, -1e300]] * 5
    cells = new_cells(len(points))
    fill(cells, points, 0.25)
    count = look_up(cells, points, 0.25, low, high, 7)
    assert cells.found[:count].tolist() == [i for i in range(7, 200) if (
        (points[i] >= low) & (points[i] <= high)).all()]
    assert count
