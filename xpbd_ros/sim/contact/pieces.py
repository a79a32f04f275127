"""
How the candidates of a collider are divided among threads.

They are in chunks of CHUNK. A thread of a CPU takes whole chunks, a vector at a time. One of a GPU
takes every LANES-th candidate of a chunk. So no two threads add to one partial sum of the impulses
(``contact.wrenches``). Where few candidates take long, those of pads and in corners, each thread
takes every n-th one, so that none has all of them.
"""

from numba import types

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd_wide import load_wide, store_wide, WIDTH
from xpbd_ros.sim.backend.threads import is_on_device

CHUNK, LANES = 64, 8


def rounds(team, begin, end):
    """Return how many vectors of the candidates begin, …, end - 1 this thread takes."""


def candidate(team, n, begin):
    """Return the first candidate of this thread's n-th vector; it may lie behind the end."""


@inline(rounds)
def _rounds(team, begin, end):
    if isinstance(team, types.NoneType):
        return lambda team, begin, end: (end - begin + WIDTH - 1) // WIDTH
    if not is_on_device(team):
        def of_chunks(team, begin, end):
            chunks = (end - begin + CHUNK - 1) // CHUNK
            return (chunks - team.worker + team.workers - 1) // team.workers * (CHUNK // WIDTH)
        return of_chunks

    def of_sums(team, begin, end):
        sums = LANES * ((end - begin + CHUNK - 1) // CHUNK)
        return (sums - team.worker + team.workers - 1) // team.workers * (CHUNK // LANES)
    return of_sums


@inline(candidate)
def _candidate(team, n, begin):
    if isinstance(team, types.NoneType):
        return lambda team, n, begin: begin + n * WIDTH
    if not is_on_device(team):
        def of_chunk(team, n, begin):
            each = CHUNK // WIDTH
            return begin + (team.worker + n // each * team.workers) * CHUNK + n % each * WIDTH
        return of_chunk

    def of_sum(team, n, begin):
        each = CHUNK // LANES
        own = team.worker + n // each * team.workers
        return begin + own // LANES * CHUNK + own % LANES + n % each * LANES
    return of_sum


@jit(inline=True)
def add_lanes(sums, i, rx, ry, rz, fx, fy, fz):
    """Add forces f at r, by lanes, to sums of f and r × f, LANES apart from a flat index on."""
    _add(sums, i, fx)
    _add(sums, i + LANES, fy)
    _add(sums, i + 2 * LANES, fz)
    _add(sums, i + 3 * LANES, ry * fz - rz * fy)
    _add(sums, i + 4 * LANES, rz * fx - rx * fz)
    _add(sums, i + 5 * LANES, rx * fy - ry * fx)


@jit(inline=True)
def _add(sums, i, part):
    store_wide(sums, i, load_wide(sums, i) + part)


@jit(inline=True)
def over_lanes(q):
    """Return the sum of LANES numbers."""
    return ((q[0] + q[4]) + (q[2] + q[6])) + ((q[1] + q[5]) + (q[3] + q[7]))
