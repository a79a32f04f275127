"""Motion of a pin or a collider towards its target: interpolated, at a bounded speed."""

from math import sqrt

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Pose, Twist
from xpbd_ros.sim.geometry.quaternion import interpolate
from xpbd_ros.sim.target_stream import GAP_NS, Stream

MAX_TURN = 0.5
"""largest rotation in one frame [rad]; the remainder follows in later frames"""


class Motion:
    """
    A pose that follows targets.

    Targets with stamps are interpolated by their stamps and followed at a constant delay (see
    ``target_stream``). A target without a stamp is approached linearly over the time between its
    arrival and the previous one, so that targets slower than the frames give a steady velocity
    instead of one jump each.

    Parameters
    ----------
    pose : initial pose
    max_speed : bound of the speed [m/s]
    keyframes : function from the time since the scene's start, or the last reset, [s] to a
        position [m], followed until the first target; or None
    lever : distance from the pose at which rotation too must keep to max_speed [m]
    begins_at_target : True if the first target is taken at once, at any distance

    """

    def __init__(self, pose: Pose, max_speed: float, *, keyframes=None, lever: float = 0.1,
                 begins_at_target: bool = False):
        self.pose = self.start = pose
        self.target = pose
        self.max_speed = max_speed
        """[m/s]"""
        self.keyframes = keyframes
        self.lever = lever
        """[m]"""
        self.limited = False
        """True if max_speed or MAX_TURN kept the last frame from reaching its target"""
        self.stream: Stream | None = None
        """targets with stamps; None without"""
        self._left = 0.0
        self._begins_at_target = begins_at_target
        self._arrived_ns: int | None = None
        self._stamp_ns: int | None = None
        self._latest: Pose | None = None

    def begin(self, pose: Pose) -> None:
        """Take a pose at once and rest there."""
        self.pose = self.start = self.target = pose

    def aim(self, pose: Pose, twist: Twist | None, stamp_ns: int, now_ns: int) -> None:
        """
        Set a target at the simulation time ``now_ns`` [ns].

        A target stamped up to GAP_NS before the last one is ignored; a repeated message (equal
        stamp and pose) leaves a stream unchanged.
        """
        self.keyframes = None
        if self._begins_at_target:
            self.begin(pose)
            self._begins_at_target = False
        since = stamp_ns - self._stamp_ns if stamp_ns and self._stamp_ns else 0
        if -GAP_NS <= since < 0:
            return
        if 0 < since <= GAP_NS:
            if self.stream is None:
                assert self._stamp_ns is not None and self._arrived_ns is not None
                self.stream = Stream(self._stamp_ns, self.target, self._arrived_ns)
            self.stream.push(stamp_ns, pose, twist, now_ns, self.pose)
        elif not (self.stream is not None and stamp_ns == self._stamp_ns
                  and pose == self._latest):
            self._go(pose, twist, now_ns)
        self._latest, self._arrived_ns, self._stamp_ns = pose, now_ns, stamp_ns or None

    def _go(self, pose: Pose, twist: Twist | None, now_ns: int) -> None:
        """Approach a target linearly, over the time since the last one or at the twist's speed."""
        self.stream, self.target, self._left = None, pose, 0.0
        if self._arrived_ns is not None and now_ns - self._arrived_ns <= GAP_NS:
            self._left = (now_ns - self._arrived_ns) * 1e-9
        elif twist is not None and (speed := _norm(twist.linear)) > 0.0:
            self._left = min(_distance(pose, self.pose) / speed, GAP_NS * 1e-9)

    def stop(self) -> None:
        """Stop at the current pose."""
        self.target, self._left = self.pose, 0.0
        self.keyframes = self.stream = None

    def advance(self, end_ns: int, dt: float, age_ns: int = 0) -> None:
        """
        Advance ``pose`` by a frame of dt [s] that ends at ``end_ns`` [ns].

        ``age_ns`` is that time since the scene's start, or the last reset, which keyframes take.
        """
        self.start = self.pose
        if self.keyframes is not None:
            self.target = Pose(self.keyframes(age_ns * 1e-9), self.pose.orientation)
            self._left = 0.0
        elif self.stream is not None:
            self.target, self._left = self.stream.at(end_ns, round(dt * 1e9)), 0.0
        if self.target is self.pose:
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
        x, y, z = (a + s * slower * (b - a)
                   for a, b in zip(self.pose.position, self.target.position))
        self.pose = Pose((x, y, z), interpolate.py_func(
            self.pose.orientation, self.target.orientation, s * turn_slower))


def _norm(v) -> float:
    return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def _distance(a: Pose, b: Pose) -> float:
    return _norm([p - q for p, q in zip(a.position, b.position)])


def _angle(a: Pose, b: Pose) -> float:
    """Return 4 sin(θ/4) ≈ θ for the angle θ between two orientations [rad]."""
    p, q = a.orientation, b.orientation
    cosine = abs(p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3])
    return 2.0 * sqrt(2.0 * max(0.0, 1.0 - cosine))


def delays(what: str, motions: list[Motion]) -> dict[str, float]:
    """
    Return statistics of the streams of targets, keys prefixed by ``what``; empty without streams.

    They are the largest delay [s] and the number of poses that arrived too late.
    """
    streams = [motion.stream for motion in motions if motion.stream is not None]
    return {} if not streams else {
        f'{what}_delay_s': 1e-9 * max(stream.delay_ns for stream in streams),
        f'{what}s_late': sum(stream.late for stream in streams)}


def check_motion(points) -> None:
    """Raise InputError unless a scene's ``motion`` is None or rows (t, x, y, z) of rising t."""
    if points is None:
        return
    if not points or any(len(point) != 4 for point in points):
        raise InputError('motion: must be a list of [t, x, y, z] (s, m)')
    times = [point[0] for point in points]
    if any(b <= a for a, b in zip(times, times[1:])):
        raise InputError(f'motion: times must rise (got {times})')


def path_length(points) -> float:
    """Return the length of the path along a scene's ``motion`` [m]."""
    table = np.array(points, float)
    return float(np.linalg.norm(np.diff(table[:, 1:], axis=0), axis=1).sum())


class MonotoneCubic:
    """
    The monotone cubic interpolant of points (t, x, y, z) [s, m]: from time [s] to position [m].

    It is constant before the first point and after the last.
    """

    def __init__(self, points):
        from scipy.interpolate import PchipInterpolator

        self._points = points
        self._table = table = np.array(points, float)
        self._curve = PchipInterpolator(table[:, 0], table[:, 1:]) if len(table) > 1 else None

    def __reduce__(self):
        """Pickle the points: the interpolator follows from them."""
        return MonotoneCubic, (self._points,)

    def __call__(self, t: float) -> tuple[float, float, float]:
        """Return the position [m] at a time [s]."""
        if self._curve is None:
            return tuple(self._table[0, 1:].tolist())
        first, last = self._table[0, 0], self._table[-1, 0]
        return tuple(self._curve(min(max(t, first), last)).tolist())
