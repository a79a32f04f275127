"""One run of a sweep, and its outcome as a row of the table."""

from collections.abc import Callable
from contextlib import closing, ExitStack
from pathlib import Path
import shutil
import time
from typing import Any

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.ros.error_monitor import ErrorMonitor
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.measure import (
    elastic_energy,
    kinetic_energy,
    largest_strain,
    potential_energy,
)
from xpbd_ros.sim.simulation import Frame, Simulation

Row = dict[str, Any]
"""values by column"""
ERROR, WALL = 'error', 'wall_s'
"""columns: why a run has no outcome; wall time of its frames [s], which no two runs share"""
BODIES = ('pins', 'colliders')


def outcome(scene: Scene, frames: int, log: Path | None = None,
            new_log: Callable[..., Any] | None = None) -> Row:
    """
    Run a scene, and return its outcome.

    Parameters
    ----------
    scene : the scene with the values of this run
    frames : number of frames
    log : folder for a log of the run, whose parent exists; an earlier one is replaced
    new_log : creates the recorder of a log, from its folder, the scene and the simulation

    """
    try:
        simulation = compile_scene(scene)
    except InputError as error:
        return {ERROR: str(error)}
    except MemoryError as error:
        return {ERROR: f'not enough memory ({error}); use fewer particles'}
    simulation.compile()
    monitor = ErrorMonitor(simulation, target=scene.top.solver.error_target,
                           most=scene.top.solver.max_substeps)
    measured = Measured(scene, simulation)
    with ExitStack() as stack:
        stack.enter_context(closing(monitor))
        recorder = None
        if log is not None and new_log is not None:
            shutil.rmtree(log, ignore_errors=True)
            recorder = stack.enter_context(closing(
                new_log(log, scene, simulation, program='sweep')))
        begin, refused = time.perf_counter(), 0
        frame = simulation.frame()
        for _ in range(frames):
            start = time.perf_counter()
            frame = simulation.step(monitor.commands(), keep=monitor.due())
            monitor.look(time.perf_counter() - start)
            measured.look(frame)
            refused += len(frame.refused)
            if recorder is not None:
                recorder.frame(frame)
        wall = time.perf_counter() - begin
    told = monitor.summary()
    return {**measured.row(frame),
            'error_estimate_m': told['frame_rms_m'],
            'under_resolved': told['under_resolved'],
            'frames': frames, 'particles': len(simulation.slot),
            'substeps': simulation.solver.substeps,
            'frames_taken_back': int(simulation.stats()['frames_taken_back']),
            'state_hash': f'{simulation.hash():016x}', WALL: wall}


class Measured:
    """Peaks over a run, and the measures of its last frame."""

    def __init__(self, scene: Scene, simulation: Simulation):
        self._simulation = simulation
        self._strain = 0.0
        self._forces = {(section, name): [0.0, 0.0] for section in BODIES
                        for name in scene.sections.get(section, {})}
        """largest and last force on each pin and collider of the scene [N]"""

    def look(self, frame: Frame) -> None:
        """Take the forces and strain of a frame."""
        self._strain = max(self._strain, largest_strain(self._simulation))
        for (section, name), found in self._forces.items():
            body = getattr(frame, section).get(name)
            force = 0.0 if body is None else float(np.linalg.norm(body.force))
            found[:] = max(found[0], force), force

    def row(self, last: Frame) -> Row:
        """Return the columns of shape, forces, energy and strain."""
        x, state = last.x, self._simulation.state
        low, high = x.min(0), x.max(0)
        row: Row = {'height_mean_m': float(x[:, 2].mean())}
        for axis, least, most in zip('xyz', low, high):
            row[f'{axis}_min_m'], row[f'{axis}_max_m'] = float(least), float(most)
        row['speed_rms_m_s'] = float(np.sqrt((last.v**2).sum(1).mean()))
        row['kinetic_j'] = kinetic_energy(state)
        row['potential_j'] = potential_energy(state)
        row['elastic_j'] = float(elastic_energy(self._simulation))
        row['strain'] = largest_strain(self._simulation)
        row['strain_peak'] = self._strain
        for (section, name), (peak, force) in self._forces.items():
            row[f'{section}.{name}.force_n'] = force
            row[f'{section}.{name}.force_peak_n'] = peak
        return row
