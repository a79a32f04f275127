"""The tasks of a study, each of which runs the scene once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.model import Scene
from xpbd_ros.study.accuracy.baselines import Baseline
from xpbd_ros.study.accuracy.errors import Errors, errors
from xpbd_ros.study.accuracy.solver_setting import default_solver, Setting, with_solver
from xpbd_ros.study.accuracy.trajectory import play, Trajectory
from xpbd_ros.study.accuracy.truth import push, size_of, Truth
from xpbd_ros.study.edges import edges_of
from xpbd_ros.study.reference import limit, problem_of, Reference

TRUTH = 'truth.npz'
"""file of the true solution, in the folder of the study"""
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
        found = errors(track, truth, edges_of(simulation), simulation.frame_dt)
        return replace(found, residual_m=None) if setting.is_baseline else found

    def reference(self, frame: int) -> Reference:
        """Return the solution of the reference solver at the end of a frame."""
        simulation = compile_scene(self.scene)
        problem = problem_of(simulation)
        count = len(simulation.slot)    # further ones are targets of compliant pins
        found = limit(problem, frame * simulation.frame_dt, CERTAIN * size_of(problem.x[:count]),
                      levels=LEVELS, cache=self.folder / 'reference')
        return replace(found, x=found.x[:count], v=found.v[:count])


def run_method(job: Job, name: str, arguments: tuple = (), options: dict | None = None) -> Any:
    """Run one task: a method of the job, by its name, with its arguments and options."""
    return getattr(job, name)(*arguments, **(options or {}))
