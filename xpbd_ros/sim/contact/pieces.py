"""
Pieces of a collider's candidates: what a thread works on, one candidate or vector after another.

One thread of a CPU has them all. Candidates are in chunks of CHUNK, and a thread of a GPU has
every LANES-th one of a chunk: those that add to one partial sum of their impulses
(``contact.wrenches``), where no other thread writes.
"""

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd_wide import WIDTH
from xpbd_ros.sim.backend.threads import is_on_device, turns

CHUNK, LANES = 64, 8


def pieces(team, begin, end):
    """Return this thread's first piece of the candidates begin, …, end - 1, the end, the step."""


def piece(team, n, begin, end):
    """Return the first candidate of piece n, the end, and the step to the next vector."""


@inline(pieces)
def _pieces(team, begin, end):
    if is_on_device(team):
        return lambda team, begin, end: turns(team, LANES * ((end - begin + CHUNK - 1) // CHUNK))
    return lambda team, begin, end: (0, 1, 1)


@inline(piece)
def _piece(team, n, begin, end):
    if not is_on_device(team):
        return lambda team, n, begin, end: (begin, end, WIDTH)

    def strided(team, n, begin, end):
        first = begin + n // LANES * CHUNK
        return first + n % LANES, min(end, first + CHUNK), LANES
    return strided


@jit(inline=True)
def over_lanes(q):
    """Return the sum of LANES numbers."""
    return ((q[0] + q[4]) + (q[2] + q[6])) + ((q[1] + q[5]) + (q[3] + q[7]))
