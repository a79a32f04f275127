"""
Interpolation of a stream of stamped poses, played back at a constant delay (a jitter buffer).

The times of the curve are the stamps, not the times of arrival. Its segments are cubic Hermite
polynomials, C¹ at the poses; the slope at a pose is the sender's twist where given, else that of
the parabola through neighbouring poses. Playback runs in simulation time, behind the sender by
one period of the stream, one frame, and one more period (at least UNEVEN_NS) for the jitter of
arrival. If a pose arrives later than that, the motion rests at the last pose, and the lag grows by
as much, so that later poses of the same lateness are on time. If the simulation is slower than the
sender, the excess of delay is reduced (CATCH_UP, TOO_LONG_NS): playback is faster than simulation
time.

Quaternions are interpolated by component and normalised, with IEEE operations only, so that all
platforms give the same bits.
"""

from math import sqrt
from typing import NamedTuple

from xpbd_ros.sim.commands import Pose, Twist

GAP_NS = 500_000_000
"""longest time between two targets of a stream [ns]"""
UNEVEN_NS = 20_000_000
"""least jitter of arrival that the delay covers [ns]"""
CATCH_UP = 0.1
"""time constant with which an excess of delay decays [s]"""
TOO_LONG_NS = 10**9
"""excess of delay above which playback skips to near the curve's end [ns]"""
LEAST_SQUARE = 0.01
"""least squared norm of an interpolated quaternion; below it, the angular velocity contradicts the
poses and the next pose's orientation is returned"""


class Knot(NamedTuple):
    """One pose of a stream."""

    stamp_ns: int
    pose: Pose
    values: tuple[float, ...]
    """x, y, z, qx, qy, qz, qw; the quaternion's sign is the nearer one to the previous knot's"""
    linear: tuple[float, ...] | None
    """velocity [m/s]; None if not given"""
    angular: tuple[float, ...] | None
    """time derivative of the quaternion [1/s]; None if not given"""


class Stream:
    """
    The interpolant of one stream's poses, and the position of playback.

    Parameters
    ----------
    stamp_ns, pose : stamp [ns] and value of the first pose, where the curve is at rest
    arrived_ns : simulation time of its arrival [ns]

    """

    def __init__(self, stamp_ns: int, pose: Pose, arrived_ns: int):
        self.delay_ns = 0
        """time from the arrival of a pose that is on time to its playback [ns]; 0 before the first
        frame"""
        self.late = 0
        """number of poses that arrived after the curve's end was reached"""
        self._knots = [_rest(stamp_ns, pose)]
        self._at = 0    # index of the knot that was played last
        # at both ends of the segment that begins there
        self._slopes: tuple[tuple, tuple] | None = None
        self._lag_ns = arrived_ns - stamp_ns    # simulation time of arrival less stamp
        self._period_ns = 0
        self._given = [False, False]

    @property
    def last_ns(self) -> int:
        """Stamp of the last pose [ns]."""
        return self._knots[-1].stamp_ns

    def _played_ns(self, now_ns: int) -> int:
        return now_ns - self._lag_ns - self.delay_ns

    def push(self, stamp_ns: int, pose: Pose, twist: Twist | None, now_ns: int,
             here: Pose) -> None:
        """
        Append a pose.

        Parameters
        ----------
        stamp_ns, pose, twist : target, its stamp [ns] after the last one, and its velocity
        now_ns : simulation time [ns]
        here : current pose of the motion

        """
        last = self._knots[-1]
        self._knots.append(self._knot(last, stamp_ns, pose, twist))
        if not self._period_ns:
            self._period_ns = stamp_ns - last.stamp_ns
        if not self.delay_ns or self._played_ns(now_ns) <= self._knots[0].stamp_ns:
            self._lag_ns = max(self._lag_ns, now_ns - stamp_ns)    # playback has not begun
            return
        played = self._played_ns(now_ns)
        ahead = stamp_ns - played
        if played > last.stamp_ns:    # the motion rests at the last pose
            if ahead < self._period_ns:
                self.late += 1
                self._lag_ns += self.delay_ns - ahead
                played = stamp_ns - self._period_ns
            self._start_again(played, here)
        elif ahead > self.delay_ns + TOO_LONG_NS:
            self._lag_ns -= ahead - self.delay_ns
            self._start_again(stamp_ns - self.delay_ns, here)

    def _knot(self, last: Knot, stamp_ns: int, pose: Pose, twist: Twist | None) -> Knot:
        """
        Return a pose as a knot.

        A zero linear or angular velocity counts as "not given" until a nonzero one has arrived:
        senders leave twists empty.
        """
        given: list[tuple[float, ...] | None] = [None, None]
        values = _near(last.values, pose)
        if twist is not None:
            for k, part in enumerate((twist.linear, twist.angular)):
                self._given[k] = self._given[k] or any(part)
                given[k] = part if self._given[k] else None
        angular = None if given[1] is None else _rate(given[1], values[3:])
        return Knot(stamp_ns, pose, values, given[0], angular)

    def _start_again(self, at_ns: int, here: Pose) -> None:
        """Restart the curve at rest ``here`` at a stamp; keep knots at least a period later."""
        knots, self._knots = self._knots, [_rest(at_ns, here)]
        for knot in knots:
            if knot.stamp_ns >= at_ns + self._period_ns:
                self._knots.append(knot._replace(values=_near(self._knots[-1].values, knot.pose)))
        self._at, self._slopes = 0, None

    def at(self, end_ns: int, frame_ns: int) -> Pose:
        """Advance playback by a frame that ends at ``end_ns`` and return the pose there."""
        spare = max(self._period_ns, UNEVEN_NS)
        if not self.delay_ns:
            self.delay_ns = self._period_ns + spare + frame_ns
        too_long = self.last_ns - self._played_ns(end_ns) - self.delay_ns - spare
        if too_long > 0:
            self._lag_ns -= round(too_long * min(1.0, 1e-9 * frame_ns / CATCH_UP))
        played, knots = self._played_ns(end_ns), self._knots
        while self._at + 1 < len(knots) and played >= knots[self._at + 1].stamp_ns:
            begin = self._segment()[1]
            self._at += 1
            self._slopes = None
            if self._at + 1 < len(knots):
                self._slopes = begin, self._slope(self._at + 1)
        if self._at > 1:
            del knots[:self._at - 1]
            self._at = 1
        knot = knots[self._at]
        if self._at + 1 == len(knots) or played <= knot.stamp_ns:
            return knot.pose
        return _between(knot, knots[self._at + 1], *self._segment(), played)

    def _segment(self) -> tuple[tuple, tuple]:
        """Return the slopes at both ends of the current segment, computed once per segment."""
        if self._slopes is None:
            self._slopes = self._slope(self._at), self._slope(self._at + 1)
        return self._slopes

    def _slope(self, k: int) -> tuple[float, ...]:
        """Return the derivative at a knot: as given, else of the parabola through three knots."""
        knots, knot = self._knots, self._knots[k]
        if knot.linear is not None and knot.angular is not None:
            return *knot.linear, *knot.angular
        if k + 1 < len(knots):
            first, second, third = knots[k - 1:k + 2]
            share = (knot.stamp_ns - first.stamp_ns) / (third.stamp_ns - first.stamp_ns)
            slope = _mix(_chord(first, knot), _chord(knot, third), share)
        elif k > 1:
            first, second = knots[k - 2:k]
            share = (knot.stamp_ns - second.stamp_ns) / (knot.stamp_ns - first.stamp_ns)
            slope = _mix(_chord(second, knot), _chord(first, second), -share)
        else:
            slope = _chord(knots[k - 1], knot)
        return *(knot.linear or slope[:3]), *(knot.angular or slope[3:])


def _rest(stamp_ns: int, pose: Pose) -> Knot:
    return Knot(stamp_ns, pose, (*pose.position, *pose.orientation), (0.0,) * 3, (0.0,) * 4)


def _near(before: tuple[float, ...], pose: Pose) -> tuple[float, ...]:
    """Return a pose as (x, y, z, quaternion), with the quaternion's sign nearest to ``before``."""
    a, q = before[3:], pose.orientation
    if a[0] * q[0] + a[1] * q[1] + a[2] * q[2] + a[3] * q[3] < 0.0:
        q = -q[0], -q[1], -q[2], -q[3]
    return *pose.position, *q


def _rate(w, q) -> tuple[float, ...]:
    """Return dq/dt = (w, 0) q / 2 for an angular velocity w in world axes [rad/s]."""
    return (0.5 * (w[0] * q[3] + w[1] * q[2] - w[2] * q[1]),
            0.5 * (w[1] * q[3] + w[2] * q[0] - w[0] * q[2]),
            0.5 * (w[2] * q[3] + w[0] * q[1] - w[1] * q[0]),
            -0.5 * (w[0] * q[0] + w[1] * q[1] + w[2] * q[2]))


def _chord(a: Knot, b: Knot) -> tuple[float, ...]:
    per = 1e9 / (b.stamp_ns - a.stamp_ns)
    return tuple([(q - p) * per for p, q in zip(a.values, b.values)])


def _mix(a, b, share: float) -> tuple[float, ...]:
    return tuple([p + share * (q - p) for p, q in zip(a, b)])


def _between(a: Knot, b: Knot, begin, end, played_ns: int) -> Pose:
    """Return the pose on the cubic Hermite segment with slopes ``begin`` and ``end`` [1/s]."""
    length_ns = b.stamp_ns - a.stamp_ns
    s, h = (played_ns - a.stamp_ns) / length_ns, 1e-9 * length_ns
    r = 1.0 - s
    # Hermite basis: of the difference of the end points, of the slopes at either end
    ones, first, second = s * s * (1.0 + 2.0 * r), h * s * r * r, -h * s * s * r
    x, y, z, qx, qy, qz, qw = [
        p + ones * (q - p) + first * u + second * v
        for p, q, u, v in zip(a.values, b.values, begin, end)]
    square = qx * qx + qy * qy + qz * qz + qw * qw
    if square < LEAST_SQUARE:
        return Pose((x, y, z), b.pose.orientation)
    n = sqrt(square)
    return Pose((x, y, z), (qx / n, qy / n, qz / n, qw / n))
