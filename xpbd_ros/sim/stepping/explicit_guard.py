"""
Stability check of explicit frames; an unstable frame is computed again with ``line``.

Beyond its stability limit a leapfrog grows by a factor in every substep, so one frame is enough to
detect it: an edge is strained by far more than before or than is safe, or there is more energy
than there was and than gravity, given forces and the pins can have added.

An edge adds to the effective stiffness by its strain and its own stiffness. So the strain of an
edge that is softer than others at its particles is scaled by the ratio: soft diagonals may be
compressed while warp and weft keep their length.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.stepping.rollback import put_back

STRAIN = 0.25
"""largest increase of an edge's strain in a frame"""
LARGEST = 0.5
"""to which it may be strained at all: one that is pressed to half its length is stiffer across
than along, which the number of substeps does not reckon with"""
GROWTH = 2.0
"""largest ratio of the energy after a frame to the energy accounted for"""
ROUNDINGS = 8.0
"""units in the last place of a coordinate by which rounding may move a particle in a substep"""


class EdgeProbe(NamedTuple):
    """The edges and the oblong cells that are checked."""

    particles: np.ndarray
    """slots, shape (edges, 2)"""
    rest_length: np.ndarray
    """[m], shape (edges,)"""
    compliance: np.ndarray
    """[m/N], shape (edges,)"""
    share: np.ndarray
    """stiffness as part of the stiffest edge's at its particles, 0 … 1; shape (edges,)"""
    cells: np.ndarray
    """slots, both ends of each diagonal; shape (cells, 4)"""
    cell_compliance: np.ndarray
    """[m/N], shape (cells,)"""
    cell_share: np.ndarray
    """as of edges, shape (cells,)"""


def probed_edges(lists: Sequence, cells: Sequence,
                 sides: Sequence[tuple[np.ndarray, np.ndarray]]) -> EdgeProbe:
    """
    Return what to look at.

    Parameters
    ----------
    lists, cells : edges (``distance.Edges``) and cells (``shear_cells.Slants``)
    sides : of elements, ``Built.sides``; their strain counts whole, and they store no energy

    """
    def of(lists, name, empty):
        return np.concatenate([empty, *(getattr(edges, name) for edges in lists)])

    particles = of(lists, 'particles', np.zeros((0, 2), np.int64))
    corners = of(cells, 'particles', np.zeros((0, 4), np.int64))
    compliance, slack = (of(those, 'compliance', np.zeros(0)) for those in (lists, cells))
    least = np.full(max(particles.max(initial=-1), corners.max(initial=-1)) + 1, np.inf)
    np.minimum.at(least, particles, compliance[:, None])
    np.minimum.at(least, corners, 0.5 * slack[:, None])    # a cell pulls at twice as many as edges
    slots, lengths = (np.concatenate(each) for each in zip(
        (np.zeros((0, 2), np.int64), np.zeros(0)), *sides))
    return EdgeProbe(
        np.concatenate([particles, slots]),
        np.concatenate([of(lists, 'rest_length', np.zeros(0)), lengths]),
        np.concatenate([compliance, np.full(len(slots), np.inf)]),
        np.concatenate([least[particles].min(axis=1) / compliance, np.ones(len(slots))]),
        corners, slack, least[corners].min(axis=1) / (0.5 * slack))


@jit
def look(calm, x, v, mass, inv_mass):
    """
    Return the largest strain, as it counts, and energies [J].

    These are of free particles and edges, and of pinned particles.
    """
    strain, energy, pinned = 0.0, 0.0, 0.0
    for e in range(len(calm.rest_length)):
        i, j, rest = calm.particles[e, 0], calm.particles[e, 1], calm.rest_length[e]
        dx, dy, dz = x[0, i] - x[0, j], x[1, i] - x[1, j], x[2, i] - x[2, j]
        residual = np.sqrt(dx * dx + dy * dy + dz * dz) - rest
        felt = calm.share[e] * abs(residual)
        if rest > 0.0 and not felt <= strain * rest:    # not a number is more than any
            strain = felt / rest
        energy += 0.5 * residual * residual / calm.compliance[e]
    for c in range(len(calm.cell_share)):
        one, other = 0.0, 0.0
        for k in range(3):
            one += (x[k, calm.cells[c, 0]] - x[k, calm.cells[c, 1]])**2
            other += (x[k, calm.cells[c, 2]] - x[k, calm.cells[c, 3]])**2
        rest = np.sqrt(0.5 * (one + other))    # of both, whichever way a parallelogram leans
        one, other = np.sqrt(one), np.sqrt(other)
        felt = calm.cell_share[c] * (rest - min(one, other))
        if not felt <= strain * rest:
            strain = felt / rest
        energy += 0.5 * (one - other)**2 / calm.cell_compliance[c]
    for i in range(len(mass)):
        kinetic = 0.5 * mass[i] * (v[0, i]**2 + v[1, i]**2 + v[2, i]**2)
        if inv_mass[i] > 0.0:
            energy += kinetic
        else:
            pinned += kinetic
    return strain, energy, pinned


def is_stable(before, after, *, mass: float, load: float, acceleration: float, dt: float,
              work: float = 0.0, noise: float = 0.0) -> bool:
    """
    Tell whether a frame is stable, by ``look`` before and after it.

    ``load`` is the sum of all external forces [N], ``acceleration`` the largest of a particle by
    them [m/s²], ``work`` that of the pins [J], ``noise`` the speed that is mere rounding [m/s].
    """
    speed = np.sqrt(2.0 * before[1] / mass) + acceleration * dt
    given = load * dt * speed + max(before[2], after[2]) + work + 0.5 * mass * noise**2
    return bool(after[0] <= min(before[0] + STRAIN, LARGEST)
                and after[1] <= GROWTH * (before[1] + given))


class ExplicitGuard:
    """
    Checks each frame of ``explicit``, and computes unstable ones again with ``line``.

    With ``rough_frames`` of the solver the frames after an unstable one are of ``line`` too, until
    so many in a row are calm, so that a rough stretch costs no frame twice.
    """

    def __init__(self, simulation):
        self.redone = 0
        """frames computed again"""
        self.switches = 0
        """changes of the method from one frame to the next"""
        self.line_frames = 0
        """frames of ``line``"""
        self._left = 0
        """calm frames of ``line`` before the next one of ``explicit``"""
        self._method = ''
        """of the frame before"""
        self._simulation = simulation
        state = simulation.state
        self._x, self._v = state.x.copy(), state.v.copy()
        self._mass = float(state.mass.sum())

    @property
    def setting(self):
        """Setting of the next frame."""
        solver = self._simulation.solver
        return solver.rough if self._left and solver.method == 'explicit' else solver

    def _look(self) -> tuple[float, float, float]:
        state, effects = self._simulation.state, self._simulation.effects
        strain, energy, pinned = look(self._edges, state.x, state.v, state.mass, state.inv_mass)
        energy += sum(built.stored_energy(state) for built in effects.values())
        return strain, energy, pinned

    def compile(self) -> None:
        """Compile the check and ``line``."""
        self._look()
        simulation, solver = self._simulation, self._simulation.solver
        for built in simulation.effects.values():
            built.work(simulation.frame_dt)
        if solver.method == 'explicit':
            simulation._crew.compile(*simulation._arguments(solver.rough))

    def collect(self) -> None:
        """Read edges, cells and external forces from the effects."""
        effects, mass = self._simulation.effects, self._simulation.state.mass
        forces = np.sum([np.linalg.norm(built.force, axis=0) for built in effects.values()
                         if built.force is not None] or [np.zeros(len(mass))], axis=0)
        self._load = float(forces.sum())
        self._acceleration = float((forces[mass > 0.0] / mass[mass > 0.0]).max())
        self._edges = probed_edges(
            [these for built in effects.values() for these in built.by_part
             if these.particles.shape[1] == 2],
            [these for built in effects.values() for these in built.cells],
            [built.sides for built in effects.values() if built.sides is not None])

    def reset(self) -> None:
        """Go to the scene's start."""
        self._left = 0

    def stats(self) -> dict[str, float]:
        """Return the counters of the run."""
        if self._simulation.solver.mixes:
            return {'method_switches': self.switches, 'line_frames': self.line_frames}
        return {'explicit_redone': self.redone}

    def advance(self) -> None:
        """Compute one frame."""
        simulation, state, setting = self._simulation, self._simulation.state, self.setting
        solver = simulation.solver
        self._begin(setting.method)
        if solver.method != 'explicit':
            simulation._advance()
            self.line_frames += 1
            return
        before, more = self._look(), self._loads()
        if self._left:
            simulation._advance(setting)
            self._left = self._left - 1 if self._is_stable(before, more) else solver.rough_frames
            self.switches += not self._left
            self.line_frames += 1
            return
        self._x[:], self._v[:] = state.x, state.v
        simulation._advance()
        if self._is_stable(before, more):
            return
        simulation.fetch()
        put_back(simulation, self._x, self._v)
        self._left, self._method = solver.rough_frames, 'line'
        self.redone += 1
        self.line_frames += 1
        self.switches += bool(self._left)
        start, rough = simulation.start, solver.rough
        if start is not None:
            simulation.start = replace(
                start, method=simulation._method(rough), substeps=rough.substeps,
                state=start.state._replace(apart=None, history=deepcopy(state.history),
                                           gap=state.gap))
        simulation._advance(rough)

    def _begin(self, method: str) -> None:
        """Begin a frame of a method."""
        if method != self._method:
            self._simulation.fetch()
            for built in self._simulation.effects.values():
                built.forget()
        self._method = method

    def _loads(self) -> tuple[float, float]:
        """Return external forces in total [N], and the largest acceleration by them [m/s²]."""
        simulation, state = self._simulation, self._simulation.state
        gravity = float(np.linalg.norm(state.gravity))
        load, acceleration = self._mass * gravity + self._load, gravity + self._acceleration
        with np.errstate(all='ignore'):
            for built in simulation.effects.values():
                force, largest = built.load(state)
                load, acceleration = load + force, acceleration + largest
        return load, acceleration

    def _is_stable(self, before, loads) -> bool:
        simulation, dt = self._simulation, self._simulation.frame_dt
        with np.errstate(all='ignore'):    # not a number is not stable
            work = sum(built.work(dt) for built in simulation.effects.values())
            return is_stable(before, self._look(), mass=self._mass, dt=dt, load=loads[0],
                             acceleration=loads[1], work=work, noise=self._noise())

    def _noise(self) -> float:
        """Return the speed that rounding of the coordinates in a substep gives [m/s]."""
        x, solver = self._simulation.state.x, self._simulation.solver
        return float(ROUNDINGS * np.finfo(x.dtype).eps * np.abs(x).max() * solver.substeps
                     / self._simulation.frame_dt)
