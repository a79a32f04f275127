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
    """A state with a team and nothing else."""

    team: tuple | None = None


def listed(random, begin: int, front: int, end: int, new: int, share: float) -> Stub:
    """Return a list of distinct pairs; marked pairs and renewed particles are random."""
    corners = random.integers(0, PARTICLES, (4, ROOM)).astype(np.int32)
    hits = np.zeros(ROOM // PACK, np.int32)
    for k in np.flatnonzero(random.random(end - begin) < share) + begin:
        hits[k // PACK] |= 1 << k % PACK
    return Stub(corners, np.arange(ROOM, dtype=np.float32), hits,
                random.random(PARTICLES + 1) < 0.3 * share, *(
                    np.array([each] * 3) for each in (begin, front, end, new)),
                np.zeros(1, np.int64), np.zeros(THREADS, np.int64), new_moves(ROOM))


@pytest.mark.parametrize('serial, parallel', [
    (list_order.bring_forward_serially, list_order.bring_forward_in_parallel),
    (list_order.bring_new_forward_serially, list_order.bring_new_forward_in_parallel),
    (list_order.drop_renewed_serially, list_order.drop_renewed_in_parallel)])
def test_the_order_in_parallel_is_that_of_one_thread(serial, parallel):
    random, moved, pool = np.random.default_rng(4), 0, ThreadPool(THREADS)
    for share in (0.0, 0.05, 0.5, 0.95, 1.0):
        for _ in range(20):
            begin = PACK * random.integers(0, 8)
            end = random.integers(begin, ROOM)
            front = random.integers(begin, end + 1)
            near = listed(random, begin, front, end, random.integers(front, end + 1), share)
            one, all_ = (Stub(*(each.copy() for each in near[:-1]), near.moves) for _ in range(2))
            serial(one, 0)

            def step(effects, state, all_=all_):
                parallel(state.team, all_, 0)
            pool._rest = 0    # where threads have no cores, the main one would go on alone
            pool.run(step, (), State())
            last = one.plan[0] if serial is list_order.drop_renewed_serially else ROOM
            for ours, theirs in zip(one, all_):
                if ours is not one.hits and ours is not one.parts and ours is not one.moves:
                    np.testing.assert_array_equal(ours[..., :last], theirs[..., :last])
            moved += (one.keep != near.keep).sum()
    assert moved > 1000
