"""How a pin or a collider follows its target: in a line, at a bounded speed, without ringing."""

from math import sqrt

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Pose, Twist
from xpbd_ros.sim.rotation import interpolate

GAP_NS = 500_000_000
"""targets further apart than this are not a stream [ns]"""
MAX_TURN = 0.5
"""largest turn in one frame [rad]; what is left follows in the next"""


class Motion:
    """
    A pose on its way to a target.

    Targets that come as a stream are followed at the stream's own speed: each is reached when the
    next is due (by the senders' stamps, else by when they arrived), so a stream slower than the
    frames does not ring. ``keyframes`` is a function of time [s] to a position, followed until the
    first target.
    """

    def __init__(self, pose: Pose, max_speed: float, *, keyframes=None, lever: float = 0.1):
        self.pose = self.start = pose
        self.target = pose
        self.max_speed = max_speed
        """[m/s]"""
        self.keyframes = keyframes
        self.lever = lever
        """distance from the pose at which the turn too must keep to max_speed [m]"""
        self.limited = False
        """whether the last frame fell behind its target"""
        self._left = 0.0
        self._arrived_ns = self._stamp_ns = None

    def aim(self, pose: Pose, twist: Twist | None, stamp_ns: int, now_ns: int) -> None:
        """Set a new target at the simulation time ``now_ns``."""
        period_ns = 0
        if stamp_ns and self._stamp_ns and 0 < stamp_ns - self._stamp_ns <= GAP_NS:
            period_ns = stamp_ns - self._stamp_ns
        elif self._arrived_ns is not None and now_ns - self._arrived_ns <= GAP_NS:
            period_ns = now_ns - self._arrived_ns
        self._left = period_ns * 1e-9
        speed = 0.0 if twist is None else _norm(twist.linear)
        if speed > 0.0:
            self._left = min(_distance(pose, self.pose) / speed, GAP_NS * 1e-9)
        self._arrived_ns, self._stamp_ns = now_ns, stamp_ns or None
        self.target, self.keyframes = pose, None

    def stop(self) -> None:
        """Stay where it is."""
        self.target, self._left, self.keyframes = self.pose, 0.0, None

    def advance(self, end_ns: int, dt: float) -> None:
        """Move on by one frame: from ``start`` to ``pose``."""
        self.start = self.pose
        if self.keyframes is not None:
            self.target = Pose(self.keyframes(end_ns * 1e-9), self.pose.orientation)
            self._left = 0.0
        if self.target is self.pose:    # there already
            self._left, self.limited = 0.0, False
            return
        s = min(1.0, dt / self._left) if self._left > 0.0 else 1.0
        self._left = max(0.0, self._left - dt)
        distance = s * _distance(self.target, self.pose)
        turn = s * _angle(self.target, self.pose)
        largest_turn = min(MAX_TURN, self.max_speed * dt / self.lever)
        slower = min(1.0, self.max_speed * dt / distance if distance > 0.0 else 1.0)
        turn_slower = min(1.0, largest_turn / turn if turn > 0.0 else 1.0)
        self.limited = slower < 1.0 or turn_slower < 1.0
        if s * slower == 1.0 and s * turn_slower == 1.0:
            self.pose = self.target
            return
        position = tuple(a + s * slower * (b - a)
                         for a, b in zip(self.pose.position, self.target.position))
        self.pose = Pose(position, interpolate.py_func(
            self.pose.orientation, self.target.orientation, s * turn_slower))


def _norm(v) -> float:
    return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def _distance(a: Pose, b: Pose) -> float:
    return _norm([p - q for p, q in zip(a.position, b.position)])


def _angle(a: Pose, b: Pose) -> float:
    """Return 4 sin(θ/4), which is the angle between two orientations while it is small [rad]."""
    p, q = a.orientation, b.orientation
    cosine = abs(p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3])
    return 2.0 * sqrt(2.0 * max(0.0, 1.0 - cosine))


def check_motion(points) -> None:
    """Refuse a scene's ``motion`` that is no path: rows of t, x, y, z with t rising."""
    if points is None:
        return
    if not points or any(len(point) != 4 for point in points):
        raise InputError('motion: must be a list of [t, x, y, z] (s, m)')
    times = [point[0] for point in points]
    if any(b <= a for a, b in zip(times, times[1:])):
        raise InputError(f'motion: times must rise (got {times})')


def monotone_cubic(points, begin: float = 0.0):
    """
    Join points (t, x, y, z) by monotone cubics, held at the ends: a function of time [s].

    The points' own time starts at ``begin`` [s].
    """
    from scipy.interpolate import PchipInterpolator

    table = np.array(points, float)
    if len(table) == 1:
        return lambda t: tuple(table[0, 1:].tolist())
    curve = PchipInterpolator(table[:, 0], table[:, 1:])
    return lambda t: tuple(curve(min(max(t - begin, table[0, 0]), table[-1, 0])).tolist())
