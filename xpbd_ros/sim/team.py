"""
Several threads on one step: all run the same code, each on its share of the particles.

What can be shared out is such that no share reads what another one writes; where the next piece of
work needs all of the last one, all ``wait`` for one another. What cannot be shared is done by one
of them ``alone``. So the bits do not depend on how many there are. A state without a team
(``state.team`` is None) belongs to one thread, and nothing of this is in its machine code.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
import numpy as np

from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.update import inline

CAME, ROUND, ENDED = 0, 8, 16
"""places in a gate, on cache lines of their own: how many have come in this round, how many
rounds there were, and whether a thread is missing for good"""
PATIENCE = 4096
"""looks at the gate before the core is offered to others"""
X86 = binding.get_process_triple().startswith('x86_64')


class Team(NamedTuple):
    """One thread's place among those that share a step."""

    worker: int
    workers: int
    gate: np.ndarray
    """where they meet, shape (24,)"""


def share(team, count):
    """Return where this thread's share of so many pieces begins and ends."""


def alone(team):
    """Tell whether this thread does what cannot be shared."""


def wait(team):
    """Go on when all are here."""


def worker(team):
    """Return this thread's number."""


def _none(team) -> bool:
    return isinstance(team, types.NoneType)


@inline(share)
def _share(team, count):
    if _none(team):
        return lambda team, count: (0, count)
    return lambda team, count: (count * team.worker // team.workers,
                                count * (team.worker + 1) // team.workers)


@inline(alone)
def _alone(team):
    return (lambda team: True) if _none(team) else lambda team: team.worker == 0


@inline(worker)
def _worker(team):
    return (lambda team: 0) if _none(team) else lambda team: team.worker


@inline(wait)
def _wait(team):
    if _none(team):
        return lambda team: None
    return lambda team: _meet(team.gate, team.workers)


def _place(context, builder, kind, gate, place):
    data = cgutils.create_struct_proxy(kind)(context, builder, value=gate).data
    return builder.gep(data, [place], inbounds=True)


@intrinsic
def _add_one(typing, gate, place):
    """Add 1 where others do so too; return what was there."""
    def generate(context, builder, signature, arguments):
        return builder.atomic_rmw('add', _place(context, builder, signature.args[0], *arguments),
                                  ir.IntType(64)(1), 'seq_cst')
    return types.int64(gate, types.intp), generate


@intrinsic
def _read(typing, gate, place):
    """Return what is there now, whoever wrote it."""
    def generate(context, builder, signature, arguments):
        return builder.load_atomic(_place(context, builder, signature.args[0], *arguments),
                                   'seq_cst', 8)
    return types.int64(gate, types.intp), generate


@intrinsic
def _write(typing, gate, place, value):
    """Write so that others see it."""
    def generate(context, builder, signature, arguments):
        gate_, place_, value_ = arguments
        builder.store_atomic(value_, _place(context, builder, signature.args[0], gate_, place_),
                             'seq_cst', 8)
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
def _meet(gate, workers):
    """Wait until so many threads are here."""
    this = _read(gate, ROUND)
    if _add_one(gate, CAME) == workers - 1:
        _write(gate, CAME, 0)
        _write(gate, ROUND, this + 1)
        return
    looks = 0
    while _read(gate, ROUND) == this:
        looks += 1
        if looks < PATIENCE:
            _breathe()
        elif _read(gate, ENDED):
            return
        else:
            _offer()


class Crew:
    """The threads of one simulation."""

    def __init__(self, workers: int):
        self.workers = workers
        self._gate = np.zeros(24, np.int64)
        self._pool = ThreadPoolExecutor(workers - 1, 'xpbd_ros') if workers > 1 else None
        self._others: list[Future] = []

    def run(self, step, effects, state, *arguments) -> None:
        """Call a step on all threads, this one among them."""
        if self._pool is None:
            step(effects, state, *arguments)
            return
        for other in self._others:    # where a frame was broken off
            other.exception()
        self._gate[:] = 0
        try:
            self._others = []
            for k in range(1, self.workers):
                self._others.append(self._pool.submit(
                    step, effects, state._replace(team=Team(k, self.workers, self._gate)),
                    *arguments))
            step(effects, state._replace(team=Team(0, self.workers, self._gate)), *arguments)
        except BaseException:    # such as Ctrl-C, before this thread came to the others
            self._gate[ENDED] = 1
            raise
        for other in self._others:
            other.result()
