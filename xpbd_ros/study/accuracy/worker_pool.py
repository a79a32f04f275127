"""Run a scene many times in parallel processes; one task is one run."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed, ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
import multiprocessing
from pathlib import Path
import signal
from typing import Any

from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.model import Scene
from xpbd_ros.study.accuracy.baselines import Baseline
from xpbd_ros.study.accuracy.errors import Errors, errors
from xpbd_ros.study.accuracy.solver_setting import default_solver, Setting, with_solver
from xpbd_ros.study.accuracy.trajectory import Edges, play, Trajectory
from xpbd_ros.study.accuracy.truth import push, size_of, Truth
from xpbd_ros.study.reference import limit, problem_of, Reference

LEVELS = 7
"""largest number of step sizes of the reference solver"""
CERTAIN = 1e-7
"""uncertainty of positions asked of the reference solver, over the scene's size"""


@dataclass
class Job:
    """The data and the methods of the tasks."""

    scene: Scene
    frames: int
    commands: dict[int, list]
    folder: Path
    """folder of the study, for the true solution and intermediate files"""

    @cached_property
    def truth(self) -> Truth:
        """The true solution, read from the folder."""
        return Truth.load(self.folder / TRUTH)

    def simulation(self, setting: Setting) -> Any:
        """Return the scene at its start, a Simulation or a Baseline, compiled with a setting."""
        if setting.is_baseline:
            usual = with_solver(self.scene, default_solver(self.scene).block())
            return Baseline(compile_scene(usual), setting)
        return compile_scene(with_solver(self.scene, setting.block()))

    def play(self, setting: Setting, kept: Sequence[int] | None, *, pushed: bool = False
             ) -> Trajectory:
        """Run the scene with a setting; ``pushed``: with a perturbed start."""
        simulation = self.simulation(setting)
        if pushed:
            push(simulation)
        return play(simulation, self.frames, commands=self.commands, kept=kept)

    def errors(self, setting: Setting) -> Errors:
        """Run the scene with a setting, and compare it with the true solution."""
        truth = self.truth
        try:
            simulation = self.simulation(setting)
        except InputError as error:
            return Errors(note=str(error).removeprefix(f'{self.scene.where}: '))
        track = play(simulation, self.frames, commands=self.commands,
                     kept=[int(frame) for frame in truth.frames])
        found = errors(track, truth, Edges(simulation), simulation.frame_dt)
        return replace(found, residual_m=None) if setting.is_baseline else found

    def reference(self, frame: int) -> Reference:
        """Return the solution of the reference solver at the end of a frame."""
        simulation = compile_scene(self.scene)
        problem = problem_of(simulation)
        count = len(simulation.slot)    # further ones are targets of compliant pins
        found = limit(problem, frame * simulation.frame_dt, CERTAIN * size_of(problem.x[:count]),
                      levels=LEVELS, cache=self.folder / 'reference')
        return replace(found, x=found.x[:count], v=found.v[:count])


TRUTH = 'truth.npz'
_job: Job | None = None


def _begin(job: Job) -> None:
    """Initialize a worker process; the parent process handles interrupts."""
    global _job
    _job = job
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _do(name: str, arguments: tuple, options: dict) -> Any:
    return getattr(_job, name)(*arguments, **options)


def run_tasks(job: Job, tasks: Sequence[tuple[str, tuple, dict]], processes: int, what: str,
              progress: Callable[[Iterable, str], Iterable]) -> Iterator[tuple[int, Any]]:
    """
    Run tasks in parallel processes, and yield (number of the task, its result) as they finish.

    A task is the name of a method of ``Job``, its arguments and its options. If the caller stops
    early, the processes are terminated.
    """
    if processes == 1:
        for k in progress(range(len(tasks)), what):
            name, arguments, options = tasks[k]
            yield k, getattr(job, name)(*arguments, **options)
        return
    context = multiprocessing.get_context('spawn')
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(min(processes, len(tasks)) or 1, context, _begin, (job,))
    try:
        numbers = {pool.submit(_do, *task): k for k, task in enumerate(tasks)}
        done = as_completed(numbers)
        for _ in progress(range(len(tasks)), what):
            future = next(done)
            yield numbers[future], future.result()
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
