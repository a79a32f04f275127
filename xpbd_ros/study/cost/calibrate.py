"""
Measure the cost table of this machine, for ``solver.cost_table``.

Random scenes of each kind, and shipped ones with what they lack, run with ``line`` and with
``explicit``. The entries c of the table are those that minimise, over the runs and entries,

    Σ ρ(log² (predicted time / measured time)) + PRIOR Σ log² (c / (f · shipped c))

with ρ that counts outliers less (soft L1) and f the machine's own factor. Times of other methods,
and of effects whose work depends on the motion, are f times the shipped ones; single precision is
as in the shipped table. Sheets of growing size, hanging, on colliders and folded, tell from how
many particles on a second thread pays.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from pathlib import Path
from statistics import median
import tempfile
import time
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from xpbd_ros.effects import EFFECTS, load
from xpbd_ros.errors import InputError
from xpbd_ros.scene.auto import compensation
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.cost_table import CostTable, GRID, SHIPPED
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.scene.model import Scene
from xpbd_ros.scene.threads import free_cores
from xpbd_ros.study.cost.random_scenes import KINDS, random_scenes

METHODS = ('line', 'explicit')
"""methods whose entries are fitted: those of ``auto``"""
SHIPPED_SCENES = ('arch', 'balloon', 'softbox')
"""two kinds of hinges, a mesh under pressure, a body"""
RANDOM, SEED = 25, 0
"""random scenes, and their seed"""
PRIOR = 0.3
"""weight of the shipped table's proportions"""
OUTLIER = 0.2
"""log of the ratio from which on a run counts less"""
FRAMES = 60
"""frames of a run"""
SHEETS = {GRID: ('swing', 'sheet', (45, 64, 91, 128, 181)),
          'contact': ('drape', 'cover', (14, 20, 29, 41, 58, 82)),
          'self_collision': ('fold', 'napkin', (29, 41, 58, 82))}
"""by what threads share: a scene, its sheet, and the sheet's particles along each side"""
GAIN = 1.15
"""time with one thread over that with two from which on these pay"""
ROUNDS = 3
"""of which the median gain counts"""
FEW = 16
"""substeps of the sheets"""
BY_MOTION = ('self_collision', 'strain_limit')
"""effects whose work depends on the motion more than on the scene"""


@dataclass(frozen=True)
class Run:
    """A scene with a method: the work of a frame, and its time."""

    scene: str
    method: str
    substeps: int
    particles: int
    counts: dict[tuple[str, str], float]
    """how often entries count in a frame, as ``CostTable.counts``"""
    measured_ns: float
    """mean thread CPU time of a frame"""

    def predicted_ns(self, table: CostTable) -> float:
        """Return the time of a frame by a table."""
        return sum(
            count * (table.effects.get(name, shipped_ns(name))
                     if section == 'effects' else table.methods[section][name])
            for (section, name), count in self.counts.items())


def shipped_ns(effect: str) -> float:
    """Return the time of an effect for each particle, as its file has it [ns]."""
    built: Any = load(effect).build
    return built.ns_per_particle


def calibrate(progress: Callable[[Iterable, str], Iterable] = lambda items, _: items, *,
              count: int = RANDOM, frames: int = FRAMES,
              shipped: Sequence[str] = SHIPPED_SCENES) -> CostTable:
    """
    Return the cost table of this machine.

    Parameters
    ----------
    progress : passes the scenes on, and shows how far it is
    count : number of random scenes
    frames : of each run
    shipped : shipped scenes

    """
    with tempfile.TemporaryDirectory() as folder:
        scenes = [*(load_scene(name) for name in shipped), *(
            scene_from_mapping(raw, where=f'{name}.yaml', name=name) for name, raw in
            random_scenes(count, SEED, Path(folder), KINDS).items())]
        runs = [run for scene in progress(scenes, 'scenes') for method in METHODS
                if (run := measure(scene, method, frames)) is not None]
    return fitted(runs, {what: particles_per_thread(what, frames) for what in SHEETS})


def measure(scene: Scene, method: str, frames: int) -> Run | None:
    """Run a scene on one thread; None if it cannot with the method, or not within its budget."""
    solver = replace(scene.top.solver, method=method, threads=1, cost_table=None)
    if method == 'explicit':
        solver = replace(solver, substeps=None, rough_frames=None)
    try:
        simulation: Any = compile_scene(replace(scene, top=replace(scene.top, solver=solver)))
    except InputError:
        return None
    simulation.compile()
    took = []
    for _ in range(frames):
        begin = time.thread_time_ns()
        simulation.step()
        took.append(time.thread_time_ns() - begin)
    setting, state = simulation.solver, simulation.state
    h = simulation.frame_dt / setting.substeps
    often = setting.substeps * compensation(method, state, h) * (
        SHIPPED.single if setting.precision == 'float32' else 1.0)
    counts = SHIPPED.counts(method, setting.iterations, simulation.effects, state, h,
                            setting.substeps)
    return Run(scene.name, method, setting.substeps, int(np.count_nonzero(state.mass)),
               {entry: often * count for entry, count in counts.items()},
               float(np.mean(took)))


def fitted(runs: Sequence[Run],
           per_thread: Mapping[str, float] = SHIPPED.particles_per_thread) -> CostTable:
    """Return the table that fits some runs best."""
    shipped = {(method, entry): ns for method, entries in SHIPPED.methods.items()
               for entry, ns in entries.items()}
    shipped |= {('effects', name): shipped_ns(name) for name in EFFECTS}
    counted = set().union(*(run.counts for run in runs))
    fit = [entry for entry, ns in shipped.items()
           if ns > 0.0 and entry in counted and entry[1] not in BY_MOTION]
    before = np.array([shipped[entry] for entry in fit])
    counts = np.array([[run.counts.get(entry, 0.0) for entry in fit] for run in runs])
    measured_ns = np.array([run.measured_ns for run in runs])

    def residuals(logs):
        predicted = counts @ (before * np.exp(logs[0] + logs[1:]))
        return np.concatenate([np.log(predicted / measured_ns), sqrt(PRIOR) * logs[1:]])
    logs = least_squares(residuals, np.zeros(1 + len(fit)), loss='soft_l1', f_scale=OUTLIER).x
    factors = dict(zip(fit, np.exp(logs[0] + logs[1:])))
    found = {entry: round(float(ns * factors.get(entry, np.exp(logs[0]))), 3)
             for entry, ns in shipped.items() if ns > 0.0}
    return CostTable({method: {entry: found[method, entry] for entry in entries}
                      for method, entries in SHIPPED.methods.items()}, SHIPPED.single,
                     {name: ns for (section, name), ns in found.items() if section == 'effects'},
                     per_thread)


def particles_per_thread(what: str, frames: int) -> float:
    """
    Return the fewest particles with which each of two threads pays; SHIPPED's on one core.

    It is half of the smallest sheet from which on all larger ones gain; all of the largest, if
    not even that one does.
    """
    if free_cores() < 2:
        return SHIPPED.for_thread(what)
    found = 2.0 * SHEETS[what][-1][-1]**2
    for side in reversed(SHEETS[what][-1]):
        if median(gain_of_two_threads(what, side, frames) for _ in range(ROUNDS)) < GAIN:
            break
        found = side**2
    return 0.5 * found


def gain_of_two_threads(what: str, side: int, frames: int) -> float:
    """Return the median time of a frame with one thread over that with two, in turn."""
    scene, cloth, _ = SHEETS[what]
    both = [compile_scene(load_scene(scene, {
        f'cloths.{cloth}.grid.resolution': [side, side], 'solver.method': 'line',
        'solver.substeps': FEW, 'solver.threads': threads})) for threads in (1, 2)]
    times: list[list[float]] = [[], []]
    for simulation in both:
        simulation.compile()
    for _ in range(frames):
        for simulation, took in zip(both, times):
            begin = time.perf_counter()
            simulation.step()
            took.append(time.perf_counter() - begin)
    one, two = map(median, times)
    return one / two
