"""Run a scene, and record its trajectory for a study."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from xpbd_ros.sim.measure import elastic_energy, kinetic_energy, potential_energy
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.study.edges import Edges, edges_of


@dataclass(eq=False)
class Trajectory:
    """Measures of a run, frame by frame; frame 0 is the start."""

    x: dict[int, np.ndarray]
    """positions by kept frame [m], each of shape (particles, 3)"""
    kinetic: np.ndarray
    """kinetic energy [J], shape (frames + 1,)"""
    energy: np.ndarray
    """kinetic, elastic and gravitational energy [J], shape (frames + 1,)"""
    strain: np.ndarray
    """RMS strain over the edges, shape (frames + 1,)"""
    heights: np.ndarray
    """sorted heights of all particles [m], shape (frames + 1, particles)"""
    residual: dict[int, float | None]
    """RMS of C + α f over the edges by kept frame [m]; None without multipliers"""
    ended: int | None = None
    """first frame that was not finite; None if all were"""
    redone: int = 0
    """frames of ``explicit`` that were computed again with ``line``"""


class Recorder:
    """
    Fill in a trajectory frame by frame.

    Parameters
    ----------
    edges : edges whose strain is measured
    frames, particles : numbers of them
    kept : frames whose positions are kept; None for all

    """

    def __init__(self, edges: Edges, frames: int, particles: int, kept: Sequence[int] | None):
        count = frames + 1
        self._edges, self._kept = edges, None if kept is None else set(kept)
        kinetic, energy, strain = np.full((3, count), np.nan)
        self.track = Trajectory({}, kinetic, energy, strain,
                                np.full((count, particles), np.nan), {})

    def add(self, frame: int, x: np.ndarray, kinetic: float, energy: float,
            residual: Callable[[], float | None] = lambda: None) -> bool:
        """Add a frame; return whether it is finite."""
        track = self.track
        if not (np.isfinite(x).all() and np.isfinite(energy)):
            track.ended = frame
            return False
        track.kinetic[frame], track.energy[frame] = kinetic, energy
        strain = self._edges.strain(x)
        track.strain[frame] = np.sqrt(np.mean(strain**2)) if len(strain) else 0.0
        track.heights[frame] = np.sort(x[:, 2])
        if self._kept is None or frame in self._kept:
            track.x[frame] = x.copy()
            track.residual[frame] = residual()
        return True


def play(simulation: Simulation, frames: int, *, commands: dict[int, list] | None = None,
         kept: Sequence[int] | None = None) -> Trajectory:
    """
    Run a simulation from its present state, and return its trajectory.

    Parameters
    ----------
    simulation : the simulation
    frames : number of frames
    commands : inputs by frame
    kept : frames whose positions are kept; None for all

    """
    commands = commands or {}
    recorder = Recorder(edges_of(simulation), frames, len(simulation.slot), kept)
    frame = simulation.frame()
    with np.errstate(all='ignore'):
        for index in range(frames + 1):
            if index:
                frame = simulation.step(commands.get(index, ()))
            if not recorder.add(index, frame.x, kinetic_energy(simulation.state),
                                energy(simulation), lambda: residual(simulation)):
                break
    recorder.track.redone = int(sum(
        simulation.stats().get(name, 0) for name in ('explicit_redone', 'line_frames')))
    return recorder.track


def energy(simulation: Simulation) -> float:
    """Return the sum of kinetic, gravitational and elastic energy [J]."""
    state = simulation.state
    return kinetic_energy(state) + potential_energy(state) + elastic_energy(simulation)


def residual(simulation: Simulation) -> float | None:
    """Return the RMS of C + α f over all edges [m]; None without multipliers."""
    left = []
    for built in simulation.effects.values():
        for part, edges in zip(built.parts, built.by_part):
            force = getattr(getattr(part, 'edges', None), 'force', None)
            if force is not None and force.size and hasattr(edges, 'rest_length'):
                left.append(edges.residual(simulation.state.x)
                            + edges.compliance * force.ravel()[edges.index])
    if not left:
        return None
    return float(np.sqrt(np.mean(np.concatenate(left)**2)))
