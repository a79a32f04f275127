"""Directions that part a pair through a substep, against brute force; and particles held back."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xpbd_ros.sim.self_collision.motion_limit import go_share, limit_shares, rest_step
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


class Plane(NamedTuple):
    """Fields of ``Planes`` that ``limit_shares`` reads and writes."""

    side: np.ndarray
    number: np.ndarray
    normal: np.ndarray
    need: np.ndarray
    share: np.ndarray


class Near(NamedTuple):
    """Fields of ``NeighbourList`` that these functions read."""

    x: np.ndarray
    step: np.ndarray
    slot: np.ndarray
    count: np.ndarray


class Particles(NamedTuple):
    """Fields of ``State`` that these functions read."""

    x: np.ndarray
    inv_mass: np.ndarray
    history: None


@pytest.mark.parametrize('pinned', [False, True])
@pytest.mark.parametrize('side', [1, 2], ids=['triangle', 'edges'])
def test_sides_that_are_held_back_stay_apart_and_what_moves_less_is_free(side, pinned):
    """Whatever all do together; a pinned particle takes up to 0.8 of the distance."""
    random, held, distance = np.random.default_rng(side), 0, 10.0 * NEED
    sign = np.where(np.arange(4) < side, 1.0, -1.0)
    for _ in range(200):
        n, step = random.normal(size=3), random.normal(0.0, 2.0, 3)
        n /= np.linalg.norm(n)
        start, way = random.uniform(-1.0, 1.0, (4, 3)), random.normal(0.0, distance, (4, 3))
        along = start @ n
        start[:side] += (distance + along[side:].max() - along[:side].min()) * n
        weight = np.ones(4)
        if pinned:
            i = random.integers(4)
            weight[i] = 0.0
            way[i] += (random.uniform(-0.8, 0.8) * distance - way[i] @ n) * n
        planes = Plane(np.array([side]), np.arange(4)[None], n[None], np.array([NEED]), np.ones(4))
        near = Near(np.pad(start, ((0, 0), (0, 1)), constant_values=1e3), step, np.arange(4),
                    np.zeros(4, np.int64))
        state = Particles((start + step + way).T.copy(), weight, None)
        limit_shares(planes, 0, near, state)
        for i in range(4):
            go_share(near, state, i, planes.share[i])
        at = state.x.T @ n
        assert at[:side].min() - at[side:].max() >= NEED * (1.0 - 1e-9)
        np.testing.assert_allclose(state.x.T - start - step, np.where(
            weight > 0.0, planes.share, 1.0)[:, None] * way, atol=1e-12)
        free = sign * (way @ n) >= (0.0 if pinned else 0.52 * NEED - 0.5 * distance)
        assert (planes.share[free] == 1.0).all()
        held += near.count[2]
    assert held > 100


@pytest.mark.parametrize('pinned', [0, 1, 2])
def test_held_particles_rest_on_the_pinned_ones_among_them(pinned):
    """Their common displacement is the mean of those; of all that are held if none is pinned."""
    random, held = np.random.default_rng(pinned), np.array([True, False, True, True, True])
    x, way, weight = random.normal(size=(5, 3)), random.normal(size=(5, 3)), np.ones(5)
    weight[[2, 4][:pinned]] = 0.0
    weight[1] = 0.0    # pinned, and not held
    near = Near(x, np.full(3, 7.0), np.arange(5), np.zeros(4, np.int64))
    rest_step(near, held, None, Particles((x + way).T.copy(), weight, None))
    np.testing.assert_allclose(near.step, way[held if pinned == 0 else [2, 4][:pinned]].mean(0),
                               rtol=1e-12)
