"""
What settings are compared with: where the particles really are, and how well that is known.

Our own limit: the same method with more and more substeps, extrapolated to dt → 0 (Richardson)
with the order that the ladder itself shows. Where every effect of a scene has an energy that the
independent solver knows (``study.reference``), its positions are taken, and our limit is compared
with them.

Some scenes are chaotic: cloth that buckles or flutters makes a
push of 1e-9 m grow by orders, and fine runs no longer agree. Up to the ``horizon`` they do, so
that their limit is known to ``AGREED`` of the scene's size; after it only means over time are
compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from pathlib import Path

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.scene.auto import cost
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.study.accuracy.solver_setting import (
    default_solver,
    Setting,
    with_solver,
    with_substeps,
)
from xpbd_ros.study.accuracy.trajectory import energy, Track
from xpbd_ros.study.reference import problem_of, Reference, rms

PUSH = 1e-9
"""how far particles are pushed to see what becomes of it, of the scene's size"""
CALM = 1e3
"""how often itself a push may become without being a sign of chaos"""
AGREED = 1e-4
"""how well positions must be known for trajectories to be compared, of the scene's size"""
FACTORS = (2, 4, 8, 16)
"""substeps of our ladder, times those that resolve the stretch"""
PATIENCE = 16
"""longest frame of our ladder, in those of real time"""
SETTLED = 0.25
"""last part of a run over which means are taken"""
LEAST_ORDER, MOST_ORDER = 0.5, 2.5
INDEPENDENT, OWN = 'independent', 'own limit'


@dataclass(eq=False)
class Truth:
    """The answer, at some times."""

    kind: str
    """INDEPENDENT or OWN"""
    text: str
    """what it is and how well it is known, in words"""
    size: float
    """largest extent of the cloths [m]"""
    horizon: int
    """last frame up to which trajectories can be compared"""
    frames: np.ndarray
    """at which positions are known, up to the horizon; shape (times,)"""
    x: np.ndarray
    """positions there [m], shape (times, particles, 3)"""
    uncertainty: np.ndarray
    """of them: root mean square over the particles [m], shape (times,)"""
    apart: np.ndarray
    """how far our limit is from them [m], shape (times,)"""
    energy: np.ndarray
    """kinetic, elastic and gravity's [J], shape (times,)"""
    most_kinetic: float
    """largest kinetic energy of the run [J]"""
    heights: np.ndarray
    """heights of the particles, lowest first, mean over the last part of the run [m]"""
    strain: float
    """root mean square, mean over the last part of the run"""
    mean_energy: float
    """mean over the last part of the run [J]"""
    scatter: np.ndarray
    """how far runs that are as good differ in those three: [m], 1, [J]; shape (3,)"""
    growth: np.ndarray
    """how far a push of 1e-9 of the size has taken a run from itself [m], shape (frames + 1,)"""
    loaded: float
    """largest strain up to the last of the times, of the largest in the whole run"""

    def save(self, file: Path) -> None:
        """Write it to an .npz file."""
        part = file.with_suffix('.part')
        with part.open('wb') as stream:
            np.savez(stream, **vars(self))
        part.replace(file)

    @staticmethod
    def load(file: Path) -> 'Truth':
        """Read it back."""
        with np.load(file, allow_pickle=False) as stored:
            return Truth(**{name: stored[name] if stored[name].ndim else stored[name].item()
                            for name in stored.files})


def own_rungs(scene: Scene) -> list[Setting]:
    """Return the settings of our own ladder, coarse to fine."""
    base = default_solver(scene)
    simulation = compile_scene(with_solver(scene, base.block()))
    per = cost(base.method, 1, simulation.effects, simulation.state)
    most = PATIENCE * 1e9 * simulation.frame_dt / per
    finest = max(4, min(FACTORS[-1] * base.substeps, int(most)))
    return [with_substeps(base, max(1, finest * factor // FACTORS[-1])) for factor in FACTORS]


def push(simulation: Simulation) -> None:
    """Move all free particles a very little, to see what becomes of it."""
    state, x = simulation.state, simulation.frame().x
    moves = np.random.default_rng(0).standard_normal(x.shape) / sqrt(3.0) * PUSH * size_of(x)
    moves[state.inv_mass[simulation.slot] == 0.0] = 0.0
    state.x[:, simulation.slot] += moves.T
    state.x_prev[:] = state.x


def size_of(x: np.ndarray) -> float:
    """Return the largest extent of some positions [m]."""
    return float(np.ptp(x, axis=0).max()) or 1.0


def horizon_of(rungs: Sequence[Track], size: float) -> int:
    """Return the last frame up to which our limit is known well enough."""
    for frame in range(len(rungs[-1].kinetic)):
        if not extrapolated([rung.x[frame] for rung in rungs])[1] <= AGREED * size:
            return frame - 1
    return len(rungs[-1].kinetic) - 1


def growth_of(pushed: Track, base: Track) -> np.ndarray:
    """Return how far a run with a push is from the same without [m], shape (frames + 1,)."""
    return np.array([rms(pushed.x[f] - base.x[f]) for f in range(len(base.kinetic))])


def times_of(horizon: int) -> list[int]:
    """Return the frames at which positions are compared unless the user says."""
    return sorted({max(1, round(horizon * part)) for part in (0.25, 0.5, 1.0)})


def extrapolated(rungs: Sequence[np.ndarray]) -> tuple[np.ndarray, float]:
    """
    Return the limit of three or more runs, each with half the step, and its uncertainty [m].

    The uncertainty is what the last extrapolation changed; where the runs do not converge nothing
    is extrapolated, and it is twice what the last two differ.
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
    """Return why the independent solver cannot do a scene; None: it can."""
    try:
        problem_of(compile_scene(scene))
    except InputError as error:
        return str(error)
    return None


def settled(track: Track) -> tuple[np.ndarray, float, float]:
    """Return means over the last part of a run: heights, strain, energy."""
    last = slice(-max(1, round(SETTLED * (len(track.kinetic) - 1))), None)
    return track.heights[last].mean(0), track.strain[last].mean(), track.energy[last].mean()


def differences(a, b) -> np.ndarray:
    """Return how far two such means are apart."""
    return np.array([np.sqrt(np.mean((a[0] - b[0])**2)), abs(a[1] - b[1]), abs(a[2] - b[2])])


def make(simulation: Simulation, rungs: Sequence[Track], pushed: Track, frames: Sequence[int],
         references: dict[int, Reference], horizon: int, why_not: str | None) -> Truth:
    """
    Return the truth.

    Parameters
    ----------
    simulation : of the scene, at its start
    rungs : of our ladder, coarse to fine, all frames kept
    pushed : the coarsest of them, started with the push
    frames : at which positions are wanted
    references : of the independent solver, by frame; none where it cannot do the scene
    horizon : last frame up to which trajectories can be compared
    why_not : why it cannot

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
    text = ('the independent solver, extrapolated to dt → 0' if references else
            'our own limit for dt → 0, by Richardson extrapolation')
    text += f', known to {at}' if at else '; not known at any of the times asked for'
    if references and len(frames):
        text += f'; our own limit is within {apart.max():.1g} m of it'
    elif why_not:
        text += f' (not the independent solver: {why_not})'
    return Truth(kind, text, size, horizon, frames, x, uncertainty, apart, np.array(energies),
                 float(np.nanmax(finest.kinetic)), *means[1], scatter,
                 growth_of(pushed, rungs[0]), float(loaded))


def _energy(simulation: Simulation, reference: Reference) -> float:
    """Return the energy of the independent solver's state [J], by our own effects."""
    state = simulation.state
    before = state.x.copy(), state.v.copy()
    state.x[:, simulation.slot], state.v[:, simulation.slot] = reference.x.T, reference.v.T
    found = energy(simulation)
    state.x[:], state.v[:] = before
    return found

