"""
Watch how wrong a running simulation is, and give it the substeps that hold an error.

Now and then a frame is computed again with more substeps (``sim/doubling``), by a thread of its
own while the simulation goes on. How often follows from what it takes, so that it stays under
SHARE of the work. A result counts exactly LATER frames after its frame, not when it happens to be
there: what the watch asks for depends on the scene and its inputs alone.
"""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from math import ceil
import time

from xpbd_ros.sim.commands import SetKey
from xpbd_ros.sim.measure import largest_strain, stiffness_given
from xpbd_ros.sim.simulation import Simulation, Solver
from xpbd_ros.sim.stepping.error_estimate import Estimate, estimate

FIRST = 10
"""the first frame that is looked at"""
LATER = 30
"""frames until a result counts"""
SHARE = 0.02
"""of the work of all frames"""
MARGIN = 0.8
"""of the target is what new substeps aim at"""
SLACK = 0.25
"""of the target: what is still not worth fewer substeps"""
RECENT = 3
"""estimates that must agree on fewer substeps"""
MOST_CHANGE = 2.0
"""by how much substeps change at a time"""


class ErrorMonitor:
    """
    The estimates of one run.

    Parameters
    ----------
    simulation : what is stepped
    target : error of a frame to hold, RMS [m]; None: only look
    most : substeps to do it with

    """

    def __init__(self, simulation: Simulation, *, target: float | None, most: int):
        self.latest: Estimate | None = None
        """the last that counts"""
        self.all: list[Estimate] = []
        """all that count"""
        self.seconds = 0.0
        """of processor time that the estimates took"""
        self._simulation = simulation
        self._target, self._most = target, most
        self._least = simulation.solver.substeps if simulation.solver.method == 'explicit' else 1
        self._next = simulation.index + FIRST
        self._work = 0.0    # time that all frames took [s]
        self._pending: Future | None = None
        self._asked = 0    # frame of the pending one
        self._thread = ThreadPoolExecutor(1, thread_name_prefix='watch')

    def due(self) -> bool:
        """Tell whether the frame that comes next is to be looked at: to be kept while stepping."""
        return self._pending is None and self._simulation.index + 1 >= self._next

    def commands(self) -> list[SetKey]:
        """Return what the estimates say should change before the next frame."""
        if self._pending is None or self._simulation.index < self._asked + LATER:
            return []
        found, seconds = self._pending.result()
        self._pending = None
        self._next = self._asked + max(LATER + 1, ceil(found.frames / SHARE))
        self.latest = found
        self.all.append(found)
        self.seconds += seconds
        if self._target is None:
            return []
        solver = self._simulation.solver
        wanted = substeps_for(self.all, solver, self._target, least=self._least, most=self._most)
        return [] if wanted == solver.substeps else [SetKey('solver.substeps', wanted)]

    def look(self, seconds: float) -> None:
        """Take the frame just computed, which took so long, if it was kept."""
        simulation = self._simulation
        self._work += seconds
        if simulation.start is None:
            return
        self._asked = simulation.index
        self._pending = self._thread.submit(
            _timed, simulation.start, simulation.state.x.copy(), simulation.index,
            simulation.slot, largest_strain(simulation))

    @property
    def trouble(self) -> str:
        """What a user must know of the last estimate; nothing where all is well."""
        latest, substeps = self.latest, self._simulation.solver.substeps
        if latest is None:
            return ''
        if not latest.resolved:
            return (f'under-resolved: with {substeps} substeps the cloth is softer than asked; '
                    'give it more, or see xpbd_ros check')
        if self._target is not None and latest.rms > self._target and substeps >= self._most:
            return (f'error_target {self._target:g} m is not held: a frame is wrong by '
                    f'{latest.rms:.2g} m with max_substeps {self._most}')
        return ''

    def found(self) -> dict[str, float | int | str]:
        """Return what is known, for people."""
        stiffness, latest = stiffness_given(self._simulation), self.latest
        return {
            **({} if stiffness is None else {'effective_stiffness_share': stiffness[0],
                                             'residual_m': stiffness[1]}),
            **({} if latest is None else {
                'error_m': latest.rms if latest.resolved else 'under-resolved',
                'error_m_largest': latest.largest if latest.resolved else 'under-resolved',
                'error_frame': latest.frame}),
            'estimates': len(self.all),
            'estimates_share': self.seconds / self._work if self._work else 0.0}

    def summary(self) -> dict[str, float | int | None]:
        """Return what all estimates of a run say; None where none holds."""
        errors = [found.rms for found in self.all if found.resolved]
        return {'estimates': len(self.all),
                'under_resolved': sum(not found.resolved for found in self.all),
                'frame_rms_m': max(errors, default=None),
                'share': self.seconds / self._work if self._work else 0.0}

    def __str__(self) -> str:
        """Return the same in words."""
        told = self.summary()
        if not told['estimates']:
            return 'not estimated: too few frames'
        if told['under_resolved']:
            return (f"under-resolved in {told['under_resolved']} of {told['estimates']} frames "
                    'looked at; see xpbd_ros check')
        return (f"{told['frame_rms_m']:.2g} m in a frame at most, of {told['estimates']} looked "
                'at (RMS, estimated)')

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown()


def _timed(start, end, frame, slot, strain) -> tuple[Estimate, float]:
    begin = time.thread_time()
    return estimate(start, end, frame=frame, slot=slot, strain=strain), time.thread_time() - begin


def substeps_for(found: Sequence[Estimate], solver: Solver, target: float, *, least: int,
                 most: int) -> int:
    """
    Return the substeps with which the error of a frame meets a target.

    The error falls with the order of the integrator. The worst of the last estimates counts, and
    fewer substeps wait until there are RECENT. What is not resolved gets twice as many.
    """
    now = solver.substeps
    order = 1 if solver.integrator == 'backward_euler' else 2
    recent = found[-RECENT:]
    error = max(each.rms * (each.substeps / now)**order for each in recent)
    if not found[-1].resolved:
        factor = MOST_CHANGE
    elif SLACK * target <= error <= target or error < target and len(recent) < RECENT:
        factor = 1.0
    else:
        factor = (error / (MARGIN * target))**(1.0 / order)
        factor = min(max(factor, 1.0 / MOST_CHANGE), MOST_CHANGE)
    return min(max(ceil(factor * now), least), most)
