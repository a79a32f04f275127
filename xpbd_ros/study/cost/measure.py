"""
Measure what each effect costs.

Two simulations of the scene run frame by frame in turn: one as it always is, one with a clock in
its step. They do the same work, to the bit, in every round; so each frame's time is the median of
the rounds, and frames add up. What the clock itself takes is measured and left out. What is left
between the sum of the rows and the whole is a row of its own.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import Any
from warnings import catch_warnings, simplefilter

from numba import NumbaWarning
import numpy as np

from xpbd_ros.effects import EFFECTS
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stepping import stages
from xpbd_ros.sim.stepping.step import advance
from xpbd_ros.study.cost.clock import lap_ns, new_clock, start

ROUNDS = 5
LENDERS = 'contact', 'friction'
"""effects whose arrays others get too; they count once, for these"""


@dataclass(frozen=True)
class Row:
    """What one effect costs, or what a part of the step that is no effect does."""

    name: str
    present: bool
    constraints: int = 0
    kernels: int = 0
    """of its own in the machine code of this scene"""
    bytes: int = 0
    """of its arrays; those shared with one of LENDERS, or an effect before it, count there"""
    traffic: int = 0
    """bytes that one pass must move at least: its arrays, and its particles there and back"""
    us_per_substep: float = 0.0
    us_spread: float = 0.0
    """half of what the rounds differ"""
    share: float = 0.0
    """of the whole step"""

    @property
    def ns_per_constraint(self) -> float | None:
        """Time of a substep by constraint; None where there are none."""
        return 1e3 * self.us_per_substep / self.constraints if self.constraints else None

    def least_ns(self, gb_s: float) -> float | None:
        """Return the time by constraint that memory alone would take, at this rate."""
        return self.traffic / gb_s / self.constraints if self.constraints else None

    def flops_in_time(self, gflop_s: float) -> float | None:
        """Return how many operations by constraint would fit into its time, at this rate."""
        taken = self.ns_per_constraint
        return None if taken is None else taken * gflop_s


@dataclass(frozen=True)
class Cost:
    """What a scene costs on this machine."""

    effects: list[Row]
    """all there are, in projection order"""
    others: list[Row]
    """integration, the Python around the native call, and what is left"""
    frame_ms: float
    frame_ms_spread: float
    particles: int
    frames: int
    substeps: int
    state_bytes: int


def cost(scene: Scene, frames: int, *, commands: dict[int, list] | None = None,
         rounds: int = ROUNDS, progress: Callable[[Iterable, str], Iterable] = lambda i, _: i
         ) -> Cost:
    """
    Run a scene on one thread and return what its effects cost.

    Parameters
    ----------
    frames : how many
    commands : inputs by frame
    rounds : how often the run is repeated
    progress : passes frames on, and shows how far it is

    """
    commands = commands or {}
    scene = replace(scene, top=replace(scene.top, solver=replace(scene.top.solver, threads=1)))
    plain: Any = compile_scene(scene)
    timed: Any = compile_scene(scene)
    count = len(timed._tuple)
    clock = new_clock(count + 1)
    kernel = jit(advance, cache_name=None)    # of its own: a cache would name the clock's type

    def clocked(effects, state, *arguments):
        start(clock)
        kernel(effects, state._replace(clock=clock), *arguments)

    _watch(plain, plain._step)
    _watch(timed, clocked)
    plain.compile()
    with catch_warnings():    # code that reads a clock is not cached
        simplefilter('ignore', NumbaWarning)
        timed.compile()
    text = ''.join(kernel.inspect_asm().values())
    reading = lap_ns()
    whole, native = np.zeros((2, rounds, frames, 1))
    parts = np.zeros((rounds, frames, count + 1))
    for step in progress(range(rounds * frames), 'frames'):
        r, f = divmod(step, frames)
        if f == 0:
            plain, timed = (_fresh(scene, simulation) for simulation in (plain, timed))
        substeps = plain.setting.substeps
        before = perf_counter_ns()
        plain.step(commands.get(f + 1, ()))
        whole[r, f] = (perf_counter_ns() - before) / substeps
        native[r, f] = plain.taken / substeps
        timed.step(commands.get(f + 1, ()))
        parts[r, f] = (clock.book[:, 0] - reading * clock.book[:, 1]) / substeps
    assert plain.hash() == timed.hash(), 'the step with a clock in it computes something else'
    return _tabulate(plain, text, whole, native, parts)


def _watch(simulation: Any, kernel: Callable) -> None:
    """Let a simulation step by this kernel, and keep in ``taken`` what it took [ns]."""
    def step(*arguments):
        start = perf_counter_ns()
        kernel(*arguments)
        simulation.taken = perf_counter_ns() - start
    simulation._step, simulation.kernel = step, kernel


def _fresh(scene: Scene, simulation: Any) -> Any:
    again = compile_scene(scene)
    _watch(again, simulation.kernel)
    return again


def _tabulate(simulation: Simulation, text: str, whole, native, parts) -> Cost:
    total, total_spread = (value[0] for value in _mean(whole))
    (inside,), (inside_spread,) = _mean(native)
    times, spreads = _mean(parts)

    def row(name, time, spread, **about):
        return Row(name, True, us_per_substep=1e-3 * time, us_spread=1e-3 * spread,
                   share=time / total, **about)

    effects = []
    seen: set[int] = set()
    bytes_ = {name: array_bytes(simulation.effects[name].parts, seen)
              for name in sorted(simulation.effects, key=lambda name: name not in LENDERS)}
    owner = [name for name, built in simulation.effects.items() for _ in built.parts]
    for name in EFFECTS:
        if name not in simulation.effects:
            absent = {kind for _, kind in stages.KERNELS
                      if kind and kind.__module__ == f'xpbd_ros.effects.{name}'}
            assert not _in_code(absent, text)
            effects.append(Row(name, False))
            continue
        built = simulation.effects[name]
        mine, listed = np.array([one == name for one in owner]), built.constraints
        kinds = set(map(type, built.parts))
        effects.append(row(name, times[:-1][mine].sum(), spreads[:-1][mine].sum(),
                           bytes=bytes_[name],
                           traffic=bytes_[name] + _particle_bytes(simulation, listed),
                           constraints=0 if listed is None else len(listed.particles),
                           kernels=_in_code(kinds, text)))
    rest = inside - times.sum()
    frame = float(np.median(whole, axis=0).mean() * simulation.solver.substeps)
    return Cost(effects, [row('integration', times[-1], spreads[-1]),
                          row('python', total - inside, abs(total_spread - inside_spread)),
                          row('rest', rest, inside_spread)],
                1e-6 * frame, 1e-6 * total_spread * simulation.solver.substeps,
                len(simulation.slot), whole.shape[1], simulation.solver.substeps,
                array_bytes(simulation.state, seen))


def _particle_bytes(simulation: Simulation, listed) -> int:
    """Return the bytes of positions, there and back, and mobilities that constraints touch."""
    touched = 0 if listed is None else len(np.unique(listed.particles))
    return touched * (2 * 3 + 1) * simulation.state.x.itemsize


def _mean(rounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return means over frames of medians over rounds, and half of what the rounds differ."""
    return np.median(rounds, axis=0).mean(0), 0.5 * np.ptp(rounds.mean(1), axis=0)


def _in_code(kinds: set[type], text: str) -> int:
    """Return how many kernels for an effect's types some machine code holds."""
    return sum(kind in kinds and _mangled(kernel.__name__) in text
               for (_, kind), kernel in stages.KERNELS.items())


def _mangled(name: str) -> str:
    """Return a function's name as machine code has it: with its length, and a B behind."""
    return f'{len(name)}{name}B'


def array_bytes(data, seen: set[int]) -> int:
    """Return the bytes of all arrays in nested tuples that were not seen before."""
    if isinstance(data, np.ndarray):
        new = data.ctypes.data not in seen
        seen.add(data.ctypes.data)
        return data.nbytes if new else 0
    return sum(array_bytes(item, seen) for item in data) if isinstance(data, tuple) else 0
