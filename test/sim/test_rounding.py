"""Compensated summation in float32: a position plus its rounding error is the exact sum."""

import numpy as np
import pytest

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lanes, load, splat
from xpbd_ros.sim.backend.simd_records import load_records
from xpbd_ros.sim.backend.simd_vector3 import vector3
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.rounding import (
    add_move,
    new_rounding,
    store_moved,
    store_moved_records,
    store_sum,
)

SLOTS, TIMES = 32, 200


@jit(cache_name='test')
def by_sum(x, rounding, moves, index):
    """Move particles along x by ``store_sum``."""
    for i in range(0, SLOTS, lanes(moves)):
        store_sum(x[0], rounding.move[0], i, load(x[0], i), load(moves, i))


@jit(cache_name='test')
def by_step(x, rounding, moves, index):
    """Move them by ``store_moved``, by half of twice the moves."""
    for i in range(0, SLOTS, lanes(moves)):
        store_moved(x[0], rounding.move[0], i, load(x[0], i), splat(moves, 0.5),
                    2.0 * load(moves, i))


@jit(cache_name='test')
def one_by_one(x, rounding, moves, index):
    """Move them by ``add_move``, one after another."""
    for i in range(SLOTS):
        add_move(x, rounding, 0, i, moves[i])


@jit(cache_name='test')
def by_records(records, rounding, moves, index):
    """Move records of x, y, z and mobility by ``store_moved_records``."""
    for c in range(0, SLOTS, lanes(moves)):
        x, y, z, m = load_records(records, index, c)
        store_moved_records(records, rounding.records, index, c, vector3(x, y, z),
                            splat(moves, 0.5), vector3(2.0 * load(moves, c), splat(moves, 0.0),
                                                       splat(moves, 0.0)), m)


@pytest.mark.parametrize('kernel', [by_sum, by_step, one_by_one, by_records])
def test_positions_and_errors_add_up_to_all_moves(kernel):
    """Each move is far below the last bit of x, 6e-8, and is lost in a plain sum."""
    rng = np.random.default_rng(1)
    rounding = new_rounding(SLOTS, np.float32)
    moves, records = zeros(SLOTS, np.float32), kernel is by_records
    moves[:] = rng.uniform(-1e-8, 2e-8, SLOTS)
    x = zeros((SLOTS, 4) if records else (3, SLOTS), np.float32)
    x[:] = rng.uniform(0.5, 1.0, x.shape)
    here = (slice(None), 0) if records else 0
    start = x[here].astype(float)
    for _ in range(TIMES):
        kernel(x, rounding, moves, np.arange(SLOTS, dtype=np.int32))
    errors = rounding.records if records else rounding.move
    np.testing.assert_allclose(x[here].astype(float) + errors[here],
                               start + TIMES * moves.astype(float), rtol=0.0, atol=1e-11)
    assert np.abs(x[here] - start - TIMES * moves).max() > 1e-7
