"""``/diagnostics``: how the node is doing, once a second."""

from collections import deque
from collections.abc import Iterable
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from xpbd_ros.ros.messages import set_stamp
from xpbd_ros.sim import measure

KEPT = 600
"""frames that the figures are taken over"""


def percentile(values: Iterable[float], share: float) -> float:
    """Return the value below which a share of the values lies; 0 without values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else 0.0


class Timing:
    """Times of the last frames."""

    def __init__(self):
        self.step_ms: deque[float] = deque(maxlen=KEPT)
        self._wall: deque[float] = deque(maxlen=KEPT)

    def add(self, step_ms: float, wall: float) -> None:
        """Note a frame that took ``step_ms`` and was done at the wall time ``wall`` [s]."""
        self.step_ms.append(step_ms)
        self._wall.append(wall)

    def real_time_factor(self, frame_dt: float) -> float:
        """Return simulated time over wall time of the last frames; 0 where there are too few."""
        if len(self._wall) < 2 or self._wall[-1] <= self._wall[0]:
            return 0.0
        return (len(self._wall) - 1) * frame_dt / (self._wall[-1] - self._wall[0])


class Status:
    """
    The status of a node: figures, and all that is wrong since the last one.

    Parameters
    ----------
    node : the ``ClothNode`` that it is of

    """

    def __init__(self, node):
        self.timing = Timing()
        self._node = node
        self.begin()

    def begin(self) -> None:
        """Count from now on."""
        self._jumps_ns: list[int] = []
        self._dropped_before = self._rolled_back_before = 0
        self._warned = ''
        self._now_ns = None

    def jumped(self, by_ns: int) -> None:
        """Note that the clock was set."""
        self._jumps_ns.append(by_ns)

    def message(self) -> DiagnosticArray:
        """Return the status."""
        node = self._node
        simulation, stepper, inbox, timing = node.simulation, node.stepper, node.inbox, self.timing
        now = time.monotonic()
        strain = measure.largest_strain(simulation)
        dropped = stepper.dropped if stepper else 0
        values = {
            'frame': simulation.index,
            'epoch_ns': node.stamps.epoch_ns,
            'stamps_moved_s': 1e-9 * node.stamps.moved_ns,
            'step_ms_p50': percentile(timing.step_ms, 0.5),
            'step_ms_p95': percentile(timing.step_ms, 0.95),
            'step_ms_max': max(timing.step_ms, default=0.0),
            'real_time_factor': timing.real_time_factor(simulation.frame_dt),
            'dropped_frames': dropped,
            'substeps': simulation.solver.substeps,
            'strain_max': strain,
            **node.watch.found(),
            'energy_j': measure.kinetic_energy(simulation.state)
            + measure.potential_energy(simulation.state),
            'rejected_inputs': sum(inbox.refused.values()),
            **{f'rejected {topic}': count for topic, count in sorted(inbox.refused.items())},
            **{f'age_s {topic}': now - then for topic, then in sorted(inbox.arrived.items())},
            **simulation.stats(),
            'bytes_recorded': node.recorder.log.bytes_written if node.recorder else 0,
        }
        level, summary = self._findings(dropped, values['frames_taken_back'])
        return message(node.get_fully_qualified_name().lstrip('/'), level, summary, values,
                       node.stamps.last_ns if node.makes_clock else node.now_ns())

    def _findings(self, dropped: int, rolled_back: int) -> tuple[str, str]:
        """Return the level of the status and its message."""
        node, log, errors, warnings = self._node, self._node.get_logger(), [], []
        if rolled_back > self._rolled_back_before:
            errors.append(f'{rolled_back - self._rolled_back_before} frames were not finite and '
                          'were taken back: the cloth stands still')
            log.error(errors[-1])
        if node.waits:
            warnings.append('use_sim_time: waiting for /clock')
        if self._jumps_ns:
            warnings.append(f'the clock jumped by {sum(self._jumps_ns) * 1e-9:+.3f} s; '
                            'stamps follow it')
        if dropped > self._dropped_before:
            warnings.append(f'{dropped - self._dropped_before} frames dropped in the last second: '
                            'too slow for real time')
            log.warning(warnings[-1])
        if node.watch.trouble:
            warnings.append(node.watch.trouble)
            if node.watch.trouble != self._warned:
                log.warning(node.watch.trouble)
        self._rolled_back_before, self._dropped_before = rolled_back, dropped
        self._warned = node.watch.trouble
        self._jumps_ns.clear()
        level = 'ERROR' if errors else 'WARN' if warnings else 'OK'
        return level, '; '.join(errors + warnings) or self._activity()

    def _activity(self) -> str:
        """Return whether the node steps, or what it waits for."""
        node = self._node
        if node.stepper is None or not node.stepper.free_running:
            return 'waiting'
        now_ns = node.now_ns()
        stands, self._now_ns = now_ns == self._now_ns, now_ns
        return 'waiting: /clock stands still' if node.follows_clock and stands else 'stepping'


def message(name: str, level: str, summary: str, values: dict, time_ns: int) -> DiagnosticArray:
    """Return one status; ``level`` is 'OK', 'WARN' or 'ERROR'."""
    status = DiagnosticStatus(
        level=getattr(DiagnosticStatus, level), name=f'{name}: simulation',
        hardware_id='xpbd_ros', message=summary,
        values=[KeyValue(key=key, value=f'{value:.6g}' if isinstance(value, float)
                         else str(value)) for key, value in values.items()])
    array = DiagnosticArray(status=[status])
    set_stamp(array.header.stamp, time_ns)
    return array
