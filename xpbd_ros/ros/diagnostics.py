"""``/diagnostics``: how the node is doing, once a second."""

from collections import deque
from collections.abc import Iterable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from xpbd_ros.ros.messages import set_stamp

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
