"""
Frames on a card (``solver.device: cuda``): the place of ``ThreadPool`` in a simulation.

The state stays on the card. A frame is one CUDA graph of small kernels (``stepping.launches``).
Before it, what effects write in ``begin`` is uploaded; after a command that does not just set a
target, whatever the host changed. After it x, v, inv_mass and what effects read in ``end`` are
downloaded. Other arrays on the host are stale until ``fetch``.
"""

from collections.abc import Callable, Iterator
import os
from typing import Any

import numpy as np

from xpbd_ros.sim.backend.device_kernel import compile_kernels, flat, packed
from xpbd_ros.sim.backend.device_memory import DeviceMemory
from xpbd_ros.sim.backend.threads import ThreadPool
from xpbd_ros.sim.stepping.launches import Launch, launches_of

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
        self._made: tuple | None = None    # what the frame below was made for
        self._memory: DeviceMemory | None = None
        self._mirrored: list[np.ndarray] = []    # in step after every frame
        self._others: list[np.ndarray] = []
        self._changed = False    # the host has changed arrays
        self._fetched = False    # all arrays are in step

    def __deepcopy__(self, memo: dict) -> 'DeviceCrew':
        """Return a crew for the copy of the simulation, with memory of its own."""
        return DeviceCrew(memo[id(self._simulation)], self._card)

    def run(self, step, effects, state, method, frame_dt: float, substeps: int) -> None:
        """Advance by a frame; with no substeps only compile it."""
        count = substeps or self._simulation.solver.substeps
        self._make(effects, state, method, frame_dt, count)
        if not substeps:
            return
        assert self._memory is not None
        if self._changed:
            self._bring_changes()
        for built in self._simulation.effects.values():
            self._memory.put(built.written_by_begin())
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

    def _make(self, effects, state, method, frame_dt, substeps) -> None:
        """Compile and load a frame, unless it is the last one."""
        wanted = (tuple(map(id, arrays_in((effects, state)))), method, frame_dt, substeps)
        if wanted == self._made:
            return
        self.fetch()
        if self._memory is not None:
            self._memory.free()
        launches, gate = launches_of(effects, state, method, frame_dt, substeps)
        every = {id(array): array for array in arrays_in((effects, state, gate))}
        self._memory = DeviceMemory(self._card, every.values())
        self._mirrored = [state.x, state.v, state.inv_mass, *fresh_of(state.history)]
        for array in self._mirrored:
            del every[id(array)]
        self._others = list(every.values())
        self._memory.remember(self._others)
        self._memory.lock(self._mirrored)
        self.frame = self._card.sequence(self._loaded(launches))
        self._made = wanted

    def _loaded(self, launches: list[Launch]) -> list[tuple]:
        """Return (kernel, parameters, threads) of each launch that does something."""
        assert self._memory is not None
        requests = [launch.request(self._card.arch) for launch in launches]
        unique = {request.key: request for request in requests}
        found = dict(zip(unique, compile_kernels(list(unique.values()))))
        loaded = {key: self._card.load(ptx) for key, ptx in found.items() if writes(ptx)}
        return [(loaded[request.key],
                 packed([leaf for value, kind in zip(launch.arguments, request.signature)
                         for leaf in flat(value, kind)], self._memory.address), launch.threads)
                for launch, request in zip(launches, requests) if request.key in loaded]


def fresh_of(history: Any) -> list[np.ndarray]:
    """Return the lengths of the particles' histories, which a pin that slips resets in ``end``."""
    return [] if history is None else [history.fresh]


def writes(ptx: str) -> bool:
    """Return True if a kernel writes to memory that others see."""
    return '\tst.' in ptx.replace('\tst.local', '').replace('\tst.param', '') or 'atom.' in ptx
