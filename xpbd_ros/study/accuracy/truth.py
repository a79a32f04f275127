"""
The true solution of a scene, with its uncertainty, against which settings are compared.

The simulation's own limit comes from runs of one method with more and more substeps, extrapolated
to dt → 0 (Richardson) with the order of convergence that these runs show. If every effect of the
scene has an energy that the reference solver knows (``study.reference``), that solver's positions
are the true solution, and the own limit is compared with them.

Some scenes are chaotic: where cloth buckles or flutters, a perturbation of 1e-9 of the size grows
by orders of magnitude, and fine runs no longer agree. Up to the ``horizon`` they agree, so that
their limit is known to ``AGREED`` of the scene's size; later, only means over time are compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from pathlib import Path

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.scene.auto import MAX_SUBSTEPS
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.cost_table import SHIPPED
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.study.accuracy.solver_setting import (
    default_solver,
    Setting,
    with_solver,
    with_substeps,
)
from xpbd_ros.study.accuracy.trajectory import energy, Trajectory
from xpbd_ros.study.reference import problem_of, Reference, rms

PUSH = 1e-9
"""initial perturbation of the positions, over the scene's size"""
CHAOTIC = 1e3
"""growth of the perturbation above which a scene is chaotic"""
AGREED = 1e-4
"""largest uncertainty of positions that are compared, over the scene's size"""
FACTORS = (2, 4, 8, 16)
"""substeps of the runs towards the limit, over those that resolve the stretch"""
SLOWEST = 16
"""longest time of a frame in these runs, over the frame period"""
SETTLED = 0.25
"""last part of a run, over which means are taken"""
LEAST_ORDER, MOST_ORDER = 0.5, 2.5
"""bounds of the order of convergence for extrapolation"""
INDEPENDENT, OWN = 'independent', 'own limit'


@dataclass(eq=False)
class Truth:
    """The true solution at some times, and its means over the last part of the run."""

    kind: str
    """INDEPENDENT or OWN"""
    text: str
    """description of its origin and uncertainty"""
    size: float
    """largest extent of the cloths [m]"""
    horizon: int
    """last frame up to which trajectories are predictable"""
    frames: np.ndarray
    """frames at which positions are known, up to the horizon, shape (times,)"""
    x: np.ndarray
    """positions at these frames [m], shape (times, particles, 3)"""
    uncertainty: np.ndarray
    """uncertainty of these positions, RMS over the particles [m], shape (times,)"""
    apart: np.ndarray
    """distance of the own limit from these positions, RMS [m], shape (times,)"""
    energy: np.ndarray
    """kinetic, elastic and gravitational energy [J], shape (times,)"""
    most_kinetic: float
    """largest kinetic energy of the run [J]"""
    heights: np.ndarray
    """sorted heights of the particles, mean over the last part of the run [m]"""
    strain: float
    """RMS strain, mean over the last part of the run"""
    mean_energy: float
    """total energy, mean over the last part of the run [J]"""
    scatter: np.ndarray
    """difference of these three means between equally accurate runs [m, 1, J], shape (3,)"""
    growth: np.ndarray
    """distance of the perturbed run from the unperturbed one, RMS [m], shape (frames + 1,)"""
    loaded: float
    """largest strain up to the last of the frames, over the largest of the whole run"""

    def save(self, file: Path) -> None:
        """Write the true solution to an .npz file."""
        part = file.with_suffix('.part')
        with part.open('wb') as stream:
            np.savez(stream, **vars(self))
        part.replace(file)

    @staticmethod
    def load(file: Path) -> 'Truth':
        """Read a true solution from an .npz file."""
        with np.load(file, allow_pickle=False) as stored:
            return Truth(**{name: stored[name] if stored[name].ndim else stored[name].item()
                            for name in stored.files})


def own_rungs(scene: Scene) -> list[Setting]:
    """Return the settings of the runs towards the own limit, coarse to fine."""
    base = default_solver(scene)
    simulation = compile_scene(with_solver(scene, base.block()))
    per = SHIPPED.substep_ns(base.method, 1, simulation.effects, simulation.state)
    most = SLOWEST * 1e9 * simulation.frame_dt / per
    finest = max(4, min(FACTORS[-1] * base.substeps, int(most), MAX_SUBSTEPS))
    finest -= finest % (8 if finest > 8 else 4)    # so that each of the last three halves the step
    return [with_substeps(base, max(1, finest * factor // FACTORS[-1])) for factor in FACTORS]


def push(simulation: Simulation) -> None:
    """Perturb the positions of all free particles by PUSH of the scene's size."""
    state, x = simulation.state, simulation.frame().x
    moves = np.random.default_rng(0).standard_normal(x.shape) / sqrt(3.0) * PUSH * size_of(x)
    moves[state.inv_mass[simulation.slot] == 0.0] = 0.0
    state.x[:, simulation.slot] += moves.T
    state.x_prev[:] = state.x


def size_of(x: np.ndarray) -> float:
    """Return the largest extent along an axis of positions, shape (particles, 3) [m]."""
    return float(np.ptp(x, axis=0).max()) or 1.0


def horizon_of(rungs: Sequence[Trajectory], size: float) -> int:
    """Return the last frame up to which the own limit is known to AGREED of the size [m]."""
    for frame in range(len(rungs[-1].kinetic)):
        if not extrapolated([rung.x[frame] for rung in rungs])[1] <= AGREED * size:
            return frame - 1
    return len(rungs[-1].kinetic) - 1


def growth_of(pushed: Trajectory, base: Trajectory) -> np.ndarray:
    """Return the RMS distance of a perturbed run from the original [m], shape (frames + 1,)."""
    return np.array([rms(pushed.x[f] - base.x[f]) for f in range(len(base.kinetic))])


def times_of(horizon: int) -> list[int]:
    """Return the default frames at which positions are compared."""
    return sorted({max(1, round(horizon * part)) for part in (0.25, 0.5, 1.0)})


def extrapolated(rungs: Sequence[np.ndarray]) -> tuple[np.ndarray, float]:
    """
    Return the limit of three or more runs, each with half the step, and its uncertainty [m].

    The uncertainty is the change by extrapolation. If the runs do not converge, the last one is
    the limit, and the uncertainty is twice the difference of the last two.
    """
    a, b, c = rungs[-3:]
    before, last = rms(b - a), rms(c - b)
    if last == 0.0:
        return c, 0.0
    order = np.log2(before / last) if before > 0.0 else 0.0
    if order < LEAST_ORDER:
        return c, 2.0 * last
    step = (c - b) / (2.0**min(order, MOST_ORDER) - 1.0)
    return c + step, rms(step)


def independent(scene: Scene) -> str | None:
    """Return the reason why the reference solver cannot run a scene; None if it can."""
    try:
        problem_of(compile_scene(scene))
    except InputError as error:
        return str(error)
    return None


def settled(track: Trajectory) -> tuple[np.ndarray, float, float]:
    """Return means over the last part of a run: heights [m], strain, energy [J]."""
    last = slice(-max(1, round(SETTLED * (len(track.kinetic) - 1))), None)
    return track.heights[last].mean(0), track.strain[last].mean(), track.energy[last].mean()


def differences(a, b) -> np.ndarray:
    """Return the differences of two results of ``settled`` [m, 1, J], shape (3,)."""
    return np.array([np.sqrt(np.mean((a[0] - b[0])**2)), abs(a[1] - b[1]), abs(a[2] - b[2])])


def make(simulation: Simulation, rungs: Sequence[Trajectory], pushed: Trajectory,
         frames: Sequence[int] | np.ndarray, references: dict[int, Reference], horizon: int,
         why_not: str | None) -> Truth:
    """
    Return the true solution.

    Parameters
    ----------
    simulation : the scene at its start
    rungs : runs towards the own limit, coarse to fine, with all frames kept
    pushed : the coarsest of them with a perturbed start
    frames : frames at which positions are compared
    references : solutions of the reference solver by frame; empty if it cannot run the scene
    horizon : last frame up to which trajectories are predictable
    why_not : reason why the reference solver cannot run the scene, or None

    """
    finest = rungs[-1]
    size = size_of(finest.x[0])
    own = [extrapolated([rung.x[frame] for rung in rungs]) for frame in frames]
    x = np.array([references[f].x if f in references else own[k][0]
                  for k, f in enumerate(frames)])
    uncertainty = np.array([references[f].uncertainty if f in references else own[k][1]
                            for k, f in enumerate(frames)])
    known = np.flatnonzero(uncertainty <= AGREED * size)
    frames, x, uncertainty = (np.asarray(part)[known] for part in (frames, x, uncertainty))
    own = [own[k] for k in known]
    apart = np.array([rms(x[k] - own[k][0]) for k in range(len(frames))])
    energies = [_energy(simulation, references[f]) if f in references else finest.energy[f]
                for f in frames]
    means = [settled(track) for track in (*rungs[-2:], pushed)]
    scatter = np.max([differences(means[1], other) for other in (means[0], means[2])], axis=0)
    loaded = (finest.strain[:frames[-1] + 1].max() / (finest.strain.max() or 1.0)
              if len(frames) else 0.0)
    kind = INDEPENDENT if references else OWN
    dt = simulation.frame_dt
    at = ', '.join(f'{u:.1g} m at {f * dt:.3g} s' for f, u in zip(frames, uncertainty))
    text = ('the independent reference solver, extrapolated to dt → 0' if references else
            "the simulation's own limit for dt → 0, by Richardson extrapolation")
    text += f', known to {at}' if at else '; not known at any of the times asked for'
    if references and len(frames):
        text += f"; the simulation's own limit is within {apart.max():.1g} m of it"
    elif why_not:
        text += f' (the reference solver cannot run this scene: {why_not})'
    return Truth(kind, text, size, horizon, frames, x, uncertainty, apart, np.array(energies),
                 float(np.nanmax(finest.kinetic)), *means[1], scatter,
                 growth_of(pushed, rungs[0]), float(loaded))


def _energy(simulation: Simulation, reference: Reference) -> float:
    """Return the energy of a state of the reference solver [J], by the simulation's effects."""
    state = simulation.state
    before = state.x.copy(), state.v.copy()
    state.x[:, simulation.slot], state.v[:, simulation.slot] = reference.x.T, reference.v.T
    found = energy(simulation)
    state.x[:], state.v[:] = before
    return found

