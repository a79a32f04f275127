"""
When frames are from: simulation time, and the clock of those who listen, which are two things.

Simulation time is counted in frames and rises evenly. A clock does not wait for it while the
simulation is paused, too slow, or waits to be asked, and it may be set. So the stamp of a frame is
its simulation time plus an epoch that follows the clock: it stays what it is while frames come
when they are due, and moves where they do not. Stamps rise, unless the clock itself goes back.
"""

STEADY_NS = 1_000_000
"""an epoch stays, while it is no more wrong than that [ns]"""


class Stamps:
    """The stamps of the frames of one node."""

    def __init__(self):
        self.last_ns = 0
        """the last stamp [ns]"""
        self.epoch_ns = 0
        """of the last frame: its stamp less its simulation time [ns]"""
        self._begun_ns = 0
        self._now_ns = 0

    @property
    def moved_ns(self) -> int:
        """How far they have moved against simulation time since the start [ns]."""
        return self.epoch_ns - self._begun_ns

    def begin(self, time_ns: int, now_ns: int) -> int:
        """Return the stamp of a frame that time starts from."""
        self.at(time_ns, now_ns)
        self._begun_ns = self.epoch_ns
        return self.last_ns

    def even(self, time_ns: int) -> int:
        """Return the stamp of the next frame, on a clock that is simulation time itself."""
        self.last_ns = self.epoch_ns + time_ns
        return self.last_ns

    def at(self, time_ns: int, now_ns: int, late_ns: int | None = None) -> int:
        """
        Return the stamp of the next frame on a clock that reads ``now_ns``.

        ``late_ns`` is how long ago the frame was due; None for one that has no such time.
        """
        wanted = now_ns - (late_ns or 0)
        if late_ns is not None and abs(self.epoch_ns + time_ns - wanted) <= STEADY_NS:
            wanted = self.epoch_ns + time_ns
        if now_ns >= self._now_ns:
            wanted = max(wanted, self.last_ns + 1)
        self._now_ns, self.last_ns = now_ns, max(wanted, 0)
        self.epoch_ns = self.last_ns - time_ns
        return self.last_ns
