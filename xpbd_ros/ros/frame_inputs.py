"""
Transform inputs that are stamped in a TF frame other than the scene's.

The transform is that at the message's stamp (stamp 0: the latest). A message whose transform has
not arrived waits for at most WAIT, without blocking, and keeps its place among the messages of its
topic; then it is refused with the reason. tf2 is imported, and ``/tf`` subscribed, with the first
such message, which waits up to FIRST_WAIT, for discovery. A twist gets the velocity of its TF
frame added, the mean over the span before its stamp:

    v = V + Ω × (p - P) + R v',   ω = Ω + R ω'

with the frame's pose P, R and velocity V, Ω in the scene, and p the transformed position. Wind is
rotated only.
"""

from collections import deque
from collections.abc import Callable
import time
from typing import Any, NamedTuple

from geometry_msgs.msg import Point, Quaternion, Vector3
import numpy as np
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker

from xpbd_ros.errors import InputError
from xpbd_ros.ros.clouds import transform_points
from xpbd_ros.ros.inputs import nanoseconds
from xpbd_ros.ros.tf import Transforms
from xpbd_ros.sim.commands import Pose, Twist
from xpbd_ros.sim.geometry.pose import compose
from xpbd_ros.sim.geometry.quaternion import multiply, rotate, turns

WAIT = 0.2
"""longest wait for a transform [s]"""
FIRST_WAIT = 2.0
"""longest wait in the time after ``/tf`` is subscribed [s]"""
PERIOD = 0.005
"""period at which waiting messages are tried again [s]"""
SPAN_NS = 10_000_000
"""time over which the velocity of a TF frame is measured [ns]"""
MAX_WAITING = 256
"""messages of one topic that wait for a transform, at most"""

Lookup = Callable[[str, int, str], Pose]
"""(TF frame, stamp [ns], name for errors) -> its pose in the scene's frame"""
Velocity = Callable[[str, int, str], Twist]
"""(TF frame, stamp [ns], name for errors) -> its velocity in the scene's frame"""


class NotYet(Exception):    # noqa: N818 – no error: the message is tried again
    """A transform has not arrived, and may still."""


class Waiting(NamedTuple):
    """A message that waits."""

    until: float
    """[s, monotonic]"""
    raw: bytes
    kind: type
    read: Callable


class FrameInputs:
    """
    Takes messages in any TF frame.

    Parameters
    ----------
    node : creates the subscriptions and the timer
    frame_id : TF frame of the scene
    take : is given (topic, serialized message, type, reader) of each message to read now
    refuse : is given (topic, reason)

    """

    def __init__(self, node, frame_id: str, take: Callable, refuse: Callable[[str, str], None]):
        self._node, self._frame_id = node, frame_id
        self._take, self._refuse = take, refuse
        self._waiting: dict[str, deque[Waiting]] = {}
        self._transforms: Transforms | None = None
        self._opened = 0.0    # time of the subscription [s, monotonic]
        self._timer: Any = None

    def transforms(self) -> Transforms:
        """Return the transforms; import tf2 and subscribe with the first call."""
        if self._transforms is None:
            self._transforms = Transforms(self._node)
            self._opened = time.monotonic()
        return self._transforms

    def clear(self) -> None:
        """Forget transforms, after the clock went back."""
        if self._transforms is not None:
            self._transforms.clear()

    def take(self, topic: str, raw: bytes, kind: type, read: Callable) -> None:
        """Take a message now, or once its transform has arrived."""
        queue = self._waiting.get(topic, ())
        if not queue and self._try(topic, raw, kind, read, final=False):
            return
        if len(queue) >= MAX_WAITING:
            self._refuse(topic, f'more than {MAX_WAITING} messages wait for a transform')
            return
        until = max(time.monotonic() + WAIT, self._opened + FIRST_WAIT)
        self._waiting.setdefault(topic, deque()).append(Waiting(until, raw, kind, read))
        if self._timer is None:
            self._timer = self._node.create_timer(
                PERIOD, self._again, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._timer.reset()

    def _again(self) -> None:
        """Try the waiting messages again, in order."""
        for topic, queue in list(self._waiting.items()):
            while queue:
                first = queue[0]
                if not self._try(topic, first.raw, first.kind, first.read,
                                 final=time.monotonic() >= first.until):
                    break
                queue.popleft()
            else:
                del self._waiting[topic]
        if not self._waiting and self._timer is not None:
            self._timer.cancel()

    def _try(self, topic: str, raw: bytes, kind: type, read: Callable, *, final: bool) -> bool:
        """Take a message, or return False if it has to wait; ``final``: it must not."""
        def lookup(frame: str, stamp_ns: int, what: str) -> Pose:
            return self._lookup(frame, stamp_ns, what, final=final)

        def velocity(frame: str, stamp_ns: int, what: str) -> Twist:
            return self._velocity(frame, stamp_ns, what, final=final)

        def read_here(message):
            to_scene_frame(message, self._frame_id, lookup, velocity)
            return read(message)
        try:
            self._take(topic, raw, kind, read_here)
        except NotYet:
            return False
        return True

    def _lookup(self, frame: str, stamp_ns: int, what: str, *, final: bool) -> Pose:
        told = f"{what}: TF frame '{frame}' is not the scene's '{self._frame_id}'"
        try:
            transforms = self.transforms()
        except InputError as error:
            raise InputError(f'{told}; transforming it {error}') from None
        try:
            return transforms.pose(self._frame_id, frame, stamp_ns)
        except InputError as error:
            if final or self._is_past(transforms, frame, stamp_ns):
                raise InputError(f'{told}; {error}') from None
        raise NotYet

    def _velocity(self, frame: str, stamp_ns: int, what: str, *, final: bool) -> Twist:
        """Return the velocity of a TF frame, after ``_lookup`` of its pose; static ones rest."""
        latest_ns = self.transforms().latest_ns(self._frame_id, frame)
        if latest_ns == 0:
            return Twist()
        end_ns = stamp_ns or latest_ns
        before, now = (self._lookup(frame, at_ns, f'{what}: twist', final=final)
                       for at_ns in (end_ns - SPAN_NS, end_ns))
        return twist_between(before, now, 1e-9 * SPAN_NS)

    def _is_past(self, transforms: Transforms, frame: str, stamp_ns: int) -> bool:
        """Return whether later transforms have arrived already, so that waiting is vain."""
        try:
            return transforms.latest_ns(self._frame_id, frame) >= stamp_ns > 0
        except InputError:
            return False

    def close(self) -> None:
        """Drop waiting messages, and destroy the timer and the subscriptions."""
        self._waiting.clear()
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        if self._transforms is not None:
            self._transforms.close()
        self._timer = self._transforms = None


def twist_between(before: Pose, now: Pose, dt: float) -> Twist:
    """Return the mean velocity from one pose to another in ``dt`` [s]."""
    turn, = turns(np.array([before.orientation]), np.array([now.orientation]))
    way = np.subtract(now.position, before.position)
    return Twist(tuple((way / dt).tolist()), tuple((turn / dt).tolist()))


def to_scene_frame(message, frame_id: str, lookup: Lookup, velocity: Velocity) -> None:
    """Transform a message to the scene's TF frame, in place; one without another is unchanged."""
    if hasattr(message, 'markers'):
        for marker in message.markers:
            if marker.action == Marker.ADD:
                _transform(marker, marker.header, f'marker {marker.ns}/{marker.id}', frame_id,
                           lookup, velocity)
            marker.header.frame_id = frame_id
    elif hasattr(message, 'header'):
        _transform(message, message.header, 'header', frame_id, lookup, velocity)


def _transform(message, header, what: str, frame_id: str, lookup: Lookup,
               velocity: Velocity) -> None:
    """Transform what a message holds below one header."""
    if header.frame_id in ('', frame_id):
        return
    stamp_ns = nanoseconds(header.stamp, f'{what}: stamp')
    frame = lookup(header.frame_id, stamp_ns, what)
    if hasattr(message, 'pose'):
        _move(message.pose.position, message.pose.orientation, frame)
    for each in getattr(message, 'transforms', ()):
        _move(each.translation, each.rotation, frame)
    if getattr(message, 'twist', ()):
        moving = velocity(header.frame_id, stamp_ns, what)
        for each, place in zip(message.twist, message.transforms):
            _carry(each, place.translation, frame, moving)
    if isinstance(getattr(message, 'vector', None), Vector3):
        _turn(message.vector, frame)
    if isinstance(getattr(message, 'point', None), Point):
        _move(message.point, Quaternion(), frame)
    if isinstance(message, PointCloud2):
        transform_points(message, frame)
    header.frame_id = frame_id


def _carry(twist, position, frame: Pose, moving: Twist) -> None:
    """Rotate a twist in place, and add the velocity of its TF frame at a position in the scene."""
    _turn(twist.linear, frame)
    _turn(twist.angular, frame)
    arm = np.subtract((position.x, position.y, position.z), frame.position)
    for vector, added in ((twist.linear, np.add(moving.linear, np.cross(moving.angular, arm))),
                          (twist.angular, moving.angular)):
        x, y, z = map(float, added)
        vector.x, vector.y, vector.z = vector.x + x, vector.y + y, vector.z + z


def _move(position, orientation, frame: Pose) -> None:
    """Transform a position and an orientation in place."""
    p, q = position, orientation
    p.x, p.y, p.z = compose(frame, Pose((p.x, p.y, p.z))).position
    q.x, q.y, q.z, q.w = multiply(frame.orientation, (q.x, q.y, q.z, q.w))


def _turn(vector, frame: Pose) -> None:
    """Rotate a vector in place."""
    vector.x, vector.y, vector.z = rotate.py_func(*frame.orientation, vector.x, vector.y,
                                                  vector.z)
