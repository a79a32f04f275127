"""
Robots in the node: joint states, link poses by forward kinematics, and grippers.

A gripper grasps when its joint goes below ``closed_below`` and releases when it goes above
``open_above``; in between, nothing changes. It tries once for each closing.
"""

from collections.abc import Callable, Mapping
from math import isfinite
from pathlib import Path

from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.wait_for_message import wait_for_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from xpbd_ros.errors import InputError
from xpbd_ros.ros.frame_follower import PoseSource
from xpbd_ros.ros.inputs import SECOND
from xpbd_ros.scene.robots import Robot
from xpbd_ros.scene.urdf import Description
from xpbd_ros.sim.commands import Command, Grasp, Pose, Release
from xpbd_ros.sim.geometry.pose import compose

DESCRIPTION_WAIT = 10.0
"""longest wait for the description of a robot [s]"""


def description_on(node, topic: str) -> str:
    """
    Return the URDF on a topic, latched by robot_state_publisher.

    Raises
    ------
    InputError : none arrives within DESCRIPTION_WAIT

    """
    there, message = wait_for_message(
        String, node, topic, time_to_wait=DESCRIPTION_WAIT,
        qos_profile=QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    if not there:
        raise InputError(f'no description on {node.resolve_topic_name(topic)} (std_msgs/String, '
                         f'transient local) in {DESCRIPTION_WAIT:g} s; is robot_state_publisher '
                         'running?')
    return message.data


class JointStates:
    """
    The latest positions of the joints on a topic.

    Parameters
    ----------
    topic : full name; several publishers and robots may share it
    now_ns : clock for messages without a stamp [ns]

    """

    def __init__(self, topic: str, now_ns: Callable[[], int]):
        self.topic, self._now_ns = topic, now_ns
        self.latest: Mapping[str, tuple[int, float]] = {}
        """stamp [ns] and position [m, rad] by joint; replaced as a whole"""

    def take(self, message: JointState) -> None:
        """Take the positions of a message; refuse it if they are not finite numbers, one each."""
        if not message.position:
            return    # velocities or efforts alone
        if len(message.position) != len(message.name) or not all(map(isfinite, message.position)):
            raise InputError(f'{len(message.name)} names and {len(message.position)} positions, '
                             'or some are not finite')
        sent_ns = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        stamp_ns = sent_ns or self._now_ns()
        self.latest = {**self.latest, **{name: (stamp_ns, position) for name, position
                                         in zip(message.name, message.position)}}

    def clear(self) -> None:
        """Forget all positions, after the clock went back."""
        self.latest = {}


class Kinematics:
    """
    A ``PoseSource`` of a robot's links: joint states and forward kinematics.

    Parameters
    ----------
    robot, states : the robot and its joints

    """

    def __init__(self, robot: Robot, states: JointStates):
        self.name, self._states, self._base = states.topic, states, robot.pose
        self._prefix = robot.keys.frame_prefix or ''
        self._description = Description(Path(robot.file), robot.text)
        self._computed: Mapping[str, float] | None = None
        """joint positions of the present poses"""

    def latest_ns(self, frame: str, source: str) -> int:
        """Return the stamp of its joints' latest positions [ns], once all are known."""
        return max((stamp_ns for stamp_ns, _ in self._latest().values()), default=0)

    def pose(self, frame: str, source: str, stamp_ns: int) -> Pose:
        """Return the latest pose of a link in the scene."""
        positions = {name: position for name, (_, position) in self._latest().items()}
        if positions != self._computed:
            self._description.move(positions)
            self._computed = positions
        return compose(self._base, self._description.pose(source.removeprefix(self._prefix)))

    def _latest(self) -> dict[str, tuple[int, float]]:
        """Return stamp and position of each of its joints; refuse it until all are known."""
        latest = self._states.latest
        missing = [name for name in self._description.joints if name not in latest]
        if missing:
            raise InputError(f'no position of {", ".join(missing)} on {self._states.topic}')
        return {name: latest[name] for name in self._description.joints}


class GripperFollower:
    """
    Grasp and release as a robot's gripper closes and opens.

    Parameters
    ----------
    robot : has a gripper
    states : its joints
    source : poses of its frame
    frame_id : TF frame of the scene
    now_ns : clock that silence is measured with [ns]
    warn : is given a warning if the position of the joint does not arrive

    """

    def __init__(self, robot: Robot, states: JointStates, source: PoseSource, frame_id: str, *,
                 now_ns: Callable[[], int], warn: Callable[[str], None]):
        assert robot.keys.gripper is not None and robot.grasp is not None
        self._robot, self._gripper, self._about = robot, robot.keys.gripper, robot.grasp
        self._states, self._source, self._frame_id = states, source, frame_id
        self._closed = False
        self._now_ns, self._warn = now_ns, warn
        self._begun_ns: int | None = None
        self._told = False

    def command(self, *, holds: bool, reset: bool) -> Command | None:
        """
        Return the command before the next frame, if any.

        Parameters
        ----------
        holds : whether the gripper's pin holds particles
        reset : whether the scene is reset before that frame

        """
        _, position = self._states.latest.get(self._gripper.joint, (0, None))
        if reset:
            self._closed = False
        if position is None:
            self._tell_missing()
            return None
        if self._closed and position > self._gripper.opens:
            self._closed = False
            return Release(self._robot.pin) if holds and not reset else None
        if not self._closed and position < self._gripper.closed_below:
            try:
                stamp_ns = self._source.latest_ns(self._frame_id, self._about.frame)
                pose = self._source.pose(self._frame_id, self._about.frame, stamp_ns)
            except InputError:
                return None    # the frame is not known yet
            self._closed = True
            return Grasp(self._robot.pin, pose, self._gripper.radius)
        return None

    def _tell_missing(self) -> None:
        """Warn once, after the robot's ``frame_timeout``, that the joint is not known."""
        now_ns = self._now_ns()
        if self._begun_ns is None or self._begun_ns > now_ns:
            self._begun_ns = now_ns
        if not self._told and 1e-9 * (now_ns - self._begun_ns) > self._about.timeout:
            self._told = True
            self._warn(f"robot '{self._robot.name}': no position of {self._gripper.joint} on "
                       f'{self._states.topic}, so its gripper does nothing')

    @property
    def open(self) -> bool:
        """True unless it is closed."""
        return not self._closed
