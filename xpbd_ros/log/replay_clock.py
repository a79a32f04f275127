"""Where in a log's time a replay is: a steady clock times a rate, which can stand still."""

from collections.abc import Callable
import math
import time


class Playhead:
    """
    A clock in log time.

    Parameters
    ----------
    time_ns
        Log time to start from (ns).
    rate
        Log time that passes per wall time.
    paused
        Whether it stands still at first.
    clock
        A steady clock (ns).

    """

    def __init__(self, time_ns: int, *, rate: float = 1.0, paused: bool = False,
                 clock: Callable[[], int] = time.monotonic_ns):
        self.rate = rate
        self.paused = paused
        self._clock = clock
        self._log_ns = time_ns      # log time and steady time of the same moment
        self._steady_ns = clock()

    @property
    def time_ns(self) -> int:
        """Log time now (ns)."""
        if self.paused:
            return self._log_ns
        return self._log_ns + round((self._clock() - self._steady_ns) * self.rate)

    def jump(self, time_ns: int) -> None:
        """Go to a log time, and on from there unless paused."""
        self._log_ns, self._steady_ns = time_ns, self._clock()

    def pause(self) -> None:
        """Stand still."""
        self.jump(self.time_ns)
        self.paused = True

    def resume(self) -> None:
        """Go on from where it stands."""
        self.jump(self.time_ns)
        self.paused = False

    def wait(self, time_ns: int) -> float:
        """Return the wall time until a log time (s): 0 if it has come, infinite while paused."""
        if self.paused:
            return math.inf
        return max(0.0, (time_ns - self.time_ns) * 1e-9 / self.rate)
