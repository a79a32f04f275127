"""Logs of another program: a tool that moves on a circle, seen by TF, trackers and a planner."""

from math import cos, sin
from pathlib import Path
import random
from typing import NamedTuple

from mcap.writer import CompressionType, Writer
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer as BagWriter
from rosbags.typesys import get_typestore, Stores

from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.pose import compose, inverse

STORE = get_typestore(Stores.ROS2_JAZZY)
START = 1_700_000_000_000_000_000
"""log time of the first message [ns]"""
LATENCY = 0.03
"""from the stamp of a message to its log time [s]"""
HALF = 0.5**0.5
BASE = Pose((0.3, -0.2, 0.1), (0.0, 0.0, HALF, HALF))
"""of the TF frame 'base' in 'world'"""
RADIUS, SPEED = 0.1, 0.25
"""of the circle [m, m/s]"""


class Written(NamedTuple):
    """A message, serialized."""

    time: float
    """[s]"""
    topic: str
    type: str
    data: bytes


def tool(time: float) -> Pose:
    """Return the pose of the tool in 'world' at a time [s]: on a circle, turning with it."""
    angle = SPEED / RADIUS * time
    return Pose((-0.2 + RADIUS * sin(angle), -0.2, 0.3 - RADIUS * cos(angle)),
                (0.0, sin(0.5 * angle), 0.0, cos(0.5 * angle)))


def robot_log(seconds: float = 2.0, *, seed: int = 3) -> list[Written]:
    """
    Return the messages of a robot's log, in the order of their times.

    /tf_static has world → base once, /tf base → tool at 50 Hz, /tool_pose the same at 30 Hz (in
    'base'), /trackers 'hand' and 'ball' at 100 Hz (in 'world'), /status a text.
    """
    found = [written(0.0, '/tf_static', 'tf2_msgs/msg/TFMessage', transforms=[
        transform_stamped(0.0, 'world', 'base', BASE)])]
    found += [written(t + LATENCY, '/tf', 'tf2_msgs/msg/TFMessage', transforms=[
        transform_stamped(t, 'base', 'tool', in_base(t))]) for t in times(seconds, 50)]
    found += [pose_written(t, '/tool_pose', 'base', in_base(t)) for t in times(seconds, 30)]
    found += [written(t + LATENCY, '/trackers', 'sensor_msgs/msg/MultiDOFJointState',
                      header=header(t, 'world'), joint_names=['hand', 'ball'],
                      transforms=[transform(tool(t)), transform(tool(t + 0.4))], twist=[],
                      wrench=[]) for t in times(seconds, 100)]
    found += [written(t, '/status', 'std_msgs/msg/String', data='well')
              for t in times(seconds, 1)]
    random.Random(seed).shuffle(found)
    return sorted(found, key=lambda each: each.time)


def times(seconds: float, rate: float) -> list[float]:
    """Return the times of a stream [s]."""
    return [k / rate for k in range(round(seconds * rate))]


def in_base(time: float) -> Pose:
    """Return the pose of the tool in 'base'."""
    return compose(inverse(BASE), tool(time))


def written(time: float, topic: str, type_name: str, **fields) -> Written:
    """Return a message of a topic."""
    return Written(time, topic, type_name, bytes(STORE.serialize_cdr(
        make(type_name, **fields), type_name)))


def make(type_name: str, **fields):
    """Return a message object."""
    return STORE.types[type_name](**fields)


def header(time: float, frame: str):
    """Return a header with a stamp."""
    seconds, nanoseconds = divmod(START + round(1e9 * time), 10**9)
    return make('std_msgs/msg/Header', frame_id=frame, stamp=make(
        'builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds))


def transform(pose: Pose):
    """Return a transform."""
    x, y, z, w = pose.orientation
    return make('geometry_msgs/msg/Transform', rotation=make(
        'geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w), translation=make(
            'geometry_msgs/msg/Vector3', **dict(zip('xyz', pose.position))))


def transform_stamped(time: float, parent: str, child: str, pose: Pose):
    """Return a stamped transform."""
    return make('geometry_msgs/msg/TransformStamped', header=header(time, parent),
                child_frame_id=child, transform=transform(pose))


def pose_written(time: float, topic: str, frame: str, pose: Pose) -> Written:
    """Return a geometry_msgs/PoseStamped."""
    x, y, z, w = pose.orientation
    return written(time + LATENCY, topic, 'geometry_msgs/msg/PoseStamped',
                   header=header(time, frame), pose=make(
                       'geometry_msgs/msg/Pose', orientation=make(
                           'geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w),
                       position=make('geometry_msgs/msg/Point', **dict(zip('xyz',
                                                                           pose.position)))))


def joint_states(time: float, **positions: float) -> Written:
    """Return a sensor_msgs/JointState on /joint_states."""
    return written(time, '/joint_states', 'sensor_msgs/msg/JointState', header=header(time, ''),
                   name=list(positions), position=np.array(list(positions.values())),
                   velocity=np.array([]), effort=np.array([]))


def plan(time: float, joints: list[str], points: list[tuple[float, list[Pose]]]) -> Written:
    """Return a trajectory_msgs/MultiDOFJointTrajectory on /plan, with points (time, poses)."""
    def point(since: float, poses: list[Pose]):
        return make('trajectory_msgs/msg/MultiDOFJointTrajectoryPoint',
                    transforms=[transform(pose) for pose in poses], velocities=[],
                    accelerations=[], time_from_start=make(
                        'builtin_interfaces/msg/Duration', sec=int(since),
                        nanosec=round(1e9 * (since % 1.0))))
    return written(time, '/plan', 'trajectory_msgs/msg/MultiDOFJointTrajectory',
                   header=header(0.0, 'world'), joint_names=joints,
                   points=[point(*each) for each in points])


def write_bag(folder: Path, messages: list[Written], storage: str) -> Path:
    """Write a log: 'sqlite3' or 'mcap' as rosbags does, 'plain' as an MCAP file in disorder."""
    if storage == 'plain':
        return _write_plain(folder.with_suffix('.mcap'), messages)
    with BagWriter(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as bag:
        connections = {}
        for each in messages:
            if each.topic not in connections:
                connections[each.topic] = bag.add_connection(each.topic, each.type,
                                                             typestore=STORE)
            bag.write(connections[each.topic], START + round(1e9 * each.time), each.data)
    return folder


def _write_plain(path: Path, messages: list[Written]) -> Path:
    """Write an MCAP file without chunks, with messages up to 0.2 s late."""
    noise = random.Random(5)
    with open(path, 'wb') as file:
        log = Writer(file, compression=CompressionType.NONE, use_chunking=False)
        log.start('ros2', 'another')
        channels = {}
        for each in sorted(messages, key=lambda each: each.time + noise.uniform(0.0, 0.2)):
            if each.topic not in channels:
                schema = log.register_schema(each.type, 'ros2msg', STORE.generate_msgdef(
                    each.type, ros_version=2)[0].encode())
                channels[each.topic] = log.register_channel(each.topic, 'cdr', schema)
            log_ns = START + round(1e9 * each.time)
            log.add_message(channels[each.topic], log_ns, each.data, log_ns)
        log.finish()
    return path
