"""A study: compute the true solution, the errors of all settings, then their times."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
import hashlib
import json
from pathlib import Path
import pickle
from typing import Any

from xpbd_ros import __version__
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.files import as_attachments
from xpbd_ros.scene.frames import notes_without_tf
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.backend.disk_cache import CACHE_FOLDER
from xpbd_ros.sim.stepping.methods import METHODS
from xpbd_ros.study.accuracy.baselines import refusal
from xpbd_ros.study.accuracy.choose import (
    Default,
    judge_defaults,
    mark_front,
    POSITION,
    Row,
    SHAPE,
)
from xpbd_ros.study.accuracy.errors import Errors, errors
from xpbd_ros.study.accuracy.job import Job, run_method, TRUTH
from xpbd_ros.study.accuracy.results_store import ResultsStore
from xpbd_ros.study.accuracy.solver_setting import (
    auto_settings,
    BASELINES,
    ladder,
    Refused,
    Setting,
    setting_of,
    with_solver,
)
from xpbd_ros.study.accuracy.timing import time_frames, Timing
from xpbd_ros.study.accuracy.trajectory import play
from xpbd_ros.study.accuracy.truth import (
    AGREED,
    CHAOTIC,
    growth_of,
    horizon_of,
    independent,
    make,
    own_rungs,
    PUSH,
    SETTLED,
    size_of,
    times_of,
    Truth,
)
from xpbd_ros.study.edges import edges_of
from xpbd_ros.study.machine import machine
from xpbd_ros.study.parallel import run_tasks

LOADED = 0.1
"""part of the run's largest strain that must occur while trajectories are predictable; otherwise
settings are judged by shape, as positions of a cloth in free fall say little about a setting"""
FORMAT = 2
"""version of the files in the folder"""


@dataclass
class Study:
    """The result of a study."""

    scene: Scene
    frames: int
    frame_dt: float
    truth: Truth
    rows: list[Row]
    refused: list[Refused]
    by: str
    """error that settings are judged by: POSITION or SHAPE"""
    machine: dict
    """description of the computer"""
    particles: int
    notes: list[str] = field(default_factory=list)
    """remarks for the report"""

    @property
    def floor(self) -> float:
        """Uncertainty of the true solution, in the error that settings are judged by [m]."""
        if self.by == SHAPE:
            return float(self.truth.scatter[0])
        return float(self.truth.uncertainty[-1]) if len(self.truth.uncertainty) else 0.0

    @property
    def defaults(self) -> list[Default]:
        """What ``auto`` chooses with each of BUDGETS, beside the best setting as fast."""
        return judge_defaults(self.rows, self.by, auto_settings(self.scene), self.floor)

    @property
    def what(self) -> str:
        """Name of the error that settings are judged by."""
        if self.by == SHAPE:
            return f'heights of the particles, mean from {self.settled_s:.3g} s on'
        return f'RMS position error at {self.truth.frames[-1] * self.frame_dt:.3g} s'

    @property
    def settled_s(self) -> float:
        """Start of the last part of the run, over which means are taken [s]."""
        return (self.frames - max(1, round(SETTLED * self.frames))) * self.frame_dt


def study(scene: Scene, frames: int, folder: Path, *, times: Sequence[int] = (),
          commands: dict[int, list] | None = None, methods: Collection[str] = METHODS,
          baselines: bool = False, by: str | None = None, processes: int = 1,
          scheduler: str | None = None,
          progress: Callable[[Iterable, str], Iterable] = lambda items, _: items) -> Study:
    """
    Measure errors and times of solver settings for a scene; keep the results in a folder.

    Parameters
    ----------
    scene : the scene
    frames : number of frames
    folder : new folder, or that of the same study, which then continues
    times : frames at which positions are compared; empty for those of ``times_of``
    commands : inputs by frame
    methods : methods to try
    baselines : whether to run the baselines too
    by : POSITION or SHAPE; None chooses by LOADED
    processes : number of processes for the errors
    scheduler : address of a Dask scheduler whose workers compute the errors instead
    progress : wraps lists of tasks to show progress

    Raises
    ------
    InputError : if the folder holds another study, or positions cannot be compared

    """
    commands = without_solver(commands or {})
    settings, refused = ladder(scene, methods, baselines=baselines)
    simulation = compile_scene(scene)
    here = machine()
    store = ResultsStore(folder, {
        'scene': _hash(scene), 'duration': str(frames), 'times': str(list(times)),
        'inputs': hashlib.blake2b(pickle.dumps(commands), digest_size=8).hexdigest(),
        'version': f'{__version__} {FORMAT} {CACHE_FOLDER.name}', 'machine': here['name']})
    job = Job(scene, frames, commands, folder.absolute())
    run = partial(run_tasks, processes=processes, scheduler=scheduler, progress=progress)
    if (folder / TRUTH).exists():
        truth = job.truth
    else:
        truth = find_truth(job, times, run)
        truth.save(folder / TRUTH)
    if baselines:
        settings, left = _without_baselines(settings, scene, commands)
        refused += left
    missing = _in_order([one for one in settings if one.key not in store.errors])
    for k, found in run(partial(run_method, replace(job)),
                        [('errors', (setting,)) for setting in missing], what='settings'):
        store.add_errors(missing[k].key, found)
    for setting in progress([one for one in settings if one.key not in store.timings
                             and store.errors[one.key].finite], 'timings'):
        store.add_timing(setting.key, time_frames(job.simulation(setting), frames, commands))
    itself = setting_of(simulation).key
    rows = [Row(setting, store.errors[setting.key], store.timings.get(setting.key),
                scene=setting.key == itself) for setting in settings]
    if by is None:
        by = POSITION if truth.loaded >= LOADED else SHAPE
    if by == POSITION and not len(truth.frames):
        raise InputError('--by position: trajectories cannot be compared at any of these times; '
                         'take earlier --times, or --by shape')
    mark_front(rows, by)
    return Study(scene, frames, simulation.frame_dt, truth, rows, refused, by, here,
                 len(simulation.slot), [*notes_without_tf(scene),
                                        *remarks(scene, truth, frames, simulation.frame_dt)])


def find_truth(job: Job, times: Sequence[int],
               run: Callable[..., Iterable[tuple[int, Any]]]) -> Truth:
    """
    Run the simulation's own ladder, the perturbed run and, if it can, the reference solver.

    ``run`` is ``run_tasks``, with all arguments but ``function``, ``tasks`` and ``what``.
    """
    rungs = own_rungs(job.scene)
    method = partial(run_method, replace(job))
    tracks = dict(run(method, [*(('play', (setting, None)) for setting in reversed(rungs)),
                               ('play', (rungs[0], None), {'pushed': True})],
                      what='runs towards the limit'))
    for k, setting in enumerate([*reversed(rungs), rungs[0]]):
        if tracks[k].ended is not None:
            raise InputError(f'{job.scene.where}: not finite at frame {tracks[k].ended} with '
                             f'{setting.substeps} substeps of {setting.method}; there is no '
                             'solution to compare with')
    tracks_up = [tracks[k] for k in reversed(range(len(rungs)))]
    simulation, pushed = compile_scene(job.scene), tracks[len(rungs)]
    size = size_of(simulation.frame().x)
    horizon = horizon_of(tracks_up, size)
    why_not = 'it takes no inputs' if job.commands else independent(job.scene)
    if why_not is None and growth_of(pushed, tracks_up[0]).max() <= CHAOTIC * PUSH * size:
        horizon = job.frames    # the reference solver is exact where the ladder is too coarse
    frames = list(times) or (times_of(horizon) if horizon > 0 else [])
    references = {}
    if why_not is None:
        wanted = [frame for frame in frames if frame <= horizon]
        references = {wanted[k]: found for k, found in run(
            method, [('reference', (frame,)) for frame in wanted], what='independent solutions')}
    return make(simulation, tracks_up, pushed, frames, references, horizon, why_not)


def without_solver(commands: dict[int, list]) -> dict[int, list]:
    """Return inputs without changes of the solver's keys, which the study varies itself."""
    found = {frame: [one for one in these
                     if not getattr(one, 'key', '').startswith('solver.')]
             for frame, these in commands.items()}
    return {frame: these for frame, these in found.items() if these}


def remarks(scene: Scene, truth: Truth, frames: int, dt: float) -> list[str]:
    """Return a note on when and why trajectories stop being predictable; empty if they do not."""
    if truth.horizon >= frames:
        return []
    moved = truth.growth[min(truth.horizon + 1, len(truth.growth) - 1):].max()
    text = (f'trajectories are predictable for {truth.horizon * dt:.3g} s: so long the limit of '
            f'the simulation is known to {AGREED * truth.size:.1g} m. A perturbation of '
            f'{PUSH * truth.size:.0e} m ')
    if moved > CHAOTIC * PUSH * truth.size:
        text += (f'grows to {moved:.1g} m, with any solver: later positions are chaotic and not '
                 'compared')
    else:
        text += f'grows to {moved:.1g} m only: with more substeps the time would be longer'
    return [text]


def _without_baselines(settings: list[Setting], scene: Scene, commands
                       ) -> tuple[list[Setting], list[Refused]]:
    why_not = 'take no inputs' if commands else refusal(scene)
    if why_not is None:
        return settings, []
    return ([one for one in settings if not one.is_baseline],
            [Refused(method, why_not) for method in BASELINES])


def _in_order(settings: list[Setting]) -> list[Setting]:
    """Return one setting of each kind first, so that each compiles once, then the slowest."""
    first = {setting.kind: setting for setting in reversed(settings)}
    others = [one for one in settings if one not in first.values()]
    return [*first.values(),
            *sorted(others, key=lambda one: -one.substeps * one.iterations)]


def _hash(scene: Scene) -> str:
    """Return a hash of a scene and of the files that it names."""
    digest = hashlib.blake2b(json.dumps(scene.raw, sort_keys=True, default=str).encode(),
                             digest_size=8)
    for name, content in as_attachments(scene).items():
        digest.update(f'{name} {len(content)} '.encode() + content)
    return digest.hexdigest()


def again(scene: Scene, truth: Truth, frames: int, commands: dict[int, list],
          keys: dict) -> tuple[Errors, Timing]:
    """Run a scene with the keys of a settings file; return its errors and timing."""
    scene = with_solver(scene, keys)
    commands = without_solver(commands)
    timing = time_frames(compile_scene(scene), frames, commands)
    simulation = compile_scene(scene)
    track = play(simulation, frames, commands=commands,
                 kept=[int(frame) for frame in truth.frames])
    return errors(track, truth, edges_of(simulation), simulation.frame_dt), timing

