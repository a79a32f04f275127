"""The clock of a replay: log time that advances at a rate of a steady clock, and can be paused."""

from collections.abc import Callable
import math
import time


class Playhead:
    """
    A clock in log time.

    Parameters
    ----------
    time_ns
        Log time to start from [ns].
    rate
        Log time per wall time.
    paused
        Whether it is paused at first.
    clock
        A steady clock [ns].

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
        """Present log time [ns]."""
        if self.paused:
            return self._log_ns
        return self._log_ns + round((self._clock() - self._steady_ns) * self.rate)

    def jump(self, time_ns: int) -> None:
        """Set the log time [ns]."""
        self._log_ns, self._steady_ns = time_ns, self._clock()

    def pause(self) -> None:
        """Stop the clock."""
        self.jump(self.time_ns)
        self.paused = True

    def resume(self) -> None:
        """Continue from the present log time."""
        self.jump(self.time_ns)
        self.paused = False

    def set_rate(self, rate: float) -> None:
        """Continue at another rate."""
        self.jump(self.time_ns)
        self.rate = rate

    def wait(self, time_ns: int) -> float:
        """Return the wall time until a log time [s]; 0 if it has passed, infinite while paused."""
        if self.paused:
            return math.inf
        return max(0.0, (time_ns - self.time_ns) * 1e-9 / self.rate)
