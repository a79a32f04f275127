"""
What is measured against the baselines: the simulation of this checkout.

All that the benchmark knows about the simulation is in this file. A function returns something to
run, or raises NotAvailableError with the reason, which the table then prints in place of figures.
"""

from collections.abc import Callable
from dataclasses import dataclass

from native import NotAvailableError
from numba import njit
import numpy as np
from works import FRAME_DT, LineWork, SUBSTEPS, Work

from xpbd_ros.effects.bend import Bend
from xpbd_ros.effects.stretch import Stretch
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.sim.batch import colour_order
from xpbd_ros.sim.distance import distance_batch
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stages import prepare, project
from xpbd_ros.sim.state import new_state, State, Substep
from xpbd_ros.sim.step import compiled


@dataclass
class Candidate:
    """One kernel of ours, on one work."""

    run: Callable[[int], None]
    """does so many frames, or passes"""
    reset: Callable[[], None]
    """goes back to the work's start"""
    positions: Callable[[], np.ndarray]
    """[m], shape (particles, 3), in the work's own numbering"""


# Kernels

STEPS = ('gauss_seidel',)
"""methods for ``whole_steps``"""


def whole_steps(work: Work, *, method: str, precision: str, threads: int) -> Candidate:
    """Return whole frames of 10 × 1 on any list of edges: the rows ``grid`` and ``irregular``."""
    _only_float64(precision, threads)
    if method != 'gauss_seidel':
        raise NotAvailableError(f'method {method}')
    state = _state(work)
    edges = work.edges
    effects = (Stretch(distance_batch(edges.particles, edges.rest_length, edges.compliance,
                                      len(work.x), pins=False)),)
    step = compiled(('stretch',))

    def run(frames):
        step(effects, state, frames * FRAME_DT, frames * SUBSTEPS, 1)

    return Candidate(run, lambda: _restart(state, work), lambda: state.x.copy())


def line_passes(work: LineWork, *, precision: str) -> Candidate:
    """
    Return line solves in one direction (``work.along``): the rows ``line``.

    Its ``positions`` is to return x, shape (n, n, 3), and the multipliers [N s²], (n, n).
    """
    raise NotAvailableError('no line solve yet')


def bend_passes(work: Work, *, precision: str) -> Candidate:
    """Return projections of isometric hinges, multipliers kept from pass to pass: ``bend``."""
    _only_float64(precision, 1)
    state = _state(work)
    hinges = work.hinges
    order, colours = colour_order(hinges.particles, len(work.x))
    effects = (Bend(np.ascontiguousarray(hinges.particles[order], np.int64),
                    hinges.weight[order], hinges.compliance[order], np.zeros((len(order), 3)),
                    np.zeros(1, np.int64), colours),)
    substep = Substep(FRAME_DT / SUBSTEPS, 0.0, 1.0)
    return Candidate(lambda count: _passes(effects, state, substep, count),
                     lambda: _restart(state, work), lambda: state.x.copy())


@njit(nogil=True)
def _passes(effects, state, substep, count):
    prepare(effects, state, substep)
    for _ in range(count):
        project(effects, state, substep)


def _state(work: Work) -> State:
    held = work.inv_mass == 0.0
    state = new_state(work.x, 1.0 / np.where(held, 1.0, work.inv_mass), work.gravity)
    state.inv_mass[held] = 0.0
    return state


def _restart(state: State, work: Work) -> None:
    state.x[:] = work.x
    state.v[:] = 0.0


def _only_float64(precision: str, threads: int) -> None:
    if precision != 'float64':
        raise NotAvailableError(f'precision {precision}')
    if threads != 1:
        raise NotAvailableError(f'{threads} threads')


# Scenes

def courant(n: int, stiffness: float, shear: float = 5.0) -> float:
    """Return the substeps per frame below which an explicit step of the swing blows up."""
    mass = 0.2 / (n - 1)**2
    return float(np.sqrt(4 * (stiffness + shear) / mass) / 120)


def swing_settings(n: int, stiffness: float) -> list[dict]:
    """Return the settings of the reference swing that are compared with the textbook."""
    def ladder(method, integrator, *parts):
        return [{'method': method, 'integrator': integrator,
                 'substeps': int(np.ceil(part * courant(n, stiffness)))} for part in parts]

    return [*ladder('gauss_seidel', 'backward_euler', 0.3, 1.2),
            *ladder('line', 'backward_euler', 0.3),
            *ladder('line', 'bdf2', 0.12, 0.17, 0.24, 0.34, 0.6),
            *ladder('gauss_seidel_symmetric', 'bdf2', 0.34, 0.6),
            *ladder('explicit', 'leapfrog', 1.25),
            {'method': 'auto', 'integrator': None, 'substeps': None}]


SCALED = [{'method': 'gauss_seidel', 'integrator': 'backward_euler'},
          {'method': 'gauss_seidel_symmetric', 'integrator': 'bdf2'},
          {'method': 'line', 'integrator': 'bdf2'},
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
