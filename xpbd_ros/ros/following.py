"""The pins and colliders of a scene that follow something, in a node."""

from collections.abc import Callable, Sequence
from importlib.util import find_spec

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from sensor_msgs.msg import JointState

from xpbd_ros.errors import InputError
from xpbd_ros.ros.followers import Followers
from xpbd_ros.ros.frame_follower import PoseSource
from xpbd_ros.ros.frame_inputs import FrameInputs
from xpbd_ros.ros.inlet import Inlet
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import Command
from xpbd_ros.sim.simulation import Simulation

BACK = Duration(nanoseconds=-1)
"""jump of the node's clock at which what was followed is forgotten"""


class Following:
    """
    TF frames, robots and topics of other programs of a configured node.

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
        self._node = node
        self._frame_id = scene.top.frame_id
        self.inputs = FrameInputs(node, self._frame_id, take, node.command_queue.refuse)
        self._joint_states: dict = {}    # by topic
        self._topics: dict = {}    # subscribed topics of other programs, by name in the scene
        self._inlets: list[Inlet] = []
        self._jumps = node.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=BACK), post_callback=self._forget)
        try:
            self._followers = Followers(simulation, scene, self, now_ns=self._now_ns,
                                        warn=node.get_logger().warning,
                                        tell=node.get_logger().info)
        except InputError as error:
            self.close()
            raise InputError(f'{scene.where}: {error}') from None

    def _now_ns(self) -> int:
        """Return the time of the clock that the node steps on [ns]."""
        return self._node.pace()[0]()

    def way(self, robot) -> str:
        """Return how a robot is followed: 'tf' or 'joint_states'."""
        follow = robot.keys.follow
        if follow == 'auto':
            follow = 'tf' if find_spec('tf2_ros') else 'joint_states'
        self._node.get_logger().info(f"robot '{robot.name}': follows {follow}")
        return follow

    def states(self, robot):
        """Return the joint states of a robot; subscribe with the first call."""
        from xpbd_ros.ros.robots import JointStates
        node, topic = self._node, self._node.resolve_topic_name(robot.keys.joint_states)
        if topic not in self._joint_states:
            states = JointStates(topic, node.now_ns)
            self._joint_states[topic] = states
            self._inlets.append(Inlet(node, topic, JointState,
                                      lambda raw: node.command_queue.take_state(
                                          topic, raw, JointState, states.take)))
        return self._joint_states[topic]

    def transforms(self) -> PoseSource:
        """Return the transforms; subscribe with the first call."""
        return self.inputs.transforms()

    def topic(self, name: str) -> PoseSource:
        """Return the poses on a topic of another program; subscribe with the first call."""
        if name not in self._topics:
            from xpbd_ros.ros.foreign_topic import ForeignTopic
            self._topics[name] = ForeignTopic(self._node, name, self._frame_id, self.transforms)
        return self._topics[name].poses

    def commands(self, groups: Sequence[tuple]) -> list[tuple]:
        """Return the commands of followers before a frame, to act after the ``groups``."""
        return self._followers.commands(groups)

    def source_of(self, command: Command) -> str | None:
        """Return the source that a pin or collider of a command follows; None if it does not."""
        return self._followers.source_of(command)

    @property
    def finding(self) -> str:
        """Present warning for ``/diagnostics``; empty without one."""
        return self._followers.finding

    def diagnostics(self) -> dict[str, float]:
        """Return the values for ``/diagnostics``."""
        return self._followers.diagnostics()

    def _forget(self, _) -> None:
        """Forget transforms, joint states and poses: their stamps are of another time."""
        self.inputs.clear()
        for states in self._joint_states.values():
            states.clear()
        for topic in self._topics.values():
            topic.poses.clear()

    def close(self) -> None:
        """Destroy the subscriptions."""
        self._jumps.unregister()
        self.inputs.close()
        for inlet in self._inlets:
            inlet.close()
        for topic in self._topics.values():
            topic.close()
