"""
Several threads on one step: all run the same code, each on its share of the particles.

What can be shared out is such that no share reads what another one writes; where the next piece of
work needs all of the last one, all ``wait`` for one another. What cannot be shared is done by one
of them ``alone``. So the bits do not depend on how many there are. A state without a team
(``state.team`` is None) belongs to one thread, and nothing of this is in its machine code. The
threads of a GPU (``DeviceTeam``) take every n-th piece, so that neighbours work side by side.

A thread whose core is busy with other programs delays the others at each barrier, for a whole time
slice of the system. Therefore the main thread goes on alone for a while after such a step.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic
import numpy as np

from xpbd_ros.sim.backend.device_team import add_atomically, DeviceTeam, meet_all, meet_block
from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import place

APART = 8
"""from one thread's number in a gate to the next: a cache line, so that only it writes there"""
SPINS_BEFORE_PAUSE, PATIENCE = 100, 4096
"""looks at the gate before the core pauses after each, and before it is offered to others"""
LATE, LATE_SHARE = 3, 100
"""
others have no core if the main thread waits beyond PATIENCE at so many barriers of a step (at the
first one others wake up), and at one of so many
"""
WORTH_PARTS = 2**16
"""pieces of work from which on it is worth dividing what takes some 10 ns for each"""
REST = 60, 3600
"""steps that the main thread then does alone before all try again: at first, at most"""
X86 = binding.get_process_triple().startswith('x86_64')


class ThreadTeam(NamedTuple):
    """One thread's place among those that share a step."""

    worker: int
    workers: int
    gate: np.ndarray
    """where they meet: how often each thread has come, at APART times its number; next to that of
    the main thread how often it waited beyond PATIENCE; at the end whether one is missing for
    good; shape (APART * (workers + 1),)"""


def share(team, count):
    """Return where this thread's share of so many pieces begins and ends."""


def turns(team, count):
    """Return this thread's first piece of so many, the end, and the step to its next one."""


def turns_of_few(team, count, most):
    """Return the same where at most so many threads of a GPU may work: each has scratch memory."""


def first_cell(team):
    """Return the index of this thread's first cell in the tables that follow, joined."""


def cells(team, rows, columns, before):
    """
    Return this thread's cells of a table in row-major order.

    Parameters
    ----------
    rows, columns : shape of the table
    before : index of this thread's first cell, which may lie behind the table

    Returns
    -------
    row, column : of the first cell
    end : first row that is not this thread's
    down, over : stride to the next cell in rows and columns; a column beyond the last one
        continues in the next row

    """


def turns_on_device(team, count):
    """Return ``turns`` on a GPU, and all pieces on a CPU, for what one of its threads does."""


def assigned(team, k):
    """
    Return whether thread k of a CPU, modulo their number, is this one.

    On a GPU it is True: all its threads share the piece of work (``turns_on_device``).
    """


def alone_on_device(team):
    """Return False for the other threads of a GPU, in what one thread of a CPU does."""


def wait_on_device(team):
    """Go on when all threads of a GPU are here, in what one thread of a CPU does."""


def count_up(team, counts, k, number):
    """Add to counts[k], int64, where other threads may add at the same time."""


def wait_within(team):
    """Go on when all threads of a CPU are here; those of a GPU need not wait."""


def alone(team):
    """Return whether this is the main thread, which does serial work."""


def wait(team):
    """Go on when all are here."""


def wait_uneven(team):
    """Go on when all are here, where shares of the work may take long and not equally long."""


def in_first_block(team):
    """
    Return whether this is the main thread, or on a GPU one of the first block.

    A block's threads meet much sooner than all: for many small pieces, one after another.
    """


def in_block(team):
    """Return this thread's number in its block, and the number of its threads; 0, 1 on a CPU."""


def wait_in_block(team):
    """Go on when all threads of this block are here."""


def worker(team):
    """Return this thread's number."""


def workers(team):
    """Return the number of threads."""


def _none(team) -> bool:
    return isinstance(team, types.NoneType)


def is_on_device(team) -> bool:
    """Return True for the type of a ``DeviceTeam``."""
    return getattr(team, 'instance_class', None) is DeviceTeam


@inline(share)
def _share(team, count):
    if _none(team):
        return lambda team, count: (0, count)
    return lambda team, count: (count * team.worker // team.workers,
                                count * (team.worker + 1) // team.workers)


@inline(turns)
def _turns(team, count):
    if is_on_device(team):
        return lambda team, count: (team.worker, count, team.workers)
    return lambda team, count: (*share(team, count), 1)


@inline(turns_of_few)
def _turns_of_few(team, count, most):
    if not is_on_device(team):
        return lambda team, count, most: (*share(team, count), 1)

    def few(team, count, most):
        step = min(team.workers, most)
        return team.worker, count if team.worker < step else 0, step
    return few


@inline(first_cell)
def _first_cell(team):
    return (lambda team: team.worker) if is_on_device(team) else lambda team: 0


@inline(cells)
def _cells(team, rows, columns, before):
    if not is_on_device(team):
        def of_rows(team, rows, columns, before):
            first, last = share(team, rows)
            return first, 0, last, 0, 1
        return of_rows

    def every_nth(team, rows, columns, before):
        wide = np.uint32(columns)    # a GPU divides 32 bits much faster than 64
        row = np.int64(np.uint32(before) // wide)
        down = np.int64(np.uint32(team.workers) // wide)
        return row, before - row * columns, rows, down, team.workers - down * columns
    return every_nth


@inline(turns_on_device)
def _turns_on_device(team, count):
    if is_on_device(team):
        return lambda team, count: turns(team, count)
    return lambda team, count: (0, count, 1)


@inline(assigned)
def _assigned(team, k):
    if _none(team) or is_on_device(team):
        return lambda team, k: True
    return lambda team, k: team.worker == k % team.workers


@inline(alone_on_device)
def _alone_on_device(team):
    return (lambda team: alone(team)) if is_on_device(team) else lambda team: True


@inline(wait_on_device)
def _wait_on_device(team):
    return (lambda team: wait(team)) if is_on_device(team) else lambda team: None


@inline(count_up)
def _count_up(team, counts, k, number):
    if not _none(team):
        return lambda team, counts, k, number: add_atomically(counts, k, number)

    def add(team, counts, k, number):
        counts[k] += number
    return add


@inline(wait_within)
def _wait_within(team):
    if is_on_device(team):
        return lambda team: None
    return lambda team: wait(team)


@inline(alone)
def _alone(team):
    return (lambda team: True) if _none(team) else lambda team: team.worker == 0


@inline(in_first_block)
def _in_first_block(team):
    if is_on_device(team):
        return lambda team: team.worker < team.block
    return lambda team: alone(team)


@inline(in_block)
def _in_block(team):
    if is_on_device(team):
        return lambda team: (team.worker % team.block, team.block)
    return lambda team: (0, 1)


@inline(wait_in_block)
def _wait_in_block(team):
    return (lambda team: meet_block(team.gate)) if is_on_device(team) else lambda team: None


@inline(worker)
def _worker(team):
    return (lambda team: 0) if _none(team) else lambda team: team.worker


@inline(workers)
def _workers(team):
    return (lambda team: 1) if _none(team) else lambda team: team.workers


@inline(wait)
def _wait(team):
    if _none(team):
        return lambda team: None
    if is_on_device(team):
        return lambda team: meet_all(team.gate)
    return lambda team: _meet(team.gate, team.worker, team.workers, 1)


@inline(wait_uneven)
def _wait_uneven(team):
    if _none(team) or is_on_device(team):
        return lambda team: wait(team)
    return lambda team: _meet(team.gate, team.worker, team.workers, 0)


@intrinsic
def _read(typing, gate, index):
    """Return what is there now, and see all that was done before it was written."""
    def generate(context, builder, signature, arguments):
        return builder.load_atomic(place(context, builder, signature.args[0], *arguments),
                                   'acquire', 8)
    return types.int64(gate, types.intp), generate


@intrinsic
def _write(typing, gate, index, value):
    """Write, after all that was done before."""
    def generate(context, builder, signature, arguments):
        gate_, index_, value_ = arguments
        builder.store_atomic(value_, place(context, builder, signature.args[0], gate_, index_),
                             'release', 8)
        return context.get_dummy_value()
    return types.void(gate, types.intp, types.int64), generate


@intrinsic
def _breathe(typing):
    """Tell the core that this is a loop that waits."""
    def generate(context, builder, signature, arguments):
        if X86:
            builder.call(builder.module.declare_intrinsic(
                'llvm.x86.sse2.pause', (), ir.FunctionType(ir.VoidType(), [])), [])
        return context.get_dummy_value()
    return types.void(), generate


_offer = types.ExternalFunction('sched_yield', types.int32())


@jit
def _meet(gate, worker, workers, late):
    """
    Say that this thread is here, and wait until each of the others has come as often.

    ``late`` is added to the number of waits beyond PATIENCE of the main thread.
    """
    times = gate[worker * APART] + 1
    _write(gate, worker * APART, times)
    for other in range(workers):
        looks = 0
        while _read(gate, other * APART) < times:
            looks += 1
            if looks == PATIENCE and worker == 0:    # the others also wait for work that is alone
                gate[1] += late
            if looks > PATIENCE:
                if _read(gate, workers * APART):
                    return
                _offer()
            elif looks > SPINS_BEFORE_PAUSE:
                _breathe()


class ThreadPool:
    """The threads of one simulation."""

    def __init__(self, workers: int):
        self.workers = workers
        self.alone = 0
        """steps so far that the main thread did alone, as others had no core"""
        self._rest, self._next_rest = 0, REST[0]    # steps to do alone: left, after a late one
        self._gate = np.zeros(APART * (workers + 1), np.int64)
        self._pool = ThreadPoolExecutor(workers - 1, 'xpbd_ros') if workers > 1 else None
        self._others: list[Future] = []

    def __deepcopy__(self, memo: dict) -> 'ThreadPool':
        """Return a pool of as many threads of its own."""
        return ThreadPool(self.workers)

    def compile(self, step, effects, state, method, frame_dt: float, substeps: int) -> None:
        """Compile a step, or load it from the cache."""
        self.run(step, effects, state, method, frame_dt, 0)

    def run(self, step, effects, state, *arguments) -> None:
        """Call a step on all threads, this one among them."""
        if self._pool is None:
            step(effects, state, *arguments)
            return
        if self._rest > 0:
            self._rest -= 1
            self.alone += 1
            step(effects, state._replace(team=ThreadTeam(0, 1, self._gate)), *arguments)
            return
        for other in self._others:    # where a frame was broken off
            other.exception()
        self._gate[:] = 0
        self._others = []
        for k in range(1, self.workers):
            self._others.append(self._pool.submit(self._join, k, step, effects, state, *arguments))
        self._join(0, step, effects, state, *arguments)
        for other in self._others:
            other.result()
        if self._gate[1] >= max(LATE, self._gate[0] // LATE_SHARE):
            self._rest, self._next_rest = self._next_rest, min(2 * self._next_rest, REST[1])
        else:
            self._next_rest = REST[0]

    def by_parts(self, work: Callable[[int, int], None], count: int) -> None:
        """Call work(begin, end) for parts of many pieces, all at once; for few only once."""
        if self._pool is None or count < WORTH_PARTS:
            work(0, count)
            return
        ends = [count * k // self.workers for k in range(self.workers + 1)]
        others = [self._pool.submit(work, *part) for part in zip(ends[1:], ends[2:])]
        work(*ends[:2])
        for other in others:
            other.result()

    def host_changed(self) -> None:
        """Do nothing: threads of the CPU work in the host's memory; cf. ``stepping.device``."""

    def fetch(self) -> None:
        """Do nothing, for the same reason."""

    def fetch_stats(self) -> None:
        """Do nothing, for the same reason."""

    def _join(self, worker: int, step, effects, state, *arguments) -> None:
        """Call a step on one thread; if that fails, the others do not wait for it."""
        try:
            step(effects, state._replace(team=ThreadTeam(worker, self.workers, self._gate)),
                 *arguments)
        except BaseException:    # such as Ctrl-C, before this thread came to the others
            self._gate[-APART] = 1
            raise
