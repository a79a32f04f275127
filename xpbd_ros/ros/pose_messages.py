"""
Poses in messages of other programs: which types hold them, and how to read each.

Each reader is a pure function of one message, and raises ``InputError`` with the reason.
"""

from collections.abc import Callable
import struct
from typing import Any, NamedTuple

from xpbd_ros.errors import counted, InputError
from xpbd_ros.ros.inputs import nanoseconds, pose
from xpbd_ros.sim.commands import Pose

TF_MESSAGE = 'tf2_msgs/msg/TFMessage'
JOINT_STATE = 'sensor_msgs/msg/JointState'
TRAJECTORY = 'trajectory_msgs/msg/MultiDOFJointTrajectory'


class Sample(NamedTuple):
    """One stamped pose."""

    joint: str
    """name of the joint; empty where a message has one pose"""
    stamp_ns: int
    """0: not given"""
    frame: str
    """TF frame that the pose is given in; empty: the scene's"""
    pose: Pose


class Transform(NamedTuple):
    """One transform of TF."""

    parent: str
    child: str
    stamp_ns: int
    pose: Pose
    """of the child in the parent"""


class Trajectory(NamedTuple):
    """The poses that joints take, by the time from the trajectory's start."""

    frame: str
    joints: tuple[str, ...]
    times_ns: tuple[int, ...]
    """rising [ns]"""
    poses: tuple[tuple[Pose, ...], ...]
    """by point and joint"""


def _stamp(message) -> tuple[int, str]:
    return nanoseconds(message.header.stamp, 'header: stamp'), message.header.frame_id


def _of_pose(message) -> list[Sample]:
    stamp_ns, frame = _stamp(message)
    return [Sample('', stamp_ns, frame, pose(message.pose.position, message.pose.orientation,
                                             'pose'))]


def _of_inner_pose(message) -> list[Sample]:
    stamp_ns, frame = _stamp(message)
    inner = message.pose.pose
    return [Sample('', stamp_ns, frame, pose(inner.position, inner.orientation, 'pose'))]


def _of_transform(message) -> list[Sample]:
    stamp_ns, frame = _stamp(message)
    found = message.transform
    return [Sample('', stamp_ns, frame, pose(found.translation, found.rotation, 'transform'))]


def _of_joints(message) -> list[Sample]:
    stamp_ns, frame = _stamp(message)
    _check_count(message.transforms, message.joint_names)
    return [Sample(name, stamp_ns, frame, pose(each.translation, each.rotation, name))
            for name, each in zip(message.joint_names, message.transforms)]


def _check_count(found, names, of: str = '') -> None:
    if len(found) != len(names):
        raise InputError(f'{counted(len(names), "name")} but '
                         f'{counted(len(found), "transform")}{of}')


SAMPLES: dict[str, Callable[[Any], list[Sample]]] = {
    'geometry_msgs/msg/PoseStamped': _of_pose,
    'geometry_msgs/msg/PoseWithCovarianceStamped': _of_inner_pose,
    'geometry_msgs/msg/TransformStamped': _of_transform,
    'nav_msgs/msg/Odometry': _of_inner_pose,
    'sensor_msgs/msg/MultiDOFJointState': _of_joints,
}
"""readers of types whose messages hold present poses"""
TYPES = (*SAMPLES, TRAJECTORY)
"""types that move pins and colliders by their topic"""


def read_trajectory(message) -> Trajectory:
    """Read a trajectory_msgs/MultiDOFJointTrajectory."""
    times: list[int] = []
    poses: list[tuple[Pose, ...]] = []
    for point in message.points:
        time_ns = nanoseconds(point.time_from_start, 'time_from_start')
        if times and time_ns <= times[-1]:
            raise InputError('time_from_start does not rise from point to point')
        _check_count(point.transforms, message.joint_names, ' of a point')
        times.append(time_ns)
        poses.append(tuple(pose(each.translation, each.rotation, name)
                           for name, each in zip(message.joint_names, point.transforms)))
    if not times:
        raise InputError('a trajectory without points')
    return Trajectory(message.header.frame_id, tuple(message.joint_names), tuple(times),
                      tuple(poses))


class _Translation(NamedTuple):
    x: float
    y: float
    z: float


class _Rotation(NamedTuple):
    x: float
    y: float
    z: float
    w: float


def read_transforms(raw: bytes) -> list[Transform]:
    """
    Read a serialized tf2_msgs/TFMessage.

    By hand, since tf2_msgs is in no wheel: a sequence of (stamp, parent, child, translation,
    rotation) in CDR, where numbers are aligned to their size, counted from behind its header.
    """
    try:
        return list(_transforms(memoryview(raw)[4:], '<' if raw[1] & 1 else '>'))
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise InputError(f'cannot be unpacked ({error})') from None


def _transforms(data: memoryview, order: str):
    stamp, length = struct.Struct(f'{order}iI'), struct.Struct(f'{order}I')
    numbers = struct.Struct(f'{order}7d')
    count, at = *length.unpack_from(data), length.size
    for _ in range(count):
        at += -at % 4
        seconds, nanoseconds_ = stamp.unpack_from(data, at)
        at += stamp.size
        names = []
        for _ in range(2):
            at += -at % 4
            size, = length.unpack_from(data, at)
            at += length.size + size
            names.append(str(data[at - size:at - 1], 'utf-8'))
        at += -at % 8
        values = numbers.unpack_from(data, at)
        at += numbers.size
        parent, child = (name.lstrip('/') for name in names)
        yield Transform(parent, child, seconds * 10**9 + nanoseconds_, pose(
            _Translation(*values[:3]), _Rotation(*values[3:]), child))
