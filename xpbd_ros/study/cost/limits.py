"""What this machine can do at most on one core: memory bandwidth and arithmetic."""

from time import perf_counter

from numba import njit
import numpy as np

from xpbd_ros.sim.backend.jit import FLAGS
from xpbd_ros.sim.backend.simd import fma, lane_count, lanes, load, splat, store

LARGE, SMALL = 4_000_000, 4_000
"""numbers in each array of the triad: far more than a cache holds, and what L2 holds"""
CHAINS = 10
"""independent sums of the fma loop: two units times the steps that one takes, and a few more"""


def limits() -> dict[str, float]:
    """Return the rates of a triad, from memory and cache, and of an fma loop."""
    return {'memory_gb_s': _triad_rate(LARGE), 'cache_gb_s': _triad_rate(SMALL),
            'fma_gflop_s': _fma_rate()}


@njit(**FLAGS)
def _triad(a, b, c, s, rounds):
    for _ in range(rounds):
        for i in range(len(a)):
            a[i] = b[i] + s * c[i]
        s += 1e-9


@njit(**FLAGS)
def _fma(out, count):
    one, small = splat(out, 1.0 - 1e-9), splat(out, 1e-9)
    n = lanes(out)    # different starts, or the compiler sees that all sums are the same
    a, b, c, d = load(out, 0), load(out, n), load(out, 2 * n), load(out, 3 * n)
    e, f, g, h = load(out, 4 * n), load(out, 5 * n), load(out, 6 * n), load(out, 7 * n)
    p, q = load(out, 8 * n), load(out, 9 * n)
    for _ in range(count):
        a, b, c = fma(a, one, small), fma(b, one, small), fma(c, one, small)
        d, e, f = fma(d, one, small), fma(e, one, small), fma(f, one, small)
        g, h = fma(g, one, small), fma(h, one, small)
        p, q = fma(p, one, small), fma(q, one, small)
    store(out, 0, a + b + c + d + e + f + g + h + p + q)


def _best(run, seconds: float = 0.02, rounds: int = 5) -> float:
    """Return the least time of one piece of work [s]; ``run(count)`` does so many."""
    run(1)
    start = perf_counter()
    run(1)
    count = max(1, int(seconds / max(perf_counter() - start, 1e-7)))
    found = []
    for _ in range(rounds):
        start = perf_counter()
        run(count)
        found.append((perf_counter() - start) / count)
    return min(found)


def _triad_rate(size: int) -> float:
    a, b, c = np.ones((3, size))
    return 24e-9 * size / _best(lambda rounds: _triad(a, b, c, 0.5, rounds))


def _fma_rate() -> float:
    out = np.arange(1.0, 1.0 + CHAINS * lane_count(np.dtype(float)))
    pieces = 10_000
    time = _best(lambda count: _fma(out, count * pieces))
    return 2e-9 * CHAINS * lane_count(np.dtype(float)) * pieces / time
