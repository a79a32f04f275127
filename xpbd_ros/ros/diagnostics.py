"""The node's status on ``/diagnostics``, once a second."""

from collections import deque
from collections.abc import Iterable
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from xpbd_ros.errors import counted
from xpbd_ros.ros.guards import LOST
from xpbd_ros.ros.messages import set_stamp
from xpbd_ros.ros.services import WAITING
from xpbd_ros.sim import measure

KEPT = 600
"""latest frames that times and percentiles cover"""


def percentile(values: Iterable[float], share: float) -> float:
    """Return the value below which a share (0 to 1) of the values lies; 0 without values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else 0.0


class Timing:
    """Step times and completion times of the last KEPT frames."""

    def __init__(self):
        self.step_ms: deque[float] = deque(maxlen=KEPT)
        self._wall: deque[float] = deque(maxlen=KEPT)

    def add(self, step_ms: float, wall: float) -> None:
        """Add a frame that took ``step_ms`` [ms] and was completed at wall time ``wall`` [s]."""
        self.step_ms.append(step_ms)
        self._wall.append(wall)

    def real_time_factor(self, frame_dt: float) -> float:
        """Return simulated time over wall time of the last frames; 0 with fewer than two."""
        if len(self._wall) < 2 or self._wall[-1] <= self._wall[0]:
            return 0.0
        return (len(self._wall) - 1) * frame_dt / (self._wall[-1] - self._wall[0])


class Status:
    """
    The status of a node: numbers, and the errors and warnings since the previous status.

    Parameters
    ----------
    node : the ``ClothNode`` to report on

    """

    def __init__(self, node):
        self.timing = Timing()
        self._node = node
        self.begin()

    def begin(self) -> None:
        """Start counting events."""
        self._jumps_ns: list[int] = []
        self._dropped_before = self._rolled_back_before = self._alone_before = 0
        self._warned = ''
        self._now_ns = None
        self.lost_log = ''
        """why there is no log that should be, until there is one again; else empty"""

    def jumped(self, by_ns: int) -> None:
        """Count a jump of the clock [ns]."""
        self._jumps_ns.append(by_ns)

    def log_lost(self, why: str) -> None:
        """Log why there is no log, and report it until there is one again."""
        self.lost_log = why
        self._node.get_logger().error(why)

    def look(self, *, heard: bool) -> DiagnosticArray | None:
        """Log new errors and warnings; return the status as a message if it is heard."""
        node = self._node
        dropped, stats = node.stepper.dropped if node.stepper else 0, node.simulation.stats()
        level, summary = self._findings(dropped, stats)
        return message(
            node.get_fully_qualified_name().lstrip('/'), level, summary,
            self._values(dropped, stats),
            node.stamps.last_ns if node.makes_clock else node.now_ns()) if heard else None

    def _values(self, dropped: int, stats: dict[str, float]) -> dict:
        """Return the values of the status."""
        node = self._node
        simulation, timing = node.simulation, self.timing
        accepted, refused = node.command_queue.arrived, node.command_queue.refused
        now = time.monotonic()
        return {
            'frame': simulation.index,
            'epoch_ns': node.stamps.epoch_ns,
            'stamps_moved_s': 1e-9 * node.stamps.moved_ns,
            'step_ms_p50': percentile(timing.step_ms, 0.5),
            'step_ms_p95': percentile(timing.step_ms, 0.95),
            'step_ms_max': max(timing.step_ms, default=0.0),
            'real_time_factor': timing.real_time_factor(simulation.frame_dt),
            'dropped_frames': dropped,
            'method': simulation.setting.method,
            'substeps': simulation.setting.substeps,
            'strain_max': measure.largest_strain(simulation),
            **node.error_monitor.diagnostics(),
            'energy_j': measure.kinetic_energy(simulation.state)
            + measure.potential_energy(simulation.state),
            'rejected_inputs': sum(refused.values()),
            **{f'rejected {topic}': count for topic, count in sorted(refused.items())},
            **{f'age_s {topic}': now - then for topic, then in sorted(accepted.items())},
            **node.following.diagnostics(),
            **stats,
            **node.interaction.clouds.values,
            'bytes_recorded': node.recorder.log.bytes_written if node.recorder else 0,
        }

    def _findings(self, dropped: int, stats: dict[str, float]) -> tuple[str, str]:
        """Log new errors and warnings; return the level of the status and its text."""
        node, log, errors, warnings = self._node, self._node.get_logger(), [], []
        rolled_back = int(stats['frames_taken_back'])
        alone = int(stats.get('frames_on_one_thread', 0))
        if rolled_back > self._rolled_back_before:
            errors.append(f'{counted(rolled_back - self._rolled_back_before, "frame")} rolled '
                          'back, not finite or implausible: the cloth stands still')
            log.error(errors[-1])
        if self.lost_log:
            errors.append(self.lost_log)
        if node.waits:
            warnings.append(WAITING)
        names = node.get_node_names_and_namespaces()
        if names.count((node.get_name(), node.get_namespace())) > 1:
            warnings.append(f'another node is also named {node.get_fully_qualified_name()}, so '
                            'that their topics and services collide: rename one (--ros-args -r '
                            '__node:=...); a node that was killed stays listed for some seconds')
            log.warning(warnings[-1], throttle_duration_sec=60.0)
        if self._jumps_ns:
            warnings.append(f'the clock jumped by {sum(self._jumps_ns) * 1e-9:+.3f} s; '
                            'stamps follow it')
        if dropped > self._dropped_before:
            warnings.append(f'{counted(dropped - self._dropped_before, "frame")} dropped in the '
                            'last second: too slow for real time')
            log.warning(warnings[-1])
        if alone > self._alone_before:
            warnings.append(f'{counted(alone - self._alone_before, "frame")} of the last second '
                            'done by one thread: other programs use the cores of the others; free '
                            'some, or take fewer solver.threads')
            log.warning(warnings[-1], throttle_duration_sec=60.0)
        lost = [f'{stats[name]} {text}' for name, text in LOST.items() if stats.get(name)]
        if lost:
            warnings += lost
            log.warning('; '.join(lost), throttle_duration_sec=60.0)
        if node.following.finding:
            warnings.append(node.following.finding)
        if node.error_monitor.warning:
            warnings.append(node.error_monitor.warning)
            if node.error_monitor.warning != self._warned:
                log.warning(node.error_monitor.warning)
        self._rolled_back_before, self._dropped_before = rolled_back, dropped
        self._alone_before = alone
        self._warned = node.error_monitor.warning
        self._jumps_ns.clear()
        level = 'ERROR' if errors else 'WARN' if warnings else 'OK'
        return level, '; '.join(errors + warnings) or self._activity()

    def _activity(self) -> str:
        """Return 'stepping', or 'waiting' with the reason if there is a particular one."""
        node = self._node
        if node.stepper is None or not node.stepper.free_running:
            return 'waiting'
        now_ns = node.now_ns()
        stands, self._now_ns = now_ns == self._now_ns, now_ns
        return 'waiting: /clock stands still' if node.follows_clock and stands else 'stepping'


def message(name: str, level: str, summary: str, values: dict, time_ns: int) -> DiagnosticArray:
    """Return a message with one status; ``level`` is 'OK', 'WARN' or 'ERROR'."""
    status = DiagnosticStatus(
        level=getattr(DiagnosticStatus, level), name=f'{name}: simulation',
        hardware_id='xpbd_ros', message=summary,
        values=[KeyValue(key=key, value=f'{value:.6g}' if isinstance(value, float)
                         else str(value)) for key, value in values.items()])
    array = DiagnosticArray(status=[status])
    set_stamp(array.header.stamp, time_ns)
    return array
