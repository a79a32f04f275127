"""Trees of boxes: queries find what brute force finds."""

import numpy as np
import pytest

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.geometry.box_tree import (
    bisected,
    find_packs,
    new_box_tree,
    overlaps,
    update_boxes,
)


@jit
def query(tree, low, high, found):
    """Write the items whose boxes overlap a box to ``found``; return their number."""
    packs, reached = find_packs(tree, (low, high), 0)
    count = 0
    for n in range(reached):
        hit = overlaps(tree, packs[n], (low, high))
        for lane in range(PACK):
            if hit >> lane & 1:
                found[count] = packs[n] + lane
                count += 1
    return count


def items_in(tree, low, high):
    """Return the items that a query finds, as tuples of their corners."""
    found = np.zeros(tree.low.shape[1], np.int64)
    count = query(tree, tuple(low), tuple(high), found)
    assert (np.diff(found[:count]) > 0).all()
    return [tuple(pair) for pair in tree.corners[:, found[:count]].T.tolist()]


@pytest.mark.parametrize('count', [1, 15, 16, 17, 256, 257, 1500])
def test_a_query_finds_what_brute_force_finds(count):
    random = np.random.default_rng(count)
    rest = random.uniform(-1.0, 1.0, (count + 1, 3))
    items = np.stack([np.arange(count), np.arange(1, count + 1)], 1)
    tree = new_box_tree(items, rest, np.zeros(count + 1, np.int64))
    hits = 0
    for _ in range(3):    # the tree is refitted
        spheres = random.uniform(-1.0, 1.0, (count + 1, 4)).astype(np.float32)
        spheres[:, 3] = 0.05 * np.abs(spheres[:, 3])
        update_boxes(None, tree, spheres)
        centre, radius = spheres[items, :3], spheres[items, 3:]
        for low in random.uniform(-1.0, 1.0, (20, 3)):
            high = low + random.uniform(0.0, 0.5, 3)
            low, high = low.astype(np.float32), high.astype(np.float32)
            there = (((centre - radius).min(1) <= high)
                     & ((centre + radius).max(1) >= low)).all(1)
            assert sorted(items_in(tree, low, high)) == [
                tuple(pair) for pair in items[there].tolist()]
            hits += there.sum()
    assert hits > 0


@pytest.mark.parametrize('count', [15, 50, 300])
def test_a_box_without_bounds_overlaps_all_others_and_no_empty_ones(count):
    """That of a point of infinite radius: a tree has empty boxes behind the end of each level."""
    points = np.random.default_rng(2).uniform(-1.0, 1.0, (count, 4)).astype(np.float32)
    points[0, 3] = np.inf
    tree = new_box_tree(np.arange(count)[:, None], points[:, :3], np.zeros(count, np.int64))
    update_boxes(None, tree, points)
    place = tree.corners[0].tolist().index(0)
    found = items_in(tree, tree.low[:, place], tree.high[:, place])
    assert sorted(found) == [(i,) for i in range(count)]


def test_points_that_are_not_finite_hide_no_others():
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (100, 4)).astype(np.float32)
    points[:, 3] = 0.0
    tree = new_box_tree(np.arange(100)[:, None], points[:, :3], np.zeros(100, np.int64))
    points[::7] = np.nan
    points[3::7] = np.inf
    update_boxes(None, tree, points)
    found = items_in(tree, (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    assert sorted(found) == [(i,) for i in range(100) if np.isfinite(points[i, 0])]


def test_nodes_of_a_group_are_on_either_side_of_a_plane():
    points = np.random.default_rng(2).uniform(0.0, 1.0, (1000, 3)) * [1.0, 2.0, 0.1]
    order = bisected(points, np.zeros(1000, np.int64))
    assert sorted(order) == list(range(1000))
    for size in (PACK, PACK**2):
        for first in range(0, 1000 - size, 2 * size):
            one = points[order[first:first + size]]
            other = points[order[first + size:first + 2 * size]]
            assert (one.max(0) <= other.min(0)).any()


def test_groups_stand_one_after_another():
    group = np.array([1, 2, 0] * 50)
    order = bisected(np.random.default_rng(3).uniform(0.0, 1.0, (150, 3)), group)
    assert sorted(order) == list(range(150))
    assert (np.diff(group[order]) >= 0).all()
    assert bisected(np.zeros((20, 3)), np.zeros(20, np.int64)).tolist() == list(range(20))
    assert bisected(np.zeros((0, 3)), np.zeros(0, np.int64)).tolist() == []
