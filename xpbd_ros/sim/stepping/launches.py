"""
A frame as a list of launches, one for each stage of each effect: what a GPU runs.

The substep loop (``stepping.step``) and the methods (``stepping.methods``) run as plain Python
here. What they would call is written down, by a ``Recorder`` in the place of Numba's ``Writer``.
So there is one source of the order of stages. Small kernels need fewer registers, and compile
sooner, than one for a whole frame.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import importlib
import operator
from types import FunctionType
from typing import Any, NamedTuple

import numba
import numpy as np

from xpbd_ros.sim.backend.device_kernel import Request
from xpbd_ros.sim.backend.device_team import DeviceTeam
from xpbd_ros.sim.backend.emit import WRITTEN
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone, count_up, wait
from xpbd_ros.sim.constraints.coloured_batches import ColouredRuns
from xpbd_ros.sim.particles import explicit_updates, history, integration
from xpbd_ros.sim.particles.state import State
from xpbd_ros.sim.stepping import constraint_stages, methods, stages, step


class Launch(NamedTuple):
    """One kernel of a frame."""

    kernel: Callable
    arguments: tuple
    signature: tuple
    """types of the arguments, as Numba has them"""
    threads: int
    """number of threads that can share the work; 1: it is serial"""

    def request(self, arch: str) -> Request:
        """Return what to compile."""
        return Request(find, name_of(self.kernel), self.signature, arch)

    @property
    def name(self) -> str:
        """Name of the kernel, for people."""
        return self.kernel.__name__


class Repeat(NamedTuple):
    """Launches that are done again as long as effects take turns."""

    turns: np.ndarray
    """of ``Shared``"""
    launches: list[Launch]
    """of a turn, with those that tell whether there is another one"""


class Shared(NamedTuple):
    """Arrays of all frames."""

    gate: np.ndarray
    """state of the barrier, shape (1,)"""
    turns: np.ndarray
    """number of the turn, and of the threads that found inequalities unmet; shape (2,)"""


@jit
def ask(effects, state, turns, first):
    """Begin to count turns, or go on; note whether inequalities are unmet."""
    if alone(state.team):
        turns[0], turns[1] = 1 if first else turns[0] + 1, 0
    wait(state.team)
    if stages.are_inequalities_unmet(effects, state, turns[0]):
        count_up(state.team, turns, 1, 1)


def name_of(kernel: Callable) -> tuple:
    """Return a name by which another process finds a kernel: arguments of ``find``."""
    return stages.name_of(kernel) or (kernel.__module__, kernel.__name__)


def find(module: str, name: Any) -> Callable:
    """Return the kernel of a name: of a module, or of a stage of a type."""
    if isinstance(name, str):
        return getattr(importlib.import_module(module), name)
    return stages.named(module, name)


class Recorder:
    """Writes launches down, where Numba's ``Writer`` writes LLVM; a value is a type and itself."""

    def __init__(self, slots: int, turns: np.ndarray):
        self.launches: list[Any] = []
        self._turns = turns
        self._slots = slots
        self._alone = self._skips = False
        self._types: dict[int, tuple] = {}

    def typed(self, value):
        """Return a value with its type, as Numba has it."""
        if not isinstance(value, tuple):
            return numba.typeof(value), value
        known = self._types.get(id(value))
        if known is None:
            known = self._types[id(value)] = numba.typeof(value), value
        return known

    def call(self, function: Callable, *values):
        """Record a kernel, or all that a stub calls."""
        found = tuple(value for _, value in values)
        if function in WRITTEN:
            WRITTEN[function](self, *values)
        elif function in COMPOSITE:
            self.run(function, *found)
        elif function in VALUES:
            return self.typed(VALUES[function](*found))
        elif function is alone or function is integration.restore_buffers and at_home(*found):
            return None
        elif not (function is wait or self._skips):    # a launch begins when the last one is done
            shared = not self._alone or function in stages.ON_DEVICE
            kinds = tuple(kind for kind, _ in values)
            threads = threads_for(function, found, self._slots) if shared else 1
            self.launches.append(Launch(function, found, kinds, threads))
        return None

    def item(self, value, k):
        """Return an item of a tuple, by its place or its name."""
        return self.typed(getattr(value[1], k) if isinstance(k, str) else value[1][k])

    @contextmanager
    def only_if(self, value):
        """Record kernels for one thread if the value is that of ``alone``, else if it is true."""
        before = self._alone, self._skips
        if value is None:
            self._alone = True
        else:
            self._skips = not value[1]
        yield
        self._alone, self._skips = before

    def truth(self, value: bool):
        """Return a truth value."""
        return numba.types.boolean, value

    def integer(self, value: int):
        """Return a whole number."""
        return numba.types.intp, value

    def number(self, value: float):
        """Return a number."""
        return numba.types.float64, value

    def run(self, function: Callable, *arguments) -> None:
        """Run a kernel of the package as Python, whose calls are recorded."""
        source = function.py_func if hasattr(function, 'py_func') else function
        found = {name: self._recorded(each) for name, each in source.__globals__.items()}
        FunctionType(source.__code__, found)(*arguments)

    def _take_turns(self, effects, state, turn: int) -> bool:
        """Record a turn of a loop, where the loop asks for the first and for the second one."""
        asked = tuple(effect for effect in effects if stages.kernel_of(
            stages.are_inequalities_unmet, numba.typeof(effect)) is not None)
        self.call(ask, *map(self.typed, (asked, state, self._turns, turn == 1)))
        if turn == 1:
            self._before, self.launches = self.launches, []
        else:
            self.launches = [*self._before, Repeat(self._turns, self.launches)]
        return turn == 1

    def _recorded(self, found):
        if not callable(found) or isinstance(found, type):
            return found
        if found is stages.are_inequalities_unmet:
            return self._take_turns
        if found in ANSWERS:
            return ANSWERS[found]
        if found in stages.QUESTIONS:
            return lambda effects: stages.answer(found, self.typed(effects)[0])
        if found in WRITTEN or found in VALUES or found in COMPOSITE or hasattr(found, 'part'):
            return lambda *values: (self.call(found, *map(self.typed, values)) or (None, None))[1]
        return found


def at_home(home: State, state: State) -> bool:
    """Return True if the buffers that ``turned`` rotates are back where the frame began."""
    return all(map(operator.is_, *((each.x, each.x_prev, each.v, *(each.history or ()))
                                   for each in (home, state))))


def threads_for(kernel: Callable, arguments: tuple, slots: int) -> int:
    """Return the number of threads that can share a kernel: constraints of a colour, or slots."""
    solves_lines = (stages.name_of(kernel) or ('',))[0] in OF_LINES
    for each in arguments:
        slots = min(slots, getattr(each, 'most_threads', slots))
        if solves_lines and hasattr(each, 'lines'):
            return len(each.lines.work)
        batch = getattr(each, 'edges', each)
        if isinstance(getattr(batch, 'runs', None), ColouredRuns):
            cells = np.cumsum([0, *batch.runs.rows * batch.runs.count])
            return int(np.diff(cells[batch.runs.colour]).max(initial=1))
    return slots


def turned(state: State) -> State:
    """Return the state of the next substep, as ``integration.turned``."""
    rotate = history.rotate_history_of(numba.typeof(state.history), None, None, None)
    x, x_prev, v, past = rotate(state.history, state.x, state.x_prev, state.v)
    return state._replace(x=x, x_prev=x_prev, v=v, history=past)


def goes_both_ways(effect, substep) -> bool:
    """Return what ``methods.goes_both_ways`` tells."""
    return not (hasattr(effect, 'rate') and constraint_stages.is_soft.py_func(effect, substep))


VALUES: dict[Callable, Callable] = {integration.turned: turned,
                                    methods.goes_both_ways: goes_both_ways,
                                    **{each: each.py_func for each in (
                                        methods.direction, methods.of_lines, methods.goes_forth,
                                        methods.goes_back, explicit_updates.accumulating,
                                        explicit_updates.at_start, explicit_updates.half_of)}}
"""kernels that launch nothing, with what they return"""
OF_LINES = stages.solve_lines.__name__, stages.project_inequalities.__name__
"""stages in which a thread of a GPU solves whole lines, of effects that have them"""
COMPOSITE = (methods.kick,)
"""kernels whose calls are launches of their own"""
ANSWERS: dict[Callable, Callable] = {step.flush_denormals: lambda: 0,
                                     step.restore_mode: lambda mode: None}


def launches_of(effects: Sequence[Any], state: State, method, frame_dt: float, substeps: int,
                shared: Shared) -> list[Launch | Repeat]:
    """Return the launches of one frame; parameters as of ``advance``."""
    recorder = Recorder(len(state.inv_mass), shared.turns)
    recorder.run(step.advance, tuple(effects),
                 state._replace(team=DeviceTeam(0, 1, 1, shared.gate)), method, frame_dt, substeps)
    return recorder.launches


def flattened(launches: Sequence[Launch | Repeat]) -> Iterator[Launch]:
    """Yield all launches, those to be repeated once."""
    for each in launches:
        if isinstance(each, Repeat):
            yield from each.launches
        else:
            yield each
