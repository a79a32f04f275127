"""
A stream of stamped poses, rebuilt: a smooth curve through them, played back at a constant delay.

What arrives unevenly was sent at the times that its stamps tell. So the poses are joined by their
stamps, by cubics whose velocities meet (C¹): those of the sender's twists where they are given,
else those of parabolas through neighbours. The curve is played back in simulation time, behind
the sender by a period of the stream, a frame, and another period (at least UNEVEN_NS) for
unevenness of arrival. A pose that is later still is waited for, and from then on counts as one
that comes in time, so that the next do not have to be waited for. Where the simulation is slower
than the sender, the curve is played faster.

Orientations are joined as quaternions, component by component, and made unit again: IEEE
operations alone, so same bits anywhere.
"""

from math import sqrt
from typing import NamedTuple

from xpbd_ros.sim.commands import Pose, Twist

GAP_NS = 500_000_000
"""targets further apart than this are not a stream [ns]"""
UNEVEN_NS = 20_000_000
"""least unevenness of arrival that the delay makes up for [ns]"""
CATCH_UP = 0.1
"""in this time what is too much of a delay falls to 1/e [s]"""
TOO_LONG_NS = 10**9
"""a delay that is too long by more than this is cut: the curve starts again near its end [ns]"""
LEAST_SQUARE = 0.01
"""of a quaternion between two; less comes of a twist that has nothing to do with the poses"""


class Knot(NamedTuple):
    """One pose of a stream."""

    stamp_ns: int
    pose: Pose
    values: tuple[float, ...]
    """x y z, qx qy qz qw; the quaternion has the sign that is nearer to the one before"""
    linear: tuple[float, ...] | None
    """velocity, where it is given [m/s]"""
    angular: tuple[float, ...] | None
    """rate of the quaternion, where it is given [1/s]"""


class Stream:
    """
    The curve through the poses of one stream, and how far it has been played.

    Parameters
    ----------
    stamp_ns, pose : of its first pose, where the curve is at rest
    arrived_ns : simulation time at which that came [ns]

    """

    def __init__(self, stamp_ns: int, pose: Pose, arrived_ns: int):
        self.delay_ns = 0
        """from when a pose comes in time to when it is reached [ns]"""
        self.late = 0
        """poses that had to be waited for"""
        self._knots = [_rest(stamp_ns, pose)]
        self._at = 0    # the knot that was played last
        self._slopes: tuple | None = None    # at both ends of the segment that begins there
        self._lag_ns = arrived_ns - stamp_ns    # what it takes to come: simulation time less stamp
        self._period_ns = 0
        self._given = [False, False]

    @property
    def last_ns(self) -> int:
        """Stamp of the last pose."""
        return self._knots[-1].stamp_ns

    def _played_ns(self, now_ns: int) -> int:
        return now_ns - self._lag_ns - self.delay_ns

    def push(self, stamp_ns: int, pose: Pose, twist: Twist | None, now_ns: int,
             here: Pose) -> None:
        """Take the next pose at the simulation time ``now_ns``, the motion being ``here``."""
        last = self._knots[-1]
        self._knots.append(self._knot(last, stamp_ns, pose, twist))
        if not self._period_ns:
            self._period_ns = stamp_ns - last.stamp_ns
        if not self.delay_ns or self._played_ns(now_ns) <= self._knots[0].stamp_ns:
            self._lag_ns = max(self._lag_ns, now_ns - stamp_ns)    # nothing moves yet
            return
        played = self._played_ns(now_ns)
        ahead = stamp_ns - played
        if played > last.stamp_ns:    # it rests at the last pose
            if ahead < self._period_ns:
                self.late += 1
                self._lag_ns += self.delay_ns - ahead
                played = stamp_ns - self._period_ns
            self._start_again(played, here)
        elif ahead > self.delay_ns + TOO_LONG_NS:
            self._lag_ns -= ahead - self.delay_ns
            self._start_again(stamp_ns - self.delay_ns, here)

    def _knot(self, last: Knot, stamp_ns: int, pose: Pose, twist: Twist | None) -> Knot:
        """Return a pose as a knot. Zeros are a velocity where others were given before."""
        given = [None, None]
        values = _near(last.values, pose)
        if twist is not None:
            for k, part in enumerate((twist.linear, twist.angular)):
                self._given[k] = self._given[k] or any(part)
                given[k] = part if self._given[k] else None
        angular = None if given[1] is None else _rate(given[1], values[3:])
        return Knot(stamp_ns, pose, values, given[0], angular)

    def _start_again(self, at_ns: int, here: Pose) -> None:
        """Go from rest at a time of the sender's to what comes at least a period later."""
        knots, self._knots = self._knots, [_rest(at_ns, here)]
        for knot in knots:
            if knot.stamp_ns >= at_ns + self._period_ns:
                self._knots.append(knot._replace(values=_near(self._knots[-1].values, knot.pose)))
        self._at, self._slopes = 0, None

    def at(self, end_ns: int, frame_ns: int) -> Pose:
        """Play on by a frame, up to the simulation time ``end_ns``, and return the pose there."""
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

    def _segment(self) -> tuple:
        """Return the slopes at both ends of the segment that is played; they stay."""
        if self._slopes is None:
            self._slopes = self._slope(self._at), self._slope(self._at + 1)
        return self._slopes

    def _slope(self, k: int) -> tuple[float, ...]:
        """Return the rate of a knot's values: as given, else of the parabola through three."""
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
    """Return a pose's values, the quaternion with the sign that is nearer to the one before."""
    a, q = before[3:], pose.orientation
    if a[0] * q[0] + a[1] * q[1] + a[2] * q[2] + a[3] * q[3] < 0.0:
        q = -q[0], -q[1], -q[2], -q[3]
    return *pose.position, *q


def _rate(w, q) -> tuple[float, ...]:
    """Return dq/dt = (w, 0) q / 2 for an angular velocity in world axes [rad/s]."""
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
    """Return the pose on the cubic from one knot to the next, with these slopes at its ends."""
    length_ns = b.stamp_ns - a.stamp_ns
    s, h = (played_ns - a.stamp_ns) / length_ns, 1e-9 * length_ns
    r = 1.0 - s
    # of the second end, and of the slopes
    ones, first, second = s * s * (1.0 + 2.0 * r), h * s * r * r, -h * s * s * r
    x, y, z, qx, qy, qz, qw = [
        p + ones * (q - p) + first * u + second * v
        for p, q, u, v in zip(a.values, b.values, begin, end)]
    square = qx * qx + qy * qy + qz * qz + qw * qw
    if square < LEAST_SQUARE:
        return Pose((x, y, z), b.pose.orientation)
    n = sqrt(square)
    return Pose((x, y, z), (qx / n, qy / n, qz / n, qw / n))
