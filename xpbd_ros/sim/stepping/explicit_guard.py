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
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.stepping.methods import METHODS

STRAIN = 0.25
"""largest increase of an edge's strain in a frame"""
LARGEST = 0.5
"""to which it may be strained at all: one that is pressed to half its length is stiffer across
than along, which the number of substeps does not reckon with"""
GROWTH = 2.0
"""largest ratio of the energy after a frame to the energy accounted for"""


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


def probed_edges(lists: Sequence, cells: Sequence = ()) -> EdgeProbe:
    """Return lists of edges (``distance.Edges``) and cells (``shear_cells.Slants``) to look at."""
    def of(lists, name, empty):
        return np.concatenate([empty, *(getattr(edges, name) for edges in lists)])

    particles = of(lists, 'particles', np.zeros((0, 2), np.int64))
    corners = of(cells, 'particles', np.zeros((0, 4), np.int64))
    compliance, slack = (of(those, 'compliance', np.zeros(0)) for those in (lists, cells))
    least = np.full(max(particles.max(initial=-1), corners.max(initial=-1)) + 1, np.inf)
    np.minimum.at(least, particles, compliance[:, None])
    np.minimum.at(least, corners, 0.5 * slack[:, None])    # a cell pulls at twice as many as edges
    return EdgeProbe(particles, of(lists, 'rest_length', np.zeros(0)), compliance,
                least[particles].min(axis=1) / compliance, corners, slack,
                least[corners].min(axis=1) / (0.5 * slack))


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


def is_stable(before, after, *, mass: float, load: float, acceleration: float,
              dt: float) -> bool:
    """
    Tell whether a frame is stable, by ``look`` before and after it.

    ``load`` is the sum of all external forces [N], ``acceleration`` the largest of a particle by
    them [m/s²].
    """
    speed = np.sqrt(2.0 * before[1] / mass) + acceleration * dt
    given = load * dt * speed + max(before[2], after[2])
    return bool(after[0] <= min(before[0] + STRAIN, LARGEST)
                and after[1] <= GROWTH * (before[1] + given))


class ExplicitGuard:
    """Checks each frame of ``explicit``, and computes unstable ones again with ``line``."""

    def __init__(self, simulation):
        self.redone = 0
        """frames computed again"""
        self._simulation = simulation
        state = simulation.state
        self._x, self._v = state.x.copy(), state.v.copy()
        self._mass = float(state.mass.sum())

    def _look(self) -> tuple[float, float, float]:
        state = self._simulation.state
        return look(self._edges, state.x, state.v, state.mass, state.inv_mass)

    def compile(self) -> None:
        """Compile the check and ``line``."""
        self._look()
        self.redo(0)

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
            [these for built in effects.values() for these in built.cells])

    def advance(self) -> None:
        """Compute one frame."""
        simulation, state = self._simulation, self._simulation.state
        self._x[:], self._v[:] = state.x, state.v
        before = self._look()
        simulation._advance(simulation.solver.substeps)
        gravity = float(np.linalg.norm(state.gravity))
        if is_stable(before, self._look(), mass=self._mass, dt=simulation.frame_dt,
                     load=self._mass * gravity + self._load,
                     acceleration=gravity + self._acceleration):
            return
        state.x[:], state.v[:] = self._x, self._v
        if state.reaction is not None:
            state.reaction[:] = 0.0
        for built in simulation.effects.values():
            built.again()
        self.redo(simulation.solver.rough_substeps)
        self.redone += 1
        if simulation.start is not None:
            simulation.start = replace(
                simulation.start, state=simulation.start.state._replace(apart=None),
                method=self._rough(), substeps=simulation.solver.rough_substeps)

    def _rough(self):
        return METHODS['line'](self._simulation.solver.iterations)

    def redo(self, substeps: int) -> None:
        """Compute the frame with ``line``; it has no history, so with backward Euler."""
        simulation = self._simulation
        simulation._crew.run(simulation._step, simulation._tuple,
                             simulation.state._replace(apart=None), self._rough(),
                             simulation.frame_dt, substeps)
