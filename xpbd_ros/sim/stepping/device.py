"""
Frames on a card (``solver.device: cuda``): the place of ``ThreadPool`` in a simulation.

The state stays on the card. A frame is one CUDA graph of small kernels (``stepping.launches``).
Before it what the host changed goes up: what effects write in ``begin``, and after commands any
change. After it x, v, inv_mass and what effects read in ``end`` come down. All else on the host is
older than the card's, until ``fetch``.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from xpbd_ros.sim.backend.device_kernel import compile_kernels, flat, packed
from xpbd_ros.sim.backend.device_memory import DeviceMemory
from xpbd_ros.sim.stepping.launches import Launch, launches_of

REPORTS = ('end', 'reported', 'stats', 'news', 'work')
"""methods with which an effect looks at a frame that is done"""


def arrays_in(value: Any) -> Iterator[np.ndarray]:
    """Yield the arrays of nested tuples."""
    if isinstance(value, np.ndarray):
        if value.nbytes:
            yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from arrays_in(item)


def has_own(built: Any, *methods: str) -> bool:
    """Return True if an effect (``sim.effect.Built``) defines one of some methods itself."""
    common = type(built).__mro__[-2]    # the class of all effects
    return any(getattr(type(built), name) is not getattr(common, name) for name in methods)


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
        self._made: tuple | None = None    # what the frame below was made for
        self._memory: DeviceMemory | None = None
        self._all: list[np.ndarray] = []
        self._up: list[np.ndarray] = []
        self._down: list[np.ndarray] = []
        self._changed = False

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
        self._memory.upload(self._all if self._changed else self._up)
        self._changed = False
        self.frame()
        self._memory.download(self._down)

    def host_changed(self) -> None:
        """Look for changes in all arrays before the next frame."""
        self._changed = True

    def fetch(self) -> None:
        """Bring all arrays to the host, which may change them then."""
        if self._memory is not None:
            self._memory.upload(self._all)    # changes that are not there yet
            self._memory.download(self._all)
        self._changed = True

    def _make(self, effects, state, method, frame_dt, substeps) -> None:
        """Compile and load a frame, unless it is the last one."""
        wanted = (tuple(map(id, arrays_in((effects, state)))), method, frame_dt, substeps)
        if wanted == self._made:
            return
        self.fetch()
        if self._memory is not None:
            self._memory.free()
        launches, gate = launches_of(effects, state, method, frame_dt, substeps)
        self._all = list({id(array): array
                          for array in arrays_in((effects, state, gate))}.values())
        self._memory = DeviceMemory(self._card, self._all)
        self._memory.remember(self._all)
        self._exchange(state)
        self.frame = self._card.sequence(self._loaded(launches))
        self._made = wanted

    def _loaded(self, launches: list[Launch]) -> list[tuple]:
        """Return (kernel, parameters, shared) of each launch that does something."""
        assert self._memory is not None
        requests = [launch.request(self._card.arch) for launch in launches]
        unique = {request.key: request for request in requests}
        found = dict(zip(unique, compile_kernels(list(unique.values()))))
        loaded = {key: self._card.load(ptx) for key, ptx in found.items() if writes(ptx)}
        return [(loaded[request.key],
                 packed([leaf for value, kind in zip(launch.arguments, request.signature)
                         for leaf in flat(value, kind)], self._memory.address), launch.shared)
                for launch, request in zip(launches, requests) if request.key in loaded]

    def _exchange(self, state) -> None:
        """Note which arrays go up before each frame, and which come down after it."""
        up, down = [], [state.x, state.v, state.inv_mass]
        if state.reaction is not None:
            up.append(state.reaction)
            down.append(state.reaction)
        for built in self._simulation.effects.values():
            for part in built.parts:
                if has_own(built, 'begin'):
                    up += arrays_in(part)
                if has_own(built, *REPORTS):
                    down += arrays_in(part)
        known = {id(array) for array in self._all}
        self._up, self._down = (list({id(array): array for array in each
                                      if id(array) in known}.values()) for each in (up, down))


def writes(ptx: str) -> bool:
    """Return True if a kernel writes to memory that others see."""
    return '\tst.' in ptx.replace('\tst.local', '').replace('\tst.param', '') or 'atom.' in ptx
