"""
Frames on a card (``solver.device: cuda``): the place of ``ThreadPool`` in a simulation.

The state stays on the card. A frame is one CUDA graph of small kernels (``stepping.launches``), or
several where effects take turns, whose number the state decides. Before it, what effects write in
``begin`` is uploaded; after a command that does not just set a target, whatever the host changed.
After it x, v, inv_mass and what effects read in ``end`` are downloaded. Other arrays on the host
are stale until ``fetch``.
"""

from collections.abc import Callable, Iterator, Sequence
import os
from typing import Any

import numpy as np

from xpbd_ros.sim.backend.device_kernel import compile_kernels
from xpbd_ros.sim.backend.device_memory import DeviceMemory
from xpbd_ros.sim.backend.packed_arguments import layout, words
from xpbd_ros.sim.backend.threads import ThreadPool
from xpbd_ros.sim.stepping.launches import (
    flattened,
    Launch,
    launches_of,
    Repeat,
    Shared,
)

HOST_THREADS = 4
"""that bring a frame into natural order"""


def arrays_in(value: Any) -> Iterator[np.ndarray]:
    """Yield the arrays of nested tuples."""
    if isinstance(value, np.ndarray):
        if value.nbytes:
            yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from arrays_in(item)


class DeviceCrew:
    """
    Runs the frames of a simulation on a card.

    Parameters
    ----------
    simulation : whose frames they are
    card : ``cuda.Card``, or one that is emulated

    """

    workers, alone = 1, 0

    def __init__(self, simulation, card):
        self._simulation, self._card = simulation, card
        self._host = ThreadPool(min(HOST_THREADS, os.cpu_count() or 1))
        self._memory: DeviceMemory | None = None
        self._known: tuple = ()    # arrays that the memory has
        self._frames: dict[type, tuple[tuple, Callable]] = {}    # by method: what for, and how
        self._kernels: dict[str, Any] = {}    # loaded, by the key of their request
        self._shared = Shared(np.zeros(1, np.int64), np.zeros(2, np.int64))
        self._mirrored: list[np.ndarray] = []    # in step after every frame
        self._others: list[np.ndarray] = []
        self._changed = False    # the host has changed arrays
        self._fetched = False    # all arrays are in step

    def __deepcopy__(self, memo: dict) -> 'DeviceCrew':
        """Return a crew for the copy of the simulation, with memory of its own."""
        return DeviceCrew(memo[id(self._simulation)], self._card)

    def compile(self, step, effects, state, method, frame_dt: float, substeps: int) -> None:
        """Compile a frame, and load it onto the card."""
        self._renew_memory(effects)
        wanted = method, frame_dt, substeps
        if self._frames.get(type(method), (None,))[0] != wanted:
            launches = launches_of(effects, state, method, frame_dt, substeps, self._shared)
            self._load(list(flattened(launches)))
            self._frames[type(method)] = wanted, self._sequence(launches)

    def run(self, step, effects, state, method, *arguments) -> None:
        """Advance by a frame."""
        self.compile(step, effects, state, method, *arguments)
        assert self._memory is not None
        if self._changed:
            self._bring_changes()
        else:
            self._bring_begun()
        _, self.frame = self._frames[type(method)]
        self.frame()
        self._memory.get(self._mirrored)
        for built in self._simulation.effects.values():
            self._memory.get(built.read_by_frame())
        self._changed = self._fetched = False

    def by_parts(self, work: Callable[[int, int], None], count: int) -> None:
        """Call work(begin, end) for parts of many pieces on the host (``ThreadPool.by_parts``)."""
        self._host.by_parts(work, count)

    def host_changed(self) -> None:
        """Look for changes in all arrays before the next frame."""
        self._changed = True

    def fetch(self) -> None:
        """Bring all arrays to the host, which may change them then."""
        if self._memory is not None and not self._fetched:
            self._bring_changes()
            self._memory.get(self._others)
            self._memory.remember(self._others)
        self._changed = self._fetched = True

    def fetch_stats(self) -> None:
        """Bring what the effects' ``stats`` read to the host."""
        if self._memory is not None and not self._changed:
            for built in self._simulation.effects.values():
                self._memory.get(built.read_by_stats())

    def _bring_changes(self) -> None:
        """Bring what the host has changed to the card."""
        assert self._memory is not None
        self._memory.put(self._mirrored)
        self._memory.upload(self._others)
        self._bring_begun()

    def _bring_begun(self) -> None:
        """Bring what the effects have written in ``begin`` to the card."""
        assert self._memory is not None
        for built in self._simulation.effects.values():
            self._memory.put(built.written_by_begin())

    def _renew_memory(self, effects) -> None:
        """Allocate memory for all arrays, unless it has them."""
        state = self._simulation.state
        arrays = {id(array): array for array in arrays_in((effects, state, self._shared))}
        if tuple(arrays) == self._known:
            return
        self.fetch()
        if self._memory is not None:
            self._memory.free()
        self._memory, self._known, self._frames = (
            DeviceMemory(self._card, arrays.values()), tuple(arrays), {})
        self._mirrored = [state.x, state.v, state.inv_mass, *fresh_of(state.history)]
        for array in self._mirrored:
            del arrays[id(array)]
        self._others = list(arrays.values())
        self._memory.remember(self._others)
        self._memory.lock(self._mirrored)

    def _load(self, launches: Sequence[Launch]) -> None:
        """Compile and load the kernels that do something."""
        requests = {request.key: request for request in (
            launch.request(self._card.arch) for launch in launches)}
        new = [key for key in requests if key not in self._kernels]
        for key, ptx in zip(new, compile_kernels([requests[key] for key in new])):
            self._kernels[key] = self._card.load(ptx) if writes(ptx) else None

    def _sequence(self, launches: Sequence[Launch | Repeat]) -> Callable[[], None]:
        """Return what runs launches in order."""
        parts: list[Callable[[], None]] = []
        ready: list[tuple] = []
        for each in launches:
            if isinstance(each, Repeat):
                parts += [self._card.sequence(ready), self._repeated(each)]
                ready = []
            else:
                ready += self._ready(each)
        parts.append(self._card.sequence(ready))

        def run() -> None:
            for part in parts:
                part()
        return parts[0] if len(parts) == 1 else run

    def _ready(self, launch: Launch) -> list[tuple]:
        """Return the kernel, parameters and threads of a launch that does something, in a list."""
        assert self._memory is not None
        kernel = self._kernels[launch.request(self._card.arch).key]
        if kernel is None:
            return []
        parameters = words(launch.arguments, list(map(layout, launch.signature)),
                           self._memory.address)
        return [(kernel, np.array(parameters, np.int64), launch.threads)]

    def _repeated(self, repeat: Repeat) -> Callable[[], None]:
        """Return what takes turns as long as inequalities are unmet."""
        turn, memory = self._sequence(repeat.launches), self._memory
        assert memory is not None

        def run() -> None:
            memory.get([repeat.turns])
            while repeat.turns[1]:
                turn()
                memory.get([repeat.turns])
        return run


def fresh_of(history: Any) -> list[np.ndarray]:
    """Return the lengths of the particles' histories, which a pin that slips resets in ``end``."""
    return [] if history is None else [history.fresh]


def writes(ptx: str) -> bool:
    """Return True if a kernel writes to memory that others see."""
    return '\tst.' in ptx.replace('\tst.local', '').replace('\tst.param', '') or 'atom.' in ptx
