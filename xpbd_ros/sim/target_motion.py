"""How a pin or a collider follows its target: in a line, at a bounded speed, without ringing."""

from math import sqrt

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Pose, Twist
from xpbd_ros.sim.geometry.quaternion import interpolate
from xpbd_ros.sim.target_stream import GAP_NS, Stream

MAX_TURN = 0.5
"""largest turn in one frame [rad]; what is left follows in the next"""


class Motion:
    """
    A pose on its way to a target.

    A stream of targets with stamps is rebuilt from them (see ``stream``), at a constant delay.
    Targets without stamps are each reached when the next is due, by when they arrived, so a
    stream slower than the frames does not ring. ``keyframes`` is a function of time [s] to a
    position, followed until the first target.
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
        self.stream: Stream | None = None
        """of targets with stamps"""
        self._left = 0.0
        self._arrived_ns = self._stamp_ns = self._latest = None

    def aim(self, pose: Pose, twist: Twist | None, stamp_ns: int, now_ns: int) -> None:
        """Set a new target at the simulation time ``now_ns``; one from before the last is none."""
        self.keyframes = None
        since = stamp_ns - self._stamp_ns if stamp_ns and self._stamp_ns else 0
        if -GAP_NS <= since < 0:
            return
        if 0 < since <= GAP_NS:
            if self.stream is None:
                self.stream = Stream(self._stamp_ns, self.target, self._arrived_ns)
            self.stream.push(stamp_ns, pose, twist, now_ns, self.pose)
        elif not (self.stream is not None and stamp_ns == self._stamp_ns
                  and pose == self._latest):    # else the same message once more
            self._go(pose, twist, now_ns)
        self._latest, self._arrived_ns, self._stamp_ns = pose, now_ns, stamp_ns or None

    def _go(self, pose: Pose, twist: Twist | None, now_ns: int) -> None:
        """Go straight to a target: in the time since the last one, or at a given speed."""
        self.stream, self.target, self._left = None, pose, 0.0
        if self._arrived_ns is not None and now_ns - self._arrived_ns <= GAP_NS:
            self._left = (now_ns - self._arrived_ns) * 1e-9
        elif twist is not None and (speed := _norm(twist.linear)) > 0.0:
            self._left = min(_distance(pose, self.pose) / speed, GAP_NS * 1e-9)

    def stop(self) -> None:
        """Stay where it is."""
        self.target, self._left = self.pose, 0.0
        self.keyframes = self.stream = None

    def advance(self, end_ns: int, dt: float) -> None:
        """Move on by one frame: from ``start`` to ``pose``."""
        self.start = self.pose
        if self.keyframes is not None:
            self.target = Pose(self.keyframes(end_ns * 1e-9), self.pose.orientation)
            self._left = 0.0
        elif self.stream is not None:
            self.target, self._left = self.stream.at(end_ns, round(dt * 1e9)), 0.0
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


def delays(what: str, motions: list[Motion]) -> dict[str, float]:
    """Return how late streams of targets are followed [s] and how many targets came too late."""
    streams = [motion.stream for motion in motions if motion.stream is not None]
    return {} if not streams else {
        f'{what}_delay_s': 1e-9 * max(stream.delay_ns for stream in streams),
        f'{what}s_late': sum(stream.late for stream in streams)}


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
