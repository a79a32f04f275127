"""
Predict the substeps that a solver setting needs.

There are two requirements. The edges must be as stiff as asked (``stiffness``): that error falls
as 1 / N². And BDF2 or NDF2 must resolve the stretch waves: with ``substep_ratio`` times the
substeps of an explicit solver the error is about 1e-3 of the length, and as it is of second
order, √10 fewer substeps make it 10 times as large (doc/numerics.md 3.2).
"""

from dataclasses import replace
from math import ceil, inf, sqrt

from xpbd_ros.scene.model import Scene
from xpbd_ros.scene.stability import largest_rate, stable_substeps, substep_ratio
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stepping.solver import Solver
from xpbd_ros.study.prediction.stiffness import Row, stiffness

MOST = 10_000
"""largest number of substeps of a scene"""
RESOLVED = 1e-3
"""relative error with ``substep_ratio`` times the substeps of an explicit solver"""
STRETCH = ('stretch', 'membrane', 'pressure')
"""effects whose stiffness is required"""
CORRECTIONS = 6
"""corrections of the first guess, at most"""


def needed(scene: Scene, simulation: Simulation, solver: Solver, error: float) -> int | None:
    """Return the substeps for a relative error of the stretch; None if more than MOST."""
    count = max(1.0, resolving(simulation, solver, error))
    if count > MOST:
        return None

    def left(count: int) -> float:
        return stretch_error(stiffness(scene, simulation, replace(solver, substeps=count)))

    below, count = 0, ceil(count)
    for _ in range(CORRECTIONS):
        more = left(count)
        if more <= error:
            break
        if more == inf:
            return None
        below = count
        count = max(count + 1, ceil(count * min(sqrt(more / error), 100.0) * (1.0 - 1e-9)))
        if count > MOST:
            return None
    while below and count - below > 1:    # bisection, as the error may fall faster than 1 / N²
        middle = (below + count) // 2
        below, count = (below, middle) if left(middle) <= error else (middle, count)
    return count


def resolving(simulation: Simulation, solver: Solver, error: float) -> float:
    """Return the substeps that resolve stretch waves; 1 if only the stiffness matters."""
    if solver.integrator == 'backward_euler':
        return 1.0
    if solver.method == 'explicit':    # required for stability
        return stable_substeps(simulation.effects, simulation.state, simulation.frame_dt)
    rate = sum(max(largest_rate(these, simulation.state.mass) for these in built.by_part)
               for name, built in simulation.effects.items() if name in ('shear', 'stretch'))
    if rate == inf:
        return 1.0
    wanted = substep_ratio(solver.method, solver.integrator) * simulation.frame_dt * sqrt(rate)
    return wanted * min(1.0, sqrt(RESOLVED / error))


def stretch_error(rows: list[Row]) -> float:
    """Return the largest relative error of rows of STRETCH; 0 without any."""
    return max((abs(row.error) for row in rows if row.effect in STRETCH), default=0.0)
