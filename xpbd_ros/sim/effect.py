"""What an effect is: the value that its file registers, and what it becomes in a simulation."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import Any

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Command
from xpbd_ros.sim.constraints.pinned import hold_batch
from xpbd_ros.sim.geometry.mesh import Mesh
from xpbd_ros.sim.particles.memory_layout import Block, Span
from xpbd_ros.sim.particles.records import new_records
from xpbd_ros.sim.particles.state import State


@dataclass(frozen=True, eq=False)
class Cloth:
    """One cloth of a scene and where its particles are among all of them."""

    name: str
    mesh: Mesh
    block: Block | Span
    first: int
    """number of its first particle, among those of all cloths in natural order"""
    friction: float
    """coefficient μ of its surface"""
    static_friction: float | None = None
    """while nothing slides, where that is another"""

    @property
    def particles(self) -> slice:
        """Its particles in natural order: row after row, or as in the file."""
        return slice(self.first, self.first + len(self.mesh.positions))

    @property
    def slots(self) -> np.ndarray:
        """Its particles' slots in natural order, shape (particles,)."""
        return self.block.slots.ravel()

    def at(self, place: str | tuple[int, ...], path: str) -> np.ndarray:
        """Return the slots of a place of a grid, or of particles by number; ``path`` names it."""
        if isinstance(place, str):
            if self.mesh.grid is None:
                raise InputError(f"{path}: {place} is a place on a grid, and '{self.name}' is a "
                                 'mesh; use a list of particle numbers')
            rows, columns = (-1 if c == '1' else 0 if c == '0' else slice(None)
                             for c in place.split('_')[1])
            return self.block.slots[rows, columns].ravel()
        count = len(self.slots)
        if not all(0 <= i < count for i in place):
            raise InputError(f'{path}: indices must be from 0 to {count - 1} (got {list(place)})')
        return self.slots[np.unique(np.array(place, np.int64))]


def cloth_of(cloths: Mapping[str, Cloth], name: str, path: str) -> Cloth:
    """Return a cloth by name; raise InputError, with the key ``path``, if there is none."""
    if name not in cloths:
        raise InputError(f"{path}: unknown cloth '{name}' (known: {', '.join(cloths)})")
    return cloths[name]


@dataclass(frozen=True)
class Clock:
    """The frame that is about to be computed."""

    frame: int
    """its index, from 1; the frame 0 is the start"""
    begin_ns: int
    """simulation time at its start [ns]"""
    end_ns: int
    """simulation time at its end [ns]"""
    begin_age_ns: int
    """simulation time from the scene's start, or the last reset, to the frame's start [ns]"""
    end_age_ns: int
    """likewise, to its end [ns]"""
    dt: float
    """its length [s]"""
    substeps: int


@dataclass(frozen=True)
class BuildContext:
    """What an effect may look at while it is built."""

    cloths: tuple[Cloth, ...]
    state: State
    sections: dict[str, dict[str, Any]]
    """the scene's ``pins`` and ``colliders`` by name, as the owning effect declares them"""
    built: dict[str, 'Built']
    """the effects built so far, in projection order"""
    pins: bool
    """True if pins require reaction forces"""
    compliance_scale: float = 1.0
    before: dict[str, 'Built'] = field(default_factory=dict)
    """the effects that this one takes over from, where a live key changed"""
    read_mesh: Callable[[str], tuple[np.ndarray, np.ndarray]] | None = None
    """vertices and triangles of a file"""
    read_table: Callable[[str], np.ndarray] | None = None
    """rows of numbers in a file"""
    forces: bool = True
    """True if multipliers are stored: for reaction forces, or for several passes"""
    lines: bool = False
    """True if the solver may solve whole lines: method ``line``, or ``auto``"""
    explicit: bool = False
    """True if it may be the leapfrog: method ``explicit``, or ``auto``"""
    coloured: bool = False
    """True if constraints are swept by colours (``constraints.coloured_batches``)"""
    iterations: int = 1
    """of the solver"""
    threads: int = 1
    """of the solver"""
    travel: float = 0.0
    """mean distance that the fastest pin or collider is expected to move in a frame [m]"""
    on_device: bool = False
    """True if a GPU computes the frames"""

    @cached_property
    def records(self) -> np.ndarray:
        """Particles as records, for all effects that want them; shape (slots, 4)."""
        return new_records(self.slots, self.state.x.dtype)

    @property
    def slots(self) -> int:
        """How many slots all particles take, padding included."""
        return self.state.x.shape[1]


def by_kind(parameters: dict[Cloth, Any], is_first: Callable[[Mesh], bool]) -> tuple[list, list]:
    """Return the cloths with their parameters: those with a mesh of the first kind, the others."""
    return tuple([item for item in parameters.items() if is_first(item[0].mesh) == first]
                 for first in (True, False))    # type: ignore[return-value]


def is_grid(mesh: Mesh) -> bool:
    """Return True if a mesh is a grid."""
    return mesh.grid is not None


def sides_of(cloths: Iterable[Cloth]) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of cloths: slots, shape (edges, 2), and lengths at rest [m]."""
    slots, lengths = zip(*((cloth.slots[cloth.mesh.edges], np.linalg.norm(np.subtract(
        *cloth.mesh.positions[cloth.mesh.edges.T]), axis=1)) for cloth in cloths))
    return np.concatenate(slots), np.concatenate(lengths)


def overdue(items: Mapping[str, Any], clock: Clock) -> list[str]:
    """Return the names of those whose ``expires_ns`` (None: never) is over at a frame's start."""
    return [name for name, each in items.items()
            if each.expires_ns is not None and each.expires_ns <= clock.begin_ns]


class Built:
    """
    An effect compiled for one scene.

    ``data`` is the NamedTuple that the kernels get, None where there is nothing to do; ``also``
    are more of them. ``commands`` maps a command's type to the function of the class that applies
    it, ``(self, command, clock, state)``, once ``refusal`` has nothing against it; bound methods
    would tie the arrays into a cycle, and these would wait for the garbage collector.
    """

    data: Any
    commands: Mapping[type, Callable[[Any, Any, Clock, State], None]] = {}
    incompatible_with: tuple[str, ...] = ()
    """methods and integrators that do without it"""
    also: Sequence[Any] = ()
    ns_per_particle: float = 0.0
    """time in a substep besides its constraints, for each of ``particles_worth`` [ns]"""
    particles_per_thread: float = inf
    """fewest particles with which one more thread pays in a scene that has it, where threads share
    its work, for ``threads: 0``"""
    threads_pay_on_meshes: bool = False
    """True if that also holds for meshes, whose constraints threads do not share"""
    rate: float = inf
    """largest stiffness over mass, at a particle [1/s²], of what ``line`` sweeps once in substeps
    so short that it is soft (``stepping.methods.SOFT``); inf for all else"""
    fewest_substeps: int = 1
    """substeps of a frame below which it takes no less time"""
    explicit_velocity_lags: bool = False
    """True if ``explicit`` leaves half a substep of its force out of the velocities at a frame's
    ends, so that ``auto`` must not switch methods"""
    implicit_with_explicit: bool = False
    """True if ``explicit`` moves particles by an implicit step of this effect"""
    pulls_taut: bool = False
    """True if it may pull cloth taut or keep particles in steps of backward Euler: lines then need
    more substeps to straighten (``scene.stability.TAUT``)"""
    constraints: Any = None
    """one by one, for people and NumPy: ``particles`` (slots), ``compliance``, ``residual(x)`` and
    ``energy(x)``; None where the effect has none"""

    lists: Sequence[Any] = ()
    """the constraints of each of the parts, where there are several"""
    cells: Sequence[Any] = ()
    """constraints on both diagonals of grid cells, which ``explicit_guard`` watches"""
    sides: tuple[np.ndarray, np.ndarray] | None = None
    """particles whose distance tells the strain of what stretches without edges, shape (sides, 2),
    and their distances at rest [m], for ``explicit_guard``"""
    loaded_edges: Sequence[tuple[np.ndarray, Any]] = ()
    """multipliers and ``distance.Edges`` of elastic edges, for ``measure.stiffness_given``"""
    packs: np.ndarray | None = None
    """number of the pack of paths (``constraints.mesh_paths``) in which ``line`` solves each
    constraint, for ``study.prediction``; None without paths"""
    force: np.ndarray | None = None
    """external force on each particle [N], shape (3, slots), for ``explicit_guard``"""
    pinned_changed: bool = False
    """True if this effect has changed the set of pinned particles since ``hold``"""
    restarts: bool = False
    """True if this effect has added or removed what holds or stops particles; the history of all
    is then cleared (doc/numerics.md 2.2)"""

    def __init__(self):
        self.notes: list[str] = []
        """what a user must know before anything runs"""

    @property
    def parts(self) -> tuple[Any, ...]:
        """All that the kernels get, in their order."""
        return (self.data, *self.also) if self.data is not None else ()

    @property
    def by_part(self) -> Sequence[Any]:
        """The constraints of each of the parts."""
        alone = self.data is not None and self.constraints is not None
        return self.lists or ([self.constraints] if alone else [])

    def particles_worth(self, effects: Mapping[str, 'Built'], state: State,
                        substeps: int) -> float:
        """
        Return the work in a substep in particles, for ``auto`` (``scene.cost_table``).

        Parameters
        ----------
        effects : all effects by name
        state : particles
        substeps : of a frame, which share what is done once in it

        """
        return float(np.count_nonzero(state.mass))

    def least_substeps(self, frame_dt: float) -> float:
        """Return what ``auto`` gives at least, whatever the constraints want."""
        return 1.0

    def load(self, state: State) -> tuple[float, float]:
        """
        Return bounds of a force whose work ``explicit_guard`` must account for, besides ``force``.

        Of its sum over the particles [N], and of the acceleration of one of them [m/s²].
        """
        return 0.0, 0.0

    def stored_energy(self, state: State) -> float:
        """Return the energy of what is no edge or oblong cell [J] (``explicit_guard``)."""
        return 0.0

    def work(self, dt: float) -> float:
        """
        Return a bound of the work of a moving body in the frame just done [J].

        It hides no instability, in which particles move by far more than the body.
        """
        return 0.0

    def compile(self, state: State) -> None:
        """Compile what a frame calls besides its step; nothing moves."""

    def refusal(self, commands: Sequence[Command], state: State) -> str | None:
        """Return why these commands cannot all be applied, in this order; change nothing."""
        return None

    def begin(self, clock: Clock, state: State) -> None:
        """Get ready for a frame: move targets on."""

    def again(self) -> None:
        """Forget a frame that will be done again from its start."""

    def forget(self) -> None:
        """Forget what earlier substeps left to the next ones: no particle has a history."""

    def moved(self, slots: np.ndarray) -> None:
        """Forget where the particles of a cloth, in these slots, were: they rest elsewhere now."""
        self.again()

    def end(self, clock: Clock, state: State) -> None:
        """Look at a frame that is done."""

    def expired(self, clock: Clock) -> Sequence[str]:
        """Return the names that ``begin`` will remove, which changes arrays that kernels write."""
        return ()

    def only_sets_target(self, command: Command) -> bool:
        """Return True if a command changes no array but those of ``written_by_begin``."""
        return False

    def written_by_begin(self) -> Sequence[np.ndarray]:
        """Return the arrays that ``begin`` writes in every frame, to be copied to a GPU."""
        return ()

    def read_by_frame(self) -> Sequence[np.ndarray]:
        """Return the kernels' output that ``begin``, ``end``, ``work`` and ``reported`` read."""
        return ()

    def read_by_stats(self) -> Iterable[np.ndarray]:
        """Yield the kernels' output that ``stats`` reads; each is copied before the next."""
        return ()

    def reset(self, state: State) -> None:
        """Go to the scene's start."""

    def adopt(self, old: 'Built') -> None:
        """Go on from where the same effect was before a live key changed."""

    def hold(self, inv_mass: np.ndarray) -> None:
        """Learn which particles are pinned now."""
        for part, these in zip(self.parts, self.by_part):
            hold_batch(part, these, inv_mass)

    def reported(self, frame_dt: float) -> dict[str, Mapping[str, Any]]:
        """Return what the effect reports in a ``Frame``, by field."""
        return {}

    def stats(self) -> dict[str, float]:
        """Return what a user may want to know about the last frame."""
        return {}

    def news(self) -> Sequence[str]:
        """Return what a user must be told of the last frame, once."""
        return ()


@dataclass(frozen=True)
class Effect:
    """What one effect's file registers."""

    name: str
    parameters: type
    """frozen dataclass of ``quantity`` fields"""
    build: Callable[[Any, BuildContext], Built]
    """gets the parameters (for an effect of cloths: a dict by cloth) and the world"""
    entry: type | None = None
    """the dataclass of one entry of the scene section that belongs to it, such as ``pins``"""
    needs: tuple[str, ...] = ()
    """it works only beside one of these"""
    brings: tuple[str, ...] = ()
    """the scene has these as well, as they are unless it says how"""
