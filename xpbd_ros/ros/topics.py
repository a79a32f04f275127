"""The topics of a configured node: all outputs, and the inputs that its scene's effects need."""

from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from xpbd_ros.ros.inlet import Inlet
from xpbd_ros.ros.inputs import INPUTS, read_pose
from xpbd_ros.ros.outputs import Outputs
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import MovePin


class Topics:
    """
    The publishers and subscriptions of a node.

    Parameters
    ----------
    node : creates them
    scene : gives the names of colliders and the TF frame
    outputs : topics of the simulation, whose effects determine the input topics
    take : called for each message, with the full name of its topic, the serialized message, its
        type, and a reader (message) -> commands
    clock : whether the node publishes /clock
    read_cloud : reader (message, TF frame, cloth) -> commands of ``~/set_state``

    """

    def __init__(self, node: LifecycleNode, scene: Scene, outputs: Outputs, take: Callable, *,
                 clock: bool, read_cloud: Callable):
        self._node, self._scene, self._outputs, self._take = node, scene, outputs, take
        self._read_cloud = read_cloud
        self._clock = clock
        self._publishers: dict[str, Any] = {}
        self._inlets: list[Inlet] = []

    def open(self) -> None:
        """Create publishers and subscriptions; if that fails, ``close`` removes those created."""
        node, effects = self._node, self._outputs.simulation.effects
        overridable = QoSOverridingOptions.with_default_policies()
        for output in self._outputs.topics.values():
            if output.log_only:
                continue
            qos = QoSProfile(depth=output.qos.depth)
            if output.qos.durability == 'transient_local':
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            self._publishers[output.topic] = node.create_lifecycle_publisher(
                output.kind, f'~/{output.topic}', qos, qos_overriding_options=overridable)
        self._publishers['/diagnostics'] = node.create_lifecycle_publisher(
            DiagnosticArray, '/diagnostics', 10)
        if self._clock:
            self._publishers['/clock'] = node.create_lifecycle_publisher(Clock, '/clock', 10)
        for topic, about in INPUTS.items():
            if about.effect in effects:
                self._listen(topic, about.kind, about.read)
        if 'contact' in effects:
            for name in self._scene.sections.get('colliders', {}):
                self._listen(f'collider/{name}/pose', PoseStamped,
                             lambda m, f, name=name: read_pose(m, f, name))
        cloths = self._outputs.simulation.cloths
        for cloth in cloths:
            self._listen(f'cloth/{cloth.name}/set_state' if len(cloths) > 1 else 'set_state',
                         PointCloud2, lambda m, f, cloth=cloth: self._read_cloud(m, f, cloth))
        for name in self._scene.sections.get('pins', {}):
            self._listen(f'pin/{name}/target', PoseStamped,
                         lambda m, f, name=name: read_pose(m, f, name, MovePin))

    def _listen(self, topic: str, kind: type, read: Callable) -> None:
        name = self._node.resolve_topic_name(f'~/{topic}')
        self._inlets.append(Inlet(self._node, name, kind, lambda raw: self._take(
            name, raw, kind, lambda message: read(message, self._scene.top.frame_id))))

    def publish(self, topic: str, message) -> None:
        """Publish a message, serialized or not."""
        self._publishers[topic].publish(message)

    def is_heard(self, topic: str) -> bool:
        """Return whether the topic has subscribers."""
        return self._publishers[topic].get_subscription_count() > 0

    def close(self) -> None:
        """Destroy publishers and subscriptions."""
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
        for inlet in self._inlets:
            inlet.close()
