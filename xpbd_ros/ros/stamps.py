"""
Stamps of frames: simulation time plus an epoch that follows the node's clock.

Simulation time is counted in frames and rises evenly. The clock goes on while the simulation is
paused, too slow or in lockstep, and it may be set. The epoch is constant while frames are computed
when they are due, and is corrected when they are not. Stamps rise strictly, unless the clock goes
back.
"""

STEADY_NS = 1_000_000
"""largest error of the epoch that is not corrected [ns]"""


class Stamps:
    """The stamps of the frames of one node."""

    def __init__(self):
        self.last_ns = 0
        """stamp of the last frame [ns]"""
        self.epoch_ns = 0
        """stamp less simulation time of the last frame [ns]"""
        self._begun_ns = 0
        self._now_ns = 0

    @property
    def moved_ns(self) -> int:
        """Change of the epoch since the start [ns]."""
        return self.epoch_ns - self._begun_ns

    def begin(self, time_ns: int, now_ns: int) -> int:
        """Return the stamp of the first frame [ns]."""
        self.at(time_ns, now_ns)
        self._begun_ns = self.epoch_ns
        return self.last_ns

    def even(self, time_ns: int) -> int:
        """Return the stamp of the next frame [ns] for a node that publishes /clock itself."""
        self.last_ns = self.epoch_ns + time_ns
        return self.last_ns

    def at(self, time_ns: int, now_ns: int, late_ns: int | None = None) -> int:
        """
        Return the stamp of the next frame [ns].

        Parameters
        ----------
        time_ns : simulation time of the frame [ns]
        now_ns : present time of the node's clock [ns]
        late_ns : time since the frame was due [ns]; None for a frame that is not due at a time

        """
        wanted = now_ns - (late_ns or 0)
        if late_ns is not None and abs(self.epoch_ns + time_ns - wanted) <= STEADY_NS:
            wanted = self.epoch_ns + time_ns
        if now_ns >= self._now_ns:
            wanted = max(wanted, self.last_ns + 1)
        self._now_ns, self.last_ns = now_ns, max(wanted, 0)
        self.epoch_ns = self.last_ns - time_ns
        return self.last_ns
