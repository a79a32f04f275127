"""With NUMBA_BOUNDSCHECK=1 no access outside an array goes unseen, and there is none."""

import os
from pathlib import Path
import subprocess
import sys

from numba import config
import numpy as np
import pytest

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lane_count, load, store, transpose
from xpbd_ros.sim.backend.simd_records import load_records, load_row, store_records, store_row
from xpbd_ros.sim.contact.colliders import new_colliders
from xpbd_ros.sim.contact.signed_distance import grid_distance, ground_distance

LANES = lane_count(np.float64)


@pytest.fixture
def checked(monkeypatch):
    """Return a function that compiles a kernel, and a kernel that calls it, with bounds checks."""
    monkeypatch.setattr(config, 'BOUNDSCHECK', 1)

    def compiled(access):
        part = jit(access, cache_name=None)

        def call(x, index, i):
            part(x, index, i)
        return jit(call, cache_name=None)
    return compiled


def read_one(x, index, i):
    """Read a number."""
    x[0, 0] = x[i, 0]


def read_row(x, index, i):
    """Read a number of a view."""
    x[0, 0] = x[i][0]


def write_one(x, index, i):
    """Write a number."""
    x[i, 0] = 1.0


def read_vector(x, index, i):
    """Read a vector."""
    store(x, 0, load(x, 4 * (i + 1) - LANES))


def write_vector(x, index, i):
    """Write a vector."""
    store(x, 4 * (i + 1) - LANES, 1.0)


def read_tile(x, index, i):
    """Read a tile."""
    transpose(x, 4 * (i + 2 - LANES) - LANES, 4, x, 0, 4)


def write_tile(x, index, i):
    """Write a tile."""
    transpose(x, 0, 4, x, 4 * (i + 2 - LANES) - LANES, 4)


def read_records(x, index, i):
    """Read neighbouring records."""
    store_row(x, 0, *load_row(x, i + 1 - LANES))


def write_records(x, index, i):
    """Write neighbouring records."""
    a, b, c, d = load_row(x, 0)
    store_row(x, i + 1 - LANES, a, b, c, d)


def gather(x, index, i):
    """Read records by their numbers."""
    index[0] = i
    store_row(x, 0, *load_records(x, index, 0))


def scatter(x, index, i):
    """Write records by their numbers."""
    index[LANES - 1] = i
    a, b, c, d = load_row(x, 0)
    store_records(x, index, 0, a, b, c, d)


def number(x, index, i):
    """Read numbers of records."""
    store_row(x, 0, *load_records(x, index, i + 1 - LANES))


@pytest.mark.parametrize('access', [
    read_one, read_row, write_one, read_vector, write_vector, read_tile, write_tile, read_records,
    write_records, gather, scatter, number], ids=lambda each: each.__name__)
def test_an_access_outside_an_array_is_seen(checked, access):
    """The last row is fine, the one after it is not; nor is what begins before the first."""
    rows = 4 * LANES
    x, index = np.ones((rows, 4)), np.zeros(rows, np.int32)
    kernel = checked(access)
    kernel(x, index, rows - 1)
    for outside in (rows, -1):
        index[:] = 0
        with pytest.raises(IndexError):
            kernel(x, index, outside)


def test_the_distance_at_no_place_is_no_number(monkeypatch):
    """A node with the number of what is no number would be anywhere."""
    monkeypatch.setattr(config, 'BOUNDSCHECK', 1)
    colliders = new_colliders(1, 8**3, 16)
    colliders.grids.nodes[0], colliders.grids.spacing[0] = 8, 0.1
    colliders.heights.nodes[0] = 4
    to_grid, to_ground = (jit(each.py_func, cache_name=None)
                          for each in (grid_distance, ground_distance))
    for k in range(3):
        place = [0.1, 0.1, 0.1]
        place[k] = np.nan
        assert np.isnan(to_grid(colliders.grids, 0, *place)[0])
        assert np.isnan(to_ground(colliders.heights, 0, 1.0, 1.0, *place)[0])


@pytest.mark.slow
@pytest.mark.parametrize('what', ['effects', 'stress', 'random', 'fold'])
def test_nothing_reaches_outside_an_array(what, record_property):
    """In a process of its own, where all kernels have bounds checks; it proves that they do."""
    tests = Path(__file__).parents[1]
    child = subprocess.run(
        [sys.executable, '-m', 'support.bounds_checks', what],
        capture_output=True, text=True, check=False,
        env={**os.environ, 'NUMBA_BOUNDSCHECK': '1', 'PYTHONPATH': os.pathsep.join(
            [str(tests.parent), str(tests)])})
    assert child.returncode == 0, child.stdout[-2000:] + child.stderr[-4000:]
    print(child.stdout.splitlines()[-1])
    record_property('run', child.stdout.splitlines()[-1])
