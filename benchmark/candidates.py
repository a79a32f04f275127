"""
What is measured against the baselines: the simulation of this checkout.

All that the benchmark knows about the simulation is in this file. A function returns something to
run, or raises NotAvailableError with the reason, which the table then prints in place of figures.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numba import njit
import numpy as np

from native import NotAvailableError
from works import FAMILIES, FRAME_DT, LineWork, SUBSTEPS, Work
from xpbd_ros.effects.bend import Curvature, Twist
from xpbd_ros.effects.stretch import MeshStretch, Stretch
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.sim.backend.threads import ThreadPool
from xpbd_ros.sim.constraints.builders import Rows
from xpbd_ros.sim.constraints.curvature import curvature_shapes, twist_shapes
from xpbd_ros.sim.constraints.distance import grid_edges, mesh_edges
from xpbd_ros.sim.constraints.grid_batches import Shape
from xpbd_ros.sim.constraints.line_solver import grid_lines, solve_warp, solve_weft
from xpbd_ros.sim.effect import BuildContext
from xpbd_ros.sim.geometry.mesh import cuthill_mckee
from xpbd_ros.sim.particles.memory_layout import blocks, zeros
from xpbd_ros.sim.particles.state import new_state, places, Substep
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stepping.methods import METHODS
from xpbd_ros.sim.stepping.stages import project
from xpbd_ros.sim.stepping.step import compiled


@dataclass
class Candidate:
    """One kernel of ours, on one work."""

    run: Callable[[int], None]
    """does so many frames, or passes"""
    reset: Callable[[], None]
    """goes back to the work's start"""
    state: Callable[[], Any]
    """positions [m], shape (particles, 3), in the work's own numbering"""


# Kernels

STEPS = ('gauss_seidel',)
"""methods for ``whole_steps``"""


def whole_steps(work: Work, *, method: str, precision: str, threads: int) -> Candidate:
    """Return whole frames of 10 × 1 on a list of edges: the rows ``grid`` and ``irregular``."""
    if work.kinds:
        sheet = _Sheet(work.n, work.x, work.inv_mass, work.gravity, precision)
        shapes = [Shape((a, b), *(range(work.n - max(ends)) for ends in zip(a, b)), family)
                  for family, (_, a, b) in enumerate(FAMILIES)]
        first = np.cumsum([0, *(len(s.rows) * len(s.columns) for s in shapes)])[:-1]
        edges = grid_edges([sheet.block], lambda rows, columns: shapes,
                           [work.edges.rest_length[first]],
                           [work.edges.compliance[first, None]], world=sheet.world)
        effects = (Stretch(edges, None, None),)
    else:
        sheet = _Sheet(work.n, work.x, work.inv_mass, work.gravity, precision,
                       order=work.edges.particles)
        if threads > 1:
            raise NotAvailableError('threads share out grids only')
        effects = (MeshStretch(mesh_edges([sheet.slot[work.edges.particles]],
                                          [work.edges.rest_length], [work.edges.compliance],
                                          world=sheet.world)),)
    step, how, crew = compiled(('stretch',)), METHODS[method](1), ThreadPool(threads)

    def run(frames):
        crew.run(step, effects, sheet.state, how, frames * FRAME_DT, frames * SUBSTEPS)

    return Candidate(run, sheet.reset, sheet.positions)


def line_passes(warp: LineWork, weft: LineWork, *, precision: str) -> Candidate:
    """
    Return solves of all warp lines, then of all weft lines: the rows ``line``.

    Its ``state`` is x, shape (n, n, 3), and the multipliers [N s²] of warp and weft, (n, n).
    """
    n, h = warp.n, warp.h
    sheet = _Sheet(n, warp.x.reshape(-1, 3), warp.inv_mass.ravel(), np.zeros(3), precision)
    lines = grid_lines([sheet.block], [(warp.rest_length[0, 0], weft.rest_length[0, 0])],
                       [(warp.compliance[:, 0], weft.compliance[0])], slots=sheet.slots,
                       dtype=sheet.state.x.dtype)
    force = zeros(2 * sheet.slots, sheet.state.x.dtype)
    sheet.state.mobility[:] = sheet.state.inv_mass * h**2

    def state():
        found = force.reshape(2, -1)[:, sheet.block.slots]
        return (sheet.positions().reshape(n, n, 3), *(found.astype(float) * h**2))

    return Candidate(lambda count: _solve_lines(lines, force, sheet.state, count), sheet.reset,
                     state)


@njit(nogil=True)
def _solve_lines(lines, force, state, count):
    force[:] = 0.0
    for _ in range(count):
        solve_warp(lines, 0, force, state)
        solve_weft(lines, 0, force, state)


def bend_passes(work: Work, *, precision: str) -> Candidate:
    """Return projections of bending, multipliers kept from pass to pass: ``bend``."""
    sheet = _Sheet(work.n, work.x, work.inv_mass, np.zeros(3), precision, forces=True)
    effects = []
    for kind, shapes_of in ((Curvature, curvature_shapes), (Twist, twist_shapes)):
        rows = Rows([sheet.block], shapes_of, sheet.world)
        alpha = np.full((len(rows.families), 1), work.hinges.compliance[0])
        effects.append(kind(**rows.common([alpha], (3,)), rate=np.inf))
    effects = tuple(effects)
    substep = Substep(FRAME_DT / SUBSTEPS, 0.0, 1.0)
    sheet.state.mobility[:] = sheet.state.inv_mass * substep.h**2
    return Candidate(lambda count: _passes(effects, sheet.state, substep, count), sheet.reset,
                     sheet.positions)


@njit(nogil=True)
def _passes(effects, state, substep, count):
    for k in range(count):
        project(effects, state, Substep(substep.h, substep.begin, substep.end, k, None, 0))


class _Sheet:
    """The particles of a work as the simulation lays them out, and as an effect sees them."""

    def __init__(self, n, x, inv_mass, gravity, precision, *, order=None, forces=False):
        dtype = np.dtype(precision)
        shape = (n, n) if order is None else cuthill_mckee(order, len(x))
        (self.block,), self.slots = blocks([shape], dtype)
        self.slot, self.x = self.block.slots.ravel(), x
        held = inv_mass == 0.0
        self.state = new_state(x, 1.0 / np.where(held, 1.0, inv_mass), gravity, self.slot,
                               self.slots, dtype=dtype)
        self.state.inv_mass[self.slot[held]] = 0.0
        self.world = BuildContext((), self.state, {}, {}, pins=False, forces=forces)

    def reset(self) -> None:
        """Go back to the start."""
        self.state.x[:, self.slot] = self.x.T
        self.state.v[:] = 0.0

    def positions(self) -> np.ndarray:
        """Return x [m], shape (particles, 3)."""
        return places(self.state.x, self.slot)


# Scenes

def courant(n: int, stiffness: float, shear: float = 5.0) -> float:
    """Return the substeps per frame below which an explicit step of the flat swing blows up."""
    mass = 0.2 / (n - 1)**2
    return float(np.sqrt(4 * (stiffness + shear) / mass) / 120)


def stable(n: int, stiffness: float) -> int:
    """Return as many as are stable even where warp and weft pull along one direction."""
    return int(np.ceil(2**0.5 * courant(n, stiffness)))


def swing_settings(n: int, stiffness: float) -> list[dict]:
    """Return the settings of the reference swing that are compared with the textbook."""
    def ladder(method, integrator, *parts):
        return [{'method': method, 'integrator': integrator,
                 'substeps': int(np.ceil(part * courant(n, stiffness)))} for part in parts]

    return [*ladder('gauss_seidel', 'backward_euler', 0.3, 1.2),
            *ladder('line', 'backward_euler', 0.3),
            *ladder('line', 'bdf2', 0.12, 0.24, 0.34, 0.6),
            *ladder('line', 'ndf2', 0.0775, 0.1, 0.14, 0.17, 0.33, 0.6),
            *ladder('gauss_seidel_symmetric', 'bdf2', 0.34, 0.6),
            {'method': 'explicit', 'integrator': 'leapfrog', 'substeps': stable(n, stiffness)},
            {'method': 'auto', 'integrator': None, 'substeps': None}]


SCALED = [{'method': 'gauss_seidel', 'integrator': 'backward_euler'},
          {'method': 'gauss_seidel_symmetric', 'integrator': 'bdf2'},
          {'method': 'line', 'integrator': 'ndf2'},
          {'method': 'jacobi', 'integrator': 'backward_euler'}]
"""settings whose cost at 10 × 1 is followed from 32² to 512²"""


def swing(n: int, stiffness: float, *, method: str, integrator: str | None,
          substeps: int | None) -> Simulation:
    """Return the reference swing, compiled and at its start."""
    keys = {'cloths.sheet.grid.resolution': [n, n],
            'cloths.sheet.effects.stretch.warp': stiffness,
            'cloths.sheet.effects.stretch.weft': stiffness,
            'solver.method': method}
    if integrator not in (None, 'leapfrog'):    # explicit names none
        keys['solver.integrator'] = integrator
    if substeps is not None:
        keys['solver.substeps'] = substeps
    try:
        simulation = compile_scene(load_scene('swing', keys))
    except InputError as error:
        raise NotAvailableError(str(error).rpartition('solver.')[2]) from error
    simulation.compile()
    return simulation
