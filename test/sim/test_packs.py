"""Packs: every constraint once, PACK at a time side by side."""

import numpy as np
import pytest

from support.meshes import disc
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.constraints.mesh_batches import EMPTY, pack, padded
from xpbd_ros.sim.geometry.mesh import edges, hinges


def triangles(n):
    """Return a triangulated square of n × n cells, its particles in rows."""
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    return np.concatenate([np.stack([a, a + 1, a + n + 2], 1),
                           np.stack([a, a + n + 2, a + n + 1], 1)])


LISTS = {
    'nothing': np.zeros((0, 2), np.int64),
    'one': np.array([[3, 7]]),
    'all at one particle': np.stack([np.zeros(40, int), np.arange(1, 41)], 1),
    'edges of a disc': edges(disc()[1]),
    'hinges of a disc': hinges(disc()[1]),
    'triangles': triangles(20),
    'shuffled': np.random.default_rng(0).permutation(edges(triangles(20))),
}
AROUND = pytest.mark.parametrize('name', LISTS)


@AROUND
def test_packs_partition_constraints_without_shared_particles(name):
    particles = LISTS[name]
    order = pack(particles)
    assert len(order) % PACK == 0
    np.testing.assert_array_equal(np.sort(order[order != EMPTY]), np.arange(len(particles)))
    for members in order.reshape(-1, PACK):
        touched = particles[members[members != EMPTY]].ravel()
        assert 0 < len(np.unique(touched)) == len(touched)


def test_packs_are_full_but_for_the_last():
    for particles in (edges(triangles(40)), hinges(triangles(40)), triangles(40)):
        order = pack(particles)
        assert (order != EMPTY).mean() > 0.95


def test_a_star_has_one_constraint_a_pack():
    assert len(pack(LISTS['all at one particle'])) == 40 * PACK


@AROUND
def test_numbers_follow_their_constraints(name):
    particles = LISTS[name]
    order = pack(particles)
    found = padded(particles, order, -9, np.int32)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found[order != EMPTY], particles[order[order != EMPTY]])
    assert (found[order == EMPTY] == -9).all()
