"""A compiled scene: applies commands and computes one frame at a time; no callbacks, no I/O."""

from collections.abc import Callable, Sequence
import copy
from fractions import Fraction
from typing import Any

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.threads import ThreadPool
from xpbd_ros.sim.command_check import checked
from xpbd_ros.sim.commands import Command, LoadState, Reset, SaveState, SetKey, SetState
from xpbd_ros.sim.effect import Built, Clock, Cloth
from xpbd_ros.sim.frame import Frame
from xpbd_ros.sim.live_keys import in_valid_order, Retune
from xpbd_ros.sim.particles.state import (
    forget,
    full_history,
    gather,
    places,
    State,
    take_integrator,
)
from xpbd_ros.sim.particles.state_hash import hashed
from xpbd_ros.sim.stepping import step
from xpbd_ros.sim.stepping.device import DeviceCrew
from xpbd_ros.sim.stepping.error_estimate import Start
from xpbd_ros.sim.stepping.explicit_guard import ExplicitGuard
from xpbd_ros.sim.stepping.methods import METHODS
from xpbd_ros.sim.stepping.rollback import FrameRollback
from xpbd_ros.sim.stepping.solver import Solver


class Simulation:
    """
    All cloths of one scene, with the effects that it calls for.

    ``retune`` maps a live scene key and its value to a ``Change``; ``card``: ``backend.cuda``.
    """

    def __init__(self, cloths: Sequence[Cloth], state: State, effects: dict[str, Built], *,
                 slot: np.ndarray, frame_rate: Fraction, solver: Solver,
                 retune: Retune | None = None, card: Any = None,
                 notes: Sequence[str] = ()):
        self.cloths = tuple(cloths)
        self.state = state
        self.effects = effects
        self.slot = slot
        """slot of each particle in natural order: cloth after cloth, row after row"""
        self.notes = tuple(notes)
        """notes on the compiled scene for the user"""
        self.frame_rate = frame_rate
        """frames per second of simulation time, exact"""
        self.frame_dt = float(1 / frame_rate)
        """length of a frame [s]"""
        self._frame_ns = 10**9 / frame_rate
        self.solver = solver
        self.index = 0
        self.start: Start | None = None
        """start of the last frame, if ``step`` was called with ``keep``"""
        self._kept: Start | None = None    # start of the last frame that was kept
        self._retune = retune
        self._own: dict[type, Callable[[Any], str | None]] = {
            Reset: self._reset, SetKey: self._set, SaveState: self._keep_state,
            LoadState: self._load_state, SetState: self._set_state}
        self._pending: list[Command] = []    # applied since the last frame
        self.saved: SavedState | None = None
        """state that ``SaveState`` kept, for ``LoadState``"""
        self._lag = 0    # frames by which a loaded state is older than the index
        self._first = 0    # frame of the last reset, less the lag then
        self._keys: dict[str, Any] = {}    # live keys that were set
        self._start = state.x.copy()
        self._step = step.compiled(tuple(effects))
        self._crew = ThreadPool(solver.threads) if card is None else DeviceCrew(self, card)
        self._tuple: tuple[Any, ...] = ()
        self._guard = None if solver.rough_frames is None else ExplicitGuard(self)
        self._last = FrameRollback(self)
        for built in effects.values():
            built.reset(state)
        self._collect()

    def time_ns(self, index: int) -> int:
        """Return the simulation time of a frame [ns]."""
        frame_ns = self._frame_ns
        whole, rest = divmod(index * frame_ns.numerator, frame_ns.denominator)
        twice = 2 * rest - frame_ns.denominator
        return whole + (twice > 0 or twice == 0 and whole % 2)    # as round(), 20 times faster

    def _collect(self) -> None:
        """Build the tuple of all effects' data that the kernels take."""
        if self._guard is not None:
            self._guard.collect()
        self._tuple = tuple(part for built in self.effects.values() for part in built.parts)
        self._hold()

    def _hold(self) -> None:
        """Update the effects' lists of pinned particles."""
        if self.state.reaction is None:    # a scene without pins
            return
        for built in self.effects.values():
            built.hold(self.state.inv_mass)
            built.pinned_changed = False

    def _restart(self) -> None:
        """Clear the multistep history if an effect asks for it."""
        if any(built.restarts for built in self.effects.values()):
            self.fetch()
            self._forget()

    def _forget(self) -> None:
        """Clear the multistep history of all particles."""
        forget(self.state)
        for built in self.effects.values():
            built.forget()
            built.restarts = False

    def compile(self) -> None:
        """Compile all kernels of a frame, or load them from the cache; the state is unchanged."""
        self._crew.compile(*self._arguments())
        if self._guard is not None:
            self._guard.compile()
        self._last.look()
        self.frame()
        self.hash()
        for built in self.effects.values():
            built.compile(self.state)

    def step(self, commands: Sequence[Command | tuple[Command, ...]] = (), *,
             keep: bool = False) -> Frame:
        """
        Apply commands, in order, and advance by one frame.

        The commands of a tuple are applied together, or none of them if one is refused. With
        ``keep``, ``start`` holds a copy of the state before the frame, to compute it again,
        until the next frame with ``keep``.
        """
        refused = self.apply(commands)
        applied, self._pending = tuple(self._pending), []
        clock = self._clock()
        if any(built.expired(clock) for built in self.effects.values()):
            self.fetch()
        for built in self.effects.values():
            built.begin(clock, self.state)
        self._restart()
        if any(built.pinned_changed for built in self.effects.values()):
            self._hold()
            self._crew.host_changed()
        self.start = self._keep() if keep else None
        self._last.keep()
        if self._guard is None:
            self._advance()
        else:
            self._guard.advance()
        self._last.look()
        for built in self.effects.values():
            built.end(clock, self.state)
        self._restart()
        self.index += 1
        return self.frame(applied, tuple(refused), tuple(
            text for built in self.effects.values() for text in built.news()))

    def apply(self, commands: Sequence[Command | tuple[Command, ...]]) -> list[
            tuple[Command, str]]:
        """
        Apply commands, as ``step`` does, without a frame; return those refused, with the reasons.

        The next frame has them in ``applied``, before its own.
        """
        refused: list[tuple[Command, str]] = []
        for group in commands:
            group = group if isinstance(group, tuple) else (group,)
            if not all(any(built.only_sets_target(command) for built in self.effects.values())
                       for command in group):
                self.fetch()
            try:
                group = tuple(map(checked, group))
                reason = self._apply(group)
            except InputError as error:
                reason = str(error)
            if reason is None:
                self._restart()
                self._pending += group
            else:
                refused.append((group[0], reason))
        return refused

    @property
    def pending(self) -> tuple[Command, ...]:
        """Commands that were applied since the last frame."""
        return tuple(self._pending)

    def _clock(self) -> Clock:
        """Return the next frame as the effects see it: after a load, at the time of the save."""
        index = self.index - self._lag
        age = self.age
        return Clock(index + 1, self.time_ns(index), self.time_ns(index + 1), self.time_ns(age),
                     self.time_ns(age + 1), self.frame_dt, self.setting.substeps)

    @property
    def age(self) -> int:
        """Frames from the scene's start, or the last reset; those of the save after a load."""
        return self.index - self._lag - self._first

    @property
    def setting(self) -> Solver:
        """Setting of the next frame: the solver's, or that of rough frames."""
        return self.solver if self._guard is None else self._guard.setting

    def _advance(self, setting: Solver | None = None) -> None:
        """Advance by a frame with the solver's setting or another one."""
        self._crew.run(*self._arguments(setting))

    def _arguments(self, setting: Solver | None = None) -> tuple:
        """Return the step, and what it gets."""
        setting = setting or self.solver
        return (self._step, self._tuple, self._view(setting), self._method(setting),
                self.frame_dt, setting.substeps)

    def by_parts(self, work: Callable[[int, int], None], count: int) -> None:
        """Call work(begin, end) for parts of so many pieces, on the threads that there are."""
        self._crew.by_parts(work, count)

    def fetch(self) -> None:
        """Bring all arrays to the host; those of ``solver.device: cuda`` are older there."""
        self._crew.fetch()

    def _keep(self) -> Start:
        self.fetch()
        setting = self.setting
        self._kept = Start(self._tuple, self._view(setting), self._step, self._method(setting),
                           self.frame_dt, setting.substeps).copy(self._kept)
        return self._kept

    def _view(self, setting: Solver) -> State:
        """Return the state with the storage that a setting uses."""
        if setting.method == 'explicit':
            return self.state._replace(history=None, gap=None)
        return self.state if self._guard is None else self.state._replace(apart=None)

    def _method(self, setting: Solver | None = None):
        setting = setting or self.solver
        return METHODS[setting.method](setting.iterations)

    def frame(self, applied=(), refused=(), news=()) -> Frame:
        """Return the present frame."""
        state, particles = self.state, len(self.slot)
        x, v, inv_mass = np.empty((particles, 3)), np.empty((particles, 3)), np.empty(particles)

        def bring(begin: int, end: int) -> None:
            part = slice(begin, end)
            gather(state.x, state.v, state.inv_mass, self.slot[part], x[part], v[part],
                   inv_mass[part])
        self.by_parts(bring, particles)
        reported: dict[str, Any] = {'pins': {}, 'colliders': {}}
        for built in self.effects.values():
            reported.update(built.reported(self.frame_dt))
        return Frame(self.index, self.time_ns(self.index), x, v, inv_mass, **reported,
                     applied=applied, refused=refused, news=news)

    def natural(self, array: np.ndarray) -> np.ndarray:
        """Return rows x, y, z of all particles in natural order; shape (particles, 3)."""
        return places(array, self.slot)

    def _apply(self, group: tuple[Command, ...]) -> str | None:
        """Apply commands together, or return why not."""
        if len(group) == 1 and type(group[0]) in self._own:
            return self._own[type(group[0])](group[0])
        clock = self._clock()
        owners: dict[int, tuple[Built, list[Command]]] = {}
        for command in group:
            owner = next((built for built in self.effects.values()
                          if type(command) in built.commands), None)
            if owner is None:
                why = ('goes alone, not in a tuple; no command in it is applied'
                       if type(command) in self._own else 'the scene has no effect that does this')
                return f'{type(command).__name__}: {why}'
            owners.setdefault(id(owner), (owner, []))[1].append(command)
        for owner, mine in owners.values():
            reason = owner.refusal(mine, self.state)
            if reason is not None:
                return reason if len(group) == 1 else f'{reason}; no command with it is applied'
        for owner, mine in owners.values():
            for command in mine:
                owner.commands[type(command)](owner, command, clock, self.state)
        return None

    def _reset(self, command: Reset) -> None:
        self._first += self.age
        self.state.x[:] = self._start
        self.state.x_prev[:] = self._start
        self.state.v[:] = 0.0
        self.state.inv_mass[self.slot] = 1.0 / self.state.mass[self.slot]
        forget(self.state)
        if self._guard is not None:
            self._guard.reset()
        for built in self.effects.values():
            built.reset(self.state)

    def _keep_state(self, command: SaveState) -> None:
        self.saved = None    # a state holds no other
        self.saved = self.save()

    def _load_state(self, command: LoadState) -> str | None:
        if not self.saved:
            return 'no state has been saved'
        index, saved, pending, keys = self.index, self.saved, self._pending, self._keys
        self.restore(saved)
        self._lag += index - self.index
        self.index, self.saved, self._pending = index, saved, pending
        changed = {key: value for key, value in keys.items()
                   if key not in self._keys or self._keys[key] != value}
        for key, value in in_valid_order(changed, self.check).items():
            self._set(SetKey(key, value))
        if changed:
            self._forget()
        return None

    def _set_state(self, command: SetState) -> str | None:
        cloth = next((cloth for cloth in self.cloths if cloth.name == command.cloth), None)
        if cloth is None:
            return (f"unknown cloth '{command.cloth}' "
                    f'(known: {", ".join(cloth.name for cloth in self.cloths)})')
        if len(command.positions) != 3 * len(cloth.slots):
            return (f'{len(command.positions) // 3} positions, and {cloth.name} has '
                    f'{len(cloth.slots)} particles')
        state, places = self.state, np.reshape(command.positions, (-1, 3))
        free = state.inv_mass[cloth.slots] > 0.0
        slots = cloth.slots[free]
        state.x[:, slots] = state.x_prev[:, slots] = places[free].T
        state.v[:, slots] = 0.0
        self._forget()
        for built in self.effects.values():
            built.moved(cloth.slots)
        return None

    def _set(self, command: SetKey) -> str | None:
        if self._retune is None:
            return f'{command.key}: this simulation was not made from a scene'
        try:
            change = self._retune(command.key, command.value)
        except ValueError as error:
            return str(error)
        self.effects.update(change.effects)
        if change.solver is not None and change.solver.lengths != self.solver.lengths:
            take_integrator(self.state, change.solver.with_history)
            self._forget()    # a history in steps of another length
        self.solver = change.solver or self.solver
        if change.gravity is not None:
            self.state.gravity[:] = change.gravity
        self._collect()
        self._keys.pop(command.key, None)    # in the order of the last changes
        self._keys[command.key] = command.value
        return None

    def check(self, changes: dict[str, Any]) -> None:
        """Raise InputError if live keys could not be changed like this; change nothing."""
        if self._retune is not None and changes:
            self._retune.check(changes)

    def __deepcopy__(self, memo: dict) -> 'Simulation':
        """Return a simulation of its own that continues from here; only meshes are shared."""
        self.fetch()
        other = memo[id(self)] = object.__new__(type(self))
        other._continue_from(self, memo)
        return other

    def _continue_from(self, other: 'Simulation', memo: dict) -> None:
        memo.update({id(each): each for each in other.cloths})
        memo[id(other._kept)] = None
        self.__dict__.update({name: copy.deepcopy(value, memo)
                              for name, value in other.__dict__.items()})

    def save(self) -> 'SavedState':
        """Return a copy of the whole state."""
        return SavedState(copy.deepcopy(self))

    def restore(self, saved: 'SavedState') -> None:
        """
        Continue from a saved state of this simulation, or of another one of the same scene.

        Raises
        ------
        InputError : the state is that of a scene with other cloths or effects
        TypeError : not a state from ``save``

        """
        if not isinstance(saved, SavedState):
            raise TypeError(f'{saved!r} is not a state from Simulation.save()')
        other = saved._simulation
        if [cloth.mesh.positions.shape for cloth in self.cloths] != [
                cloth.mesh.positions.shape for cloth in other.cloths] or (
                    self._step.kernel is not other._step.kernel):
            raise InputError('the state is that of another scene: it has '
                             f'{len(other.slot)} particles and the effects '
                             f'{", ".join(other.effects)}; this one has {len(self.slot)} and '
                             f'{", ".join(self.effects)}')
        self._continue_from(other, {id(other): self})

    def hash(self) -> int:
        """Return 64 bits that change with any bit of the state."""
        self.fetch()
        state = self.state
        return hashed([state.x, state.v, state.inv_mass, *full_history(state)], self.slot)

    def stats(self) -> dict[str, float]:
        """Return the effects' statistics of the last frame, by name."""
        self._crew.fetch_stats()
        found = {key: value for built in self.effects.values()
                 for key, value in built.stats().items()}
        found['frames_taken_back'] = self._last.taken_back
        if self._crew.workers > 1:
            found['frames_on_one_thread'] = self._crew.alone
        if self._guard is not None:
            found.update(self._guard.stats())
        return found


class SavedState:
    """A saved state of a simulation; read-only, and in memory only: pickled, it is empty."""

    def __init__(self, simulation: Simulation | None):
        self._found = simulation

    def __bool__(self) -> bool:
        """Return False if the state is empty."""
        return self._found is not None

    def __reduce__(self) -> tuple:
        """Return how to unpickle: as an empty state."""
        return SavedState, (None,)

    @property
    def _simulation(self) -> Simulation:
        if self._found is None:
            raise InputError('the state is empty: it was in the memory of another process')
        return self._found

    def __deepcopy__(self, memo: dict) -> 'SavedState':
        """Return the state itself, which never changes."""
        return self

    @property
    def index(self) -> int:
        """Frame of the state; 0 is the start."""
        return self._simulation.index

    def simulation(self) -> Simulation:
        """Return a new simulation that continues from here."""
        return copy.deepcopy(self._simulation)
