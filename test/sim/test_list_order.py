"""Reordering of the neighbour list: in parallel as by one thread."""

from typing import NamedTuple

import numpy as np
import pytest

from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import ThreadPool
from xpbd_ros.sim.self_collision import list_order
from xpbd_ros.sim.self_collision.list_order import Moves, new_moves

ROOM, PARTICLES, THREADS = 30 * PACK, 40, 3


class Stub(NamedTuple):
    """The fields of a neighbour list that reordering uses."""

    corners: np.ndarray
    keep: np.ndarray
    marks: np.ndarray
    hits: np.ndarray
    renewed: np.ndarray
    kind_begin: np.ndarray
    kind_front: np.ndarray
    kind_end: np.ndarray
    plan: np.ndarray
    unpruned: np.ndarray
    movers: np.ndarray
    parts: np.ndarray
    moves: Moves


class State(NamedTuple):
    """A state with a team and nothing else."""

    team: tuple | None = None


SCRATCH = ('movers', 'parts', 'moves')


def listed(random, share: float) -> Stub:
    """Return a list of distinct pairs; its ends, marked pairs and renewed particles are random."""
    begin = PACK * random.integers(0, 8)
    end = random.integers(begin, ROOM)
    front = random.integers(begin, end + 1)
    new = random.integers(front, end + 1)
    marked = np.zeros(ROOM, bool)
    marked[begin:end] = random.random(end - begin) < share
    return Stub(random.integers(0, PARTICLES, (4, ROOM)).astype(np.int32),
                np.arange(ROOM, dtype=np.float32), bits(marked),
                bits(marked & (random.random(ROOM) < 0.5)),
                random.random(PARTICLES + 1) < 0.3 * share, *(
                    np.array([each] * 3) for each in (begin, front, end, new)),
                np.zeros(1, np.int64), np.zeros(ROOM, np.int32), np.zeros(THREADS, np.int64),
                new_moves(ROOM))


def bits(flags: np.ndarray) -> np.ndarray:
    """Return flags packed into integers, PACK bits each."""
    return (flags.reshape(-1, PACK) @ (1 << np.arange(PACK))).astype(np.int32)


def places(marks: np.ndarray) -> np.ndarray:
    """Return the indices of the set bits."""
    return np.flatnonzero(marks[:, None] >> np.arange(PACK) & 1)


def copies(near: Stub) -> Stub:
    """Return a copy of a list; both use the same scratch memory ``moves``."""
    return Stub(*(each.copy() for each in near[:-1]), near.moves)


@pytest.mark.parametrize('one_thread, threads', [
    (list_order.bring_forward, list_order.bring_forward),
    (list_order.bring_new_forward, list_order.bring_new_forward),
    (list_order.drop_renewed_serially, list_order.drop_renewed_in_parallel)])
def test_the_order_in_parallel_is_that_of_one_thread(one_thread, threads):
    random, moved, pool = np.random.default_rng(4), 0, ThreadPool(THREADS)
    for share in (0.0, 0.05, 0.5, 0.95, 1.0):
        for _ in range(20):
            near = listed(random, share)
            one, all_ = copies(near), copies(near)
            if one_thread is list_order.drop_renewed_serially:
                one_thread(one, 0)
            else:
                one_thread(None, one, 0)

            def step(effects, state, all_=all_):
                threads(state.team, all_, 0)
            pool._rest = 0    # where threads have no cores, the main one would go on alone
            pool.run(step, (), State())
            last = one.plan[0] if one_thread is list_order.drop_renewed_serially else ROOM
            for name in set(Stub._fields) - {*SCRATCH}:
                np.testing.assert_array_equal(getattr(one, name)[..., :last],
                                              getattr(all_, name)[..., :last])
            moved += (one.keep != near.keep).sum()
    assert moved > 1000


def test_marked_pairs_come_forward_with_their_hits():
    random, moved = np.random.default_rng(5), 0
    for share in (0.0, 0.05, 0.5, 0.95, 1.0):
        for _ in range(20):
            near = listed(random, share)
            marked, hit, before = places(near.marks), places(near.hits), copies(near)
            list_order.bring_forward(None, near, 0)
            begin, front = near.kind_begin[0], near.kind_front[0]
            assert sorted(near.keep[begin:front]) == [*marked]
            assert sorted(near.keep) == [*before.keep]
            np.testing.assert_array_equal(near.corners, before.corners[:, near.keep.astype(int)])
            own = places(near.hits)
            own = own[(begin <= own) & (own < near.kind_end[0])]
            assert sorted(near.keep[own]) == [*hit]
            stay = marked[marked < front]
            np.testing.assert_array_equal(near.keep[stay], stay)
            moved += len(marked) - len(stay)
    assert moved > 1000


def test_new_pairs_come_forward():
    random = np.random.default_rng(6)
    for _ in range(40):
        near = listed(random, 0.5)
        front, new, end = near.kind_front[0], near.plan[0], near.kind_end[0]
        list_order.bring_new_forward(None, near, 0)
        assert near.kind_front[0] == front + end - new
        assert near.unpruned[0] == end - new
        assert sorted(near.keep[front:front + end - new]) == [*range(new, end)]
        np.testing.assert_array_equal(near.keep[:front], np.arange(front))
