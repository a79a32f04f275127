"""Islands of squeezed pairs: those that particles connect, as in a graph."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from xpbd_ros.sim.self_collision.stacks import new_stack, sort_by_island

PARTICLES, MOST = 60, 64
"""number of particles, and of pairs at most"""


class Contacts(NamedTuple):
    """The fields of contacts that sorting uses; the candidates of a particle form a list."""

    count: np.ndarray
    latest: np.ndarray
    particle: np.ndarray
    earlier: np.ndarray


class Near(NamedTuple):
    """The field of a neighbour list that sorting uses."""

    slot: np.ndarray


def listed(random, pairs: int):
    """Return a stack that lists some pairs of random particles, in the order of the pairs."""
    stack = new_stack(PARTICLES, MOST, 1)
    dummy = PARTICLES
    for m in range(pairs):
        four = random.choice(PARTICLES, 4, replace=False)
        stack.close.particles[:, m] = four if m % 3 else (*four[:2], dummy, dummy)
    stack.pairs[:pairs] = np.arange(pairs)
    used = stack.close.particles[:, :pairs].T.ravel()
    first = np.sort(np.unique(used, return_index=True)[1])
    order = used[first][used[first] != dummy]
    stack.particles[:len(order)] = order
    stack.place[order] = np.arange(len(order))
    stack.count[:2] = pairs, len(order)
    return stack, order


def candidates(random) -> Contacts:
    """Return up to two candidates of each particle."""
    number = random.integers(0, 3, PARTICLES)
    particle = np.concatenate([np.flatnonzero(number > k) for k in range(2)])
    latest, earlier = np.zeros(PARTICLES, np.int64), np.full(len(particle), -1)
    for k, i in enumerate(particle):
        if k >= np.count_nonzero(number):
            earlier[k] = latest[i]
        latest[i] = k
    return Contacts(np.array([len(particle)]), latest, particle, earlier)


@pytest.mark.parametrize('pairs', [0, 1, 5, 12, 40])
def test_they_are_the_connected_components(pairs):
    """Each has its pairs, particles and springs together, in the order in which they were."""
    random = np.random.default_rng(pairs)
    stack, order = listed(random, pairs)
    contacts = candidates(random)
    sort_by_island(stack, contacts, Near(np.arange(PARTICLES)))
    ends = [(four[0], i) for four in stack.close.particles[:, :pairs].T
            for i in four if i < PARTICLES]
    rows, columns = np.array(ends, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(ends)), (rows, columns)), (PARTICLES, PARTICLES))
    label = connected_components(graph, directed=False)[1]
    expected = list(dict.fromkeys(label[order]))
    assert stack.count[2] == len(expected)
    springs = 0
    for c, island in enumerate(expected):
        (m, q, t), (n, r, u) = stack.begin[c:c + 2]
        own = [k for k in range(pairs) if label[stack.close.particles[0, k]] == island]
        assert list(stack.pairs[m:n]) == own
        mine = [i for i in order if label[i] == island]
        assert list(stack.particles[q:r]) == mine
        assert [stack.place[i] for i in mine] == list(range(len(mine)))
        springs += len(own) + np.isin(contacts.particle, mine).sum()
        assert u == springs
        assert n - m == len(own)
