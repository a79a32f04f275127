"""
Estimate the error of a running simulation, and adapt the substeps to hold a target.

From time to time a frame is computed again with more substeps (``sim/stepping/error_estimate``),
in a thread of its own while the simulation goes on. The interval between estimates follows from
their work, which stays below SHARE of that of the frames. A result is used exactly LATER frames
after its frame, not when it happens to be ready, so that the substeps depend on the scene and its
inputs alone.
"""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from math import ceil, nan
import time

from xpbd_ros.log.background import lower_priority
from xpbd_ros.sim.commands import SetKey
from xpbd_ros.sim.measure import largest_strain, stiffness_given
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stepping.error_estimate import Estimate, estimate
from xpbd_ros.sim.stepping.solver import Solver

FIRST = 10
"""first frame whose error is estimated"""
LATER = 30
"""delay until a result is used [frames]"""
SHARE = 0.02
"""work of the estimates over that of all frames, at most"""
MARGIN = 0.8
"""error that new substeps aim at, over the target"""
SLACK = 0.25
"""error over the target below which substeps are reduced"""
NICE = 10
"""increment of the thread's nice value"""
RECENT = 3
"""latest estimates of which the largest error decides"""
MOST_CHANGE = 2.0
"""largest factor by which substeps change at a time"""


class ErrorMonitor:
    """
    Error estimates of one run.

    Parameters
    ----------
    simulation : the running simulation
    target : error of a frame to hold, RMS over the particles [m]; None to estimate only
    most : largest number of substeps

    """

    def __init__(self, simulation: Simulation, *, target: float | None, most: int):
        self.latest: Estimate | None = None
        """latest estimate in use"""
        self.arrived: Estimate | None = None
        """estimate that is in use from the next frame on; None before other frames"""
        self.recent: tuple[Estimate, ...] = ()
        """latest RECENT estimates, the latest last"""
        self.count = 0
        """number of estimates"""
        self.seconds = 0.0
        """processor time of the estimates [s]"""
        self._simulation = simulation
        self._target, self._most = target, most
        self._largest: float | None = None    # error of all resolved estimates [m]
        self._under_resolved = self._above = 0    # estimates not resolved, and above the target
        self._least = simulation.solver.substeps if simulation.solver.method == 'explicit' else 1
        self._next = simulation.index + FIRST
        self._work = 0.0    # time of all frames [s]
        self._pending: Future | None = None
        self._asked = 0    # frame of the pending estimate
        self._thread = ThreadPoolExecutor(1, thread_name_prefix='error_estimate',
                                          initializer=lower_priority, initargs=(NICE,))

    def due(self) -> bool:
        """Return whether the next frame's error is due: then its start is kept while stepping."""
        return self._pending is None and self._simulation.index + 1 >= self._next

    def commands(self) -> list[SetKey]:
        """Return the change of substeps before the next frame; empty for none."""
        self.arrived = None
        if self._pending is None or self._simulation.index < self._asked + LATER:
            return []
        found, seconds = self._pending.result()
        self._pending = None
        self._next = self._asked + max(LATER + 1, ceil(found.frames / SHARE))
        self.arrived = found
        self.take(found)
        self.seconds += seconds
        if self._target is None:
            return []
        solver = self._simulation.solver
        wanted = substeps_for(self.recent, solver, self._target, least=self._least,
                              most=self._most)
        return [] if wanted == solver.substeps else [SetKey('solver.substeps', wanted)]

    def take(self, found: Estimate) -> None:
        """Use an estimate, and count it."""
        self.latest, self.recent = found, (*self.recent, found)[-RECENT:]
        self.count += 1
        self._above += self._target is not None and found.rms > self._target
        self._under_resolved += not found.resolved
        if found.resolved:
            self._largest = max(found.rms, self._largest or 0.0)

    def look(self, seconds: float) -> None:
        """Estimate the error of the frame just computed in ``seconds``, if it was kept."""
        simulation = self._simulation
        self._work += seconds
        if simulation.start is None:
            return
        self._asked = simulation.index
        self._pending = self._thread.submit(
            _timed, simulation.start, simulation.state.x.copy(), simulation.index,
            simulation.slot, largest_strain(simulation))

    def values(self) -> dict[str, float]:
        """Return the values for the log, by topic, if an estimate came with this frame."""
        found = self.arrived
        return {} if found is None else {
            'error_estimate/frame': float(found.frame),
            'error_estimate/rms': found.rms if found.resolved else nan}

    @property
    def warning(self) -> str:
        """Warning about the latest estimate; empty if there is none."""
        latest, substeps = self.latest, self._simulation.solver.substeps
        if latest is None:
            return ''
        if not latest.resolved:
            return (f'under-resolved: with {substeps} substeps the cloth is softer than asked; '
                    'increase them, or see xpbd_ros check')
        if self._target is not None and latest.rms > self._target:
            text = f'error_target {self._target:g} m is not held'
            error = f'the error of a frame is {latest.rms:.2g} m with'
            if substeps >= self._most:
                return f'{text}: {error} max_substeps {self._most}'
            if latest.substeps < substeps:
                text += ' yet'
            return f'{text}: {error} {latest.substeps} substeps, and the next have {substeps}'
        return ''

    def diagnostics(self) -> dict[str, float | int | str]:
        """Return the values for ``/diagnostics``."""
        stiffness, latest = stiffness_given(self._simulation), self.latest
        return {
            **({} if stiffness is None else {'effective_stiffness_share': stiffness[0],
                                             'residual_m': stiffness[1]}),
            **({} if latest is None else {
                'error_m': latest.rms if latest.resolved else 'under-resolved',
                'error_m_largest': latest.largest if latest.resolved else 'under-resolved',
                'error_frame': latest.frame}),
            'estimates': self.count,
            'estimates_share': self.seconds / self._work if self._work else 0.0}

    def summary(self) -> dict[str, float | int | None]:
        """Return a summary of all estimates of a run; the error is None if none is resolved."""
        return {'estimates': self.count, 'under_resolved': self._under_resolved,
                'frame_rms_m': self._largest,
                'share': self.seconds / self._work if self._work else 0.0}

    def __str__(self) -> str:
        """Return the summary as text."""
        told = self.summary()
        if not told['estimates']:
            return 'not estimated: too few frames'
        if told['under_resolved']:
            return (f"under-resolved in {told['under_resolved']} of {told['estimates']} frames "
                    'estimated; see xpbd_ros check')
        text = (f"{told['frame_rms_m']:.2g} m in a frame at most (RMS), of {told['estimates']} "
                'estimated')
        if self._target is None:
            return text
        return f'{text}, {self._above or "none"} of them above error_target {self._target:g} m'

    def close(self) -> None:
        """Stop the thread."""
        self._thread.shutdown()


def _timed(start, end, frame, slot, strain) -> tuple[Estimate, float]:
    begin = time.thread_time()
    return estimate(start, end, frame=frame, slot=slot, strain=strain), time.thread_time() - begin


def substeps_for(found: Sequence[Estimate], solver: Solver, target: float, *, least: int,
                 most: int) -> int:
    """
    Return the substeps with which the error of a frame meets a target.

    The error falls with the order of the integrator. The largest of the latest RECENT estimates
    decides, and substeps fall only once there are so many. They double while the latest estimate
    is not resolved.

    Parameters
    ----------
    found : all estimates so far
    solver : present substeps and integrator
    target : error of a frame, RMS [m]
    least, most : bounds of the substeps
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
