"""Directions that part a pair through a substep, against brute force over all directions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xpbd_ros.sim.self_collision.separating_direction import part, write_vectors
from xpbd_ros.study.stress.crossings import volume

NEED = 0.05


def everywhere(count=20_000):
    """Return directions all round."""
    z = np.linspace(-1.0, 1.0, count)
    angle = np.pi * (1.0 + 5.0**0.5) * np.arange(count)
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)


def vectors(side, start, end):
    """Return the vectors between the sides at start and end, and how many of each there are."""
    points = np.zeros((8, 3))
    count = write_vectors(points, side, np.arange(4), start, np.arange(4), end.T.copy())
    return points, count


@pytest.mark.parametrize('side', [1, 2], ids=['triangle', 'edges'])
def test_a_pair_is_parted_where_a_direction_parts_it(side):
    random, directions, found = np.random.default_rng(side), everywhere(), [0, 0]
    for _ in range(400):
        start = random.uniform(-1.0, 1.0, (4, 3))
        start[:side] += (0.0, 0.0, 1.6)
        end = start + random.normal(0.0, 2.0, (4, 3))
        points, count = vectors(side, start, end)
        first = directions[(directions @ points[:count].T).min(1).argmax()]
        if (points[:count] @ first).min() < NEED:
            continue
        good, best = part(points, np.zeros(8), count, tuple(first), NEED)
        truth = (directions @ points[:2 * count].T).min(1).max()
        along = points[:2 * count] @ np.array(best)
        assert np.linalg.norm(best) == pytest.approx(1.0)
        assert along[:count].min() >= NEED * (1.0 - 1e-9)
        assert good == (along.min() >= NEED)
        size = np.linalg.norm(points[:2 * count], axis=1).max()
        assert good or truth < NEED + 0.01 * size    # the steps end somewhere: it may be missed
        found[good] += 1
    assert min(found) > 20


def test_what_gets_through_a_triangle_is_not_parted():
    random, through = np.random.default_rng(3), 0
    for _ in range(200):
        start = random.uniform(-1.0, 1.0, (4, 3))
        start[0] = (0.0, 0.0, 1.0)
        start[1:, 2] *= 0.2
        end = start.copy()
        end[0] += random.uniform(-1.0, 1.0, 3) * (0.5, 0.5, 0.0) - (0.0, 0.0, 2.0)
        points, count = vectors(1, start, end)
        p, q = start[0], end[0]
        sides = [volume(a - p, b - p, q - p) for a, b in zip(start[1:], np.roll(start[1:], -1, 0))]
        if min(sides) > 0.0 or max(sides) < 0.0:
            through += 1
            assert not part(points, np.zeros(8), count, (0.0, 0.0, 1.0), NEED)[0]
    assert through > 20


@pytest.mark.parametrize('way', [0.0, 0.3, 3.0, 30.0])
def test_what_slides_over_a_triangle_is_parted_however_far(way):
    """The normals at the start and at the end lean against the way and do not part it alone."""
    turn = Rotation.from_euler('xyz', [0.3, 0.2, 0.1])
    start = np.array([[-0.5 * way, 0.01, 0.1], [-0.2, -0.1, 0.0], [0.2, -0.1, 0.0],
                      [0.0, 0.3, 0.0]])
    end = start + [[way, 0.0, 0.0], [0.0] * 3, [0.0] * 3, [0.0] * 3]
    points, count = vectors(1, turn.apply(start), turn.apply(end))
    assert part(points, np.zeros(8), count, tuple(turn.apply([0.0, 0.0, 1.0])), 0.05)[0]
    lean = np.array([0.1, 0.0, 0.1]) / np.hypot(0.1, 0.1)
    assert part(points, np.zeros(8), count, tuple(turn.apply(lean)), 0.05)[0]
