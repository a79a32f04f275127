"""Order of the neighbour list: threads that share it make the same as one that moves pairs."""

from typing import NamedTuple

import numpy as np
import pytest

from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import ThreadPool
from xpbd_ros.sim.self_collision import list_order
from xpbd_ros.sim.self_collision.list_order import Moves, new_moves

ROOM, PARTICLES, THREADS = 30 * PACK, 40, 3


class Stub(NamedTuple):
    """What a neighbour list has of its order, and a state of its team."""

    corners: np.ndarray
    keep: np.ndarray
    hits: np.ndarray
    renewed: np.ndarray
    kind_begin: np.ndarray
    kind_front: np.ndarray
    kind_end: np.ndarray
    plan: np.ndarray
    unpruned: np.ndarray
    parts: np.ndarray
    moves: Moves


class State(NamedTuple):
    """A state that knows of nothing but its team."""

    team: tuple | None = None


def listed(random, begin: int, front: int, end: int, new: int, share: float) -> Stub:
    """Return a list whose pairs differ, those hit and the particles renewed drawn at random."""
    corners = random.integers(0, PARTICLES, (4, ROOM)).astype(np.int32)
    hits = np.zeros(ROOM // PACK, np.int32)
    for k in np.flatnonzero(random.random(end - begin) < share) + begin:
        hits[k // PACK] |= 1 << k % PACK
    return Stub(corners, np.arange(ROOM, dtype=np.float32), hits,
                random.random(PARTICLES + 1) < 0.3 * share, *(
                    np.array([each] * 3) for each in (begin, front, end, new)),
                np.zeros(1, np.int64), np.zeros(THREADS, np.int64), new_moves(ROOM))


@pytest.mark.parametrize('alone, together', [
    (list_order.one_by_one, list_order.together),
    (list_order.new_one_by_one, list_order.new_together),
    (list_order.drop_one_by_one, list_order.drop_together)])
def test_threads_make_the_order_that_one_makes(alone, together):
    random, moved, pool = np.random.default_rng(4), 0, ThreadPool(THREADS)
    for share in (0.0, 0.05, 0.5, 0.95, 1.0):
        for _ in range(20):
            begin = PACK * random.integers(0, 8)
            end = random.integers(begin, ROOM)
            front = random.integers(begin, end + 1)
            near = listed(random, begin, front, end, random.integers(front, end + 1), share)
            one, all_ = (Stub(*(each.copy() for each in near[:-1]), near.moves) for _ in range(2))
            alone(one, 0)

            def step(effects, state, all_=all_):
                together(state.team, all_, 0)
            pool._rest = 0    # where threads have no cores, the main one would go on alone
            pool.run(step, (), State())
            last = one.plan[0] if alone is list_order.drop_one_by_one else ROOM
            for ours, theirs in zip(one, all_):
                if ours is not one.hits and ours is not one.parts and ours is not one.moves:
                    np.testing.assert_array_equal(ours[..., :last], theirs[..., :last])
            moved += (one.keep != near.keep).sum()
    assert moved > 1000
