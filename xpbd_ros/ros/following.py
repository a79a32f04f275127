"""TF and joint states of a node: followers, grippers, and inputs in other TF frames."""

from collections.abc import Callable, Sequence
from importlib.util import find_spec

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from xpbd_ros.errors import InputError
from xpbd_ros.ros.frame_follower import FrameFollower, PoseSource
from xpbd_ros.ros.frame_inputs import FrameInputs
from xpbd_ros.scene.frames import followers
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import Grasp, Reset
from xpbd_ros.sim.simulation import Simulation

DEPTH = 50
"""depth of the subscriptions to joint states [messages]"""


class Following:
    """
    TF frames and robots of a configured node.

    Parameters
    ----------
    node : the ``ClothNode``
    scene, simulation : of the node
    take : is given (topic, serialized message, type, reader) of each message to read now

    Raises
    ------
    InputError : the scene names a TF frame, and tf2_ros is not installed

    """

    def __init__(self, node, scene: Scene, simulation: Simulation, take: Callable):
        self._node, self._simulation = node, simulation
        self._frame_id = scene.top.frame_id
        self.inputs = FrameInputs(node, self._frame_id, take, node.command_queue.refuse)
        self._joint_states: dict = {}    # by topic
        self._subscriptions: list = []
        self._grippers: list = []
        try:
            sources = self._sources(scene)
        except InputError as error:
            self.close()
            raise InputError(f'{scene.where}: {error}') from None
        self._follower = FrameFollower(
            simulation, self._frame_id, sources, now_ns=self._now_ns,
            warn=node.get_logger().warning)

    def _now_ns(self) -> int:
        """Return the time of the clock that the node steps on [ns]."""
        return self._node.pace()[0]()

    def _sources(self, scene: Scene) -> list[tuple]:
        """Return each follower with the source of its poses."""
        of_collider: dict[str, PoseSource] = {}
        grasps = []
        for robot in scene.robots.values():
            source = self._source(robot)
            of_collider.update(dict.fromkeys(robot.colliders, source))
            if robot.grasp is not None:
                from xpbd_ros.ros.robots import GripperFollower
                grasps.append((robot.grasp, source))
                self._grippers.append((robot.pin, GripperFollower(
                    robot, self._states(robot), source, self._frame_id, now_ns=self._now_ns,
                    warn=self._node.get_logger().warning)))
        found: list[tuple] = []
        for each in followers(scene):
            source = of_collider.get(each.name) if each.section == 'colliders' else None
            found.append((each, self._transforms(each.path) if source is None else source))
        return found + grasps

    def _source(self, robot) -> PoseSource:
        """Return the source of a robot's link poses."""
        from xpbd_ros.ros.robots import Kinematics
        follow = robot.keys.follow
        if follow == 'auto':
            follow = 'tf' if find_spec('tf2_ros') else 'joint_states'
        self._node.get_logger().info(f"robot '{robot.name}': follows {follow}")
        if follow == 'tf':
            return self._transforms(f'robots.{robot.name}.follow')
        return Kinematics(robot, self._states(robot))

    def _states(self, robot):
        """Return the joint states of a robot; subscribe with the first call."""
        from xpbd_ros.ros.robots import JointStates
        node, topic = self._node, self._node.resolve_topic_name(robot.keys.joint_states)
        if topic not in self._joint_states:
            states = JointStates(topic, node.command_queue.refuse, node.now_ns)
            self._joint_states[topic] = states
            self._subscriptions.append(node.create_subscription(
                JointState, topic, states.take,
                QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)))
        return self._joint_states[topic]

    def _transforms(self, path: str) -> PoseSource:
        try:
            return self.inputs.transforms()
        except InputError as error:
            raise InputError(f'{path}: {error}') from None

    def commands(self, groups: Sequence[tuple]) -> list[tuple]:
        """
        Return the commands of followers before a frame, to act after the ``groups``.

        Commands that services have applied since the last frame count like those of the groups.
        """
        before = [*self._simulation.pending, *(each for group in groups for each in group)]
        reset = any(isinstance(command, Reset) for command in before)
        grasped = {command.pin for command in before if isinstance(command, Grasp)}
        found: list[tuple] = []
        acting: list[str] = []
        for pin, gripper in self._grippers:
            command = gripper.command(holds=self._follower.holds(pin), reset=reset)
            if command is not None:
                found.append((command,))
                acting.append(pin)
            if gripper.open:
                self._follower.let_go(pin)
        return found + self._follower.commands(reset=reset, without=acting, grasped=grasped)

    @property
    def finding(self) -> str:
        """Present warning for ``/diagnostics``; empty without one."""
        return self._follower.finding

    def diagnostics(self) -> dict[str, float]:
        """Return the values for ``/diagnostics``."""
        return self._follower.diagnostics()

    def clear(self) -> None:
        """Forget transforms and joint states, after the clock went back."""
        self.inputs.clear()
        for states in self._joint_states.values():
            states.clear()

    def close(self) -> None:
        """Destroy the subscriptions."""
        self.inputs.close()
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
