"""Roll back non-finite or implausible frames."""

from math import inf, sqrt

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import absolute, any_lane, both, lanes, load, select, splat
from xpbd_ros.sim.particles.state import forget, history_arrays

REACH = 1000.0
"""no particle goes further in a frame, in sizes of the cloths and ways of what may drive it"""
DRIVE = 1.0
"""a speed of pins and colliders, and of what comes out of them [m/s]"""


@jit
def is_plausible(x, v, before, reach, begin, end):
    """
    Tell whether no particle went further than a reach along an axis, and v is finite.

    For the vectors of the slots begin, …, end - 1; their ends are rounded down.
    """
    slots, count, bad = x.shape[1], lanes(x), splat(x, 0.0)
    for k in range(3):
        for q in range(begin // count * count, end // count * count, count):
            i = k * slots + q
            good = both(absolute(load(x, i) - load(before, i)) <= reach,
                        absolute(load(v, i)) < inf)
            bad = select(good, bad, splat(x, 1.0))    # not a number is neither
    return not any_lane(bad > 0.0)


def put_back(simulation, x, v) -> None:
    """Undo a frame: positions and velocities as given, no history."""
    state = simulation.state
    state.x[:], state.v[:] = x, v
    for array in history_arrays(state):
        array[:] = 0.0    # no share of nan is 0
    forget(state)
    for built in simulation.effects.values():
        built.again()


class FrameRollback:
    """
    Restores the state of the frame before, at rest, and counts it.

    A frame is implausible if a number is not finite, or if a particle moved by more than REACH
    times the size of all cloths plus the distance that gravity and DRIVE account for.
    """

    def __init__(self, simulation):
        self.taken_back = 0
        """frames so far"""
        self._simulation = simulation
        state = simulation.state
        self._x = state.x.copy()
        self._size = sum(float(np.linalg.norm(np.ptp(cloth.mesh.positions, axis=0))) or 1.0
                         for cloth in simulation.cloths)

    def keep(self) -> None:
        """Remember where the particles are."""
        x = self._simulation.state.x

        def copy(begin: int, end: int) -> None:
            self._x[:, begin:end] = x[:, begin:end]
        self._simulation.by_parts(copy, x.shape[1])

    def look(self) -> None:
        """Judge the frame, and take it back if it cannot be."""
        simulation, state = self._simulation, self._simulation.state
        dt = simulation.frame_dt
        gx, gy, gz = state.gravity.tolist()
        drive = dt * (DRIVE + dt * sqrt(gx * gx + gy * gy + gz * gz))
        if self._is_plausible(REACH * (self._size + drive)):
            return
        simulation.fetch()
        put_back(simulation, self._x, 0.0)
        self.taken_back += 1

    def _is_plausible(self, reach: float) -> bool:
        state, found = self._simulation.state, []

        def judge(begin: int, end: int) -> None:
            found.append(is_plausible(state.x, state.v, self._x, reach, begin, end))
        self._simulation.by_parts(judge, state.x.shape[1])
        return all(found)
