"""A whole study: the truth, every setting's errors, then every setting's time."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
import hashlib
import json
from pathlib import Path
import pickle

from xpbd_ros import __version__
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.backend.disk_cache import CACHE_FOLDER
from xpbd_ros.study.accuracy.baselines import refusal
from xpbd_ros.study.accuracy.choose import mark_front, POSITION, Row, SHAPE
from xpbd_ros.study.accuracy.errors import Errors, errors
from xpbd_ros.study.accuracy.results_store import Book
from xpbd_ros.study.accuracy.solver_setting import (
    BASELINES,
    ladder,
    METHODS,
    Refused,
    Setting,
    setting_of,
    with_solver,
)
from xpbd_ros.study.accuracy.timing import time_frames, Timing
from xpbd_ros.study.accuracy.trajectory import Edges, play
from xpbd_ros.study.accuracy.truth import (
    AGREED,
    CALM,
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
from xpbd_ros.study.accuracy.worker_pool import Job, share_out, TRUTH
from xpbd_ros.study.machine import machine

LOADED = 0.1
"""part of the run's largest strain that must have been there while trajectories can be compared:
positions of a cloth that has only fallen say little, and its shape is judged"""
FORMAT = 2
"""of what is kept in the folder"""


@dataclass
class Study:
    """What came of it."""

    scene: Scene
    frames: int
    frame_dt: float
    truth: Truth
    rows: list[Row]
    refused: list[Refused]
    by: str
    """what settings are judged by: POSITION or SHAPE"""
    machine: dict
    particles: int
    notes: list[str] = field(default_factory=list)

    @property
    def floor(self) -> float:
        """How well the truth is known, as far as settings are judged by it [m]."""
        if self.by == SHAPE:
            return float(self.truth.scatter[0])
        return float(self.truth.uncertainty[-1]) if len(self.truth.uncertainty) else 0.0

    @property
    def what(self) -> str:
        """What the error is, in words."""
        if self.by == SHAPE:
            return f'heights of the particles, mean from {self.settled_s:.3g} s on'
        return f'RMS position error at {self.truth.frames[-1] * self.frame_dt:.3g} s'

    @property
    def settled_s(self) -> float:
        """Time from which means are taken [s]."""
        return (self.frames - max(1, round(SETTLED * self.frames))) * self.frame_dt


def study(scene: Scene, frames: int, folder: Path, *, times: Sequence[int] = (),
          commands: dict[int, list] | None = None, methods: Sequence[str] = METHODS,
          baselines: bool = False, by: str | None = None, processes: int = 1,
          progress: Callable[[Iterable, str], Iterable] = lambda items, _: items) -> Study:
    """
    Find errors and times of a scene's settings, and keep them in a folder as they come.

    Parameters
    ----------
    frames : how many
    folder : is made, or holds an earlier part of the same study
    times : frames at which positions are compared; none: as far as trajectories can be compared
    commands : inputs by frame
    methods : to try
    baselines : whether schemes that only studies know are run too
    by : POSITION or SHAPE; None: what the scene lets be compared
    processes : that errors are found in
    progress : passes items on, and shows how far it is

    """
    commands = without_solver(commands or {})
    settings, refused = ladder(scene, methods, baselines=baselines)
    simulation = compile_scene(scene)
    here = machine()
    book = Book(folder, {
        'scene': _hash(scene.raw), 'duration': str(frames), 'times': str(list(times)),
        'inputs': hashlib.blake2b(pickle.dumps(commands), digest_size=8).hexdigest(),
        'version': f'{__version__} {FORMAT} {CACHE_FOLDER.name}', 'machine': here['name']})
    job = Job(scene, frames, commands, folder)
    if (folder / TRUTH).exists():
        truth = job.truth
    else:
        truth = find_truth(job, times, processes, progress)
        truth.save(folder / TRUTH)
    if baselines:
        settings, left = _without_baselines(settings, scene, commands)
        refused += left
    missing = _in_order([one for one in settings if one.key not in book.errors])
    tasks = [('errors', (setting,), {}) for setting in missing]
    for k, found in share_out(job, tasks, processes, 'settings', progress):
        book.note_errors(missing[k].key, found)
    for setting in progress([one for one in settings if one.key not in book.timings
                             and book.errors[one.key].finite], 'timings'):
        book.note_timing(setting.key, time_frames(job.simulation(setting), frames, commands))
    itself = setting_of(simulation).key
    rows = [Row(setting, book.errors[setting.key], book.timings.get(setting.key),
                scene=setting.key == itself) for setting in settings]
    if by is None:
        by = POSITION if truth.loaded >= LOADED else SHAPE
    if by == POSITION and not len(truth.frames):
        raise InputError('--by position: trajectories cannot be compared at any of these times; '
                         'take earlier --times, or --by shape')
    mark_front(rows, by)
    return Study(scene, frames, simulation.frame_dt, truth, rows, refused, by, here,
                 len(simulation.slot), remarks(scene, truth, frames, simulation.frame_dt))


def find_truth(job: Job, times: Sequence[int], processes: int, progress) -> Truth:
    """Run our own ladder, the push and, where it can do the scene, the independent solver."""
    rungs = own_rungs(job.scene)
    tasks = [('play', (setting, None), {}) for setting in reversed(rungs)]
    tasks.append(('play', (rungs[0], None), {'pushed': True}))
    tracks = dict(share_out(job, tasks, processes, 'runs towards the limit', progress))
    for k, (_, (setting, _), _) in enumerate(tasks):
        if tracks[k].ended is not None:
            raise InputError(f'{job.scene.where}: not finite at frame {tracks[k].ended} with '
                             f'{setting.substeps} substeps of {setting.method}; there is nothing '
                             'to compare with')
    tracks_up = [tracks[k] for k in reversed(range(len(rungs)))]
    simulation, pushed = compile_scene(job.scene), tracks[len(rungs)]
    size = size_of(simulation.frame().x)
    horizon = horizon_of(tracks_up, size)
    why_not = 'it takes no inputs' if job.commands else independent(job.scene)
    if why_not is None and growth_of(pushed, tracks_up[0]).max() <= CALM * PUSH * size:
        horizon = job.frames    # the independent solver carries on where our ladder is too coarse
    frames = list(times) or (times_of(horizon) if horizon > 0 else [])
    references = {}
    if why_not is None:
        wanted = [frame for frame in frames if frame <= horizon]
        tasks = [('reference', (frame,), {}) for frame in wanted]
        references = {wanted[k]: found for k, found in share_out(
            job, tasks, processes, 'independent solutions', progress)}
    return make(simulation, tracks_up, pushed, frames, references, horizon, why_not)


def without_solver(commands: dict[int, list]) -> dict[int, list]:
    """Return inputs without those that change the solver: that is what the study varies."""
    found = {frame: [one for one in these
                     if not getattr(one, 'key', '').startswith('solver.')]
             for frame, these in commands.items()}
    return {frame: these for frame, these in found.items() if these}


def remarks(scene: Scene, truth: Truth, frames: int, dt: float) -> list[str]:
    """Say where trajectories part, and why."""
    if truth.horizon >= frames:
        return []
    moved = truth.growth[min(truth.horizon + 1, len(truth.growth) - 1):].max()
    text = (f'trajectories part after {truth.horizon * dt:.3g} s: up to there our limit is '
            f'known to {AGREED * truth.size:.1g} m, and a push of {PUSH * truth.size:.0e} m ')
    if moved > CALM * PUSH * truth.size:
        text += (f'grows to {moved:.1g} m in the end, whatever the solver; positions after it '
                 'mean nothing')
    else:
        text += f'grows to {moved:.1g} m only: more substeps than were tried would go further'
    return [text]


def _without_baselines(settings: list[Setting], scene: Scene, commands
                       ) -> tuple[list[Setting], list[Refused]]:
    why_not = 'take no inputs' if commands else refusal(scene)
    if why_not is None:
        return settings, []
    return ([one for one in settings if not one.is_baseline],
            [Refused(method, why_not) for method in BASELINES])


def _in_order(settings: list[Setting]) -> list[Setting]:
    """Put one of each kind first, so that each is compiled once; then the longest first."""
    first = {setting.kind: setting for setting in reversed(settings)}
    others = [one for one in settings if one not in first.values()]
    return [*first.values(),
            *sorted(others, key=lambda one: -one.substeps * one.iterations)]


def _hash(raw: dict) -> str:
    return hashlib.blake2b(json.dumps(raw, sort_keys=True, default=str).encode(),
                           digest_size=8).hexdigest()


def again(scene: Scene, truth: Truth, frames: int, commands: dict[int, list],
          keys: dict) -> tuple[Errors, Timing]:
    """Run a scene with a settings file's keys, as a user would, and return what comes of it."""
    scene = with_solver(scene, keys)
    commands = without_solver(commands)
    timing = time_frames(compile_scene(scene), frames, commands)
    simulation = compile_scene(scene)
    track = play(simulation, frames, commands=commands,
                 kept=[int(frame) for frame in truth.frames])
    return errors(track, truth, Edges(simulation), simulation.frame_dt), timing

