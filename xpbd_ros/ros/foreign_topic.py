"""
A topic of another program that moves pins and colliders of a node.

The scene names the topic and not its type, which is that of the publishers: the topic is
subscribed as soon as there is one.
"""

from collections.abc import Callable
import importlib
from typing import Any

from rclpy.clock import Clock, ClockType

from xpbd_ros.errors import InputError
from xpbd_ros.ros.frame_follower import PoseSource
from xpbd_ros.ros.inlet import Inlet
from xpbd_ros.ros.pose_messages import TYPES
from xpbd_ros.ros.topic_poses import TopicPoses

PERIOD = 0.2
"""period at which publishers are sought [s]"""


def message_class(type_name: str) -> type:
    """Return the class of a message type; raise InputError if its package is not installed."""
    package, _, name = type_name.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError) as error:
        raise InputError(f'{type_name}: is not installed ({error})') from None


class ForeignTopic:
    """
    One topic, and its poses.

    Parameters
    ----------
    node : the ``ClothNode``
    topic : name in the scene
    frame_id : TF frame of the scene
    transforms : returns the source of TF frames

    """

    def __init__(self, node, topic: str, frame_id: str, transforms: Callable[[], PoseSource]):
        self._node, self._name = node, node.resolve_topic_name(topic)
        self.poses = TopicPoses(self._name, frame_id, transforms, node.now_ns)
        self._inlet: Inlet | None = None
        self._refused: set[str] = set()    # types
        self._timer: Any = node.create_timer(PERIOD, self._look,
                                             clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _look(self) -> None:
        """Subscribe if there is a publisher of a type that can be used."""
        found = {info.topic_type for info in
                 self._node.get_publishers_info_by_topic(self._name)}
        usable = sorted(found.intersection(TYPES))
        for name in sorted(found.difference(TYPES, self._refused)):
            self._refused.add(name)
            self._node.command_queue.refuse(self._name, (
                f'is {name}, which moves no pin or collider ({", ".join(TYPES)} do)'))
        if usable:
            self._node.destroy_timer(self._timer)
            self._timer = None
            try:
                kind = message_class(usable[0])
            except InputError as error:
                self._node.command_queue.refuse(self._name, str(error))
                return
            self._inlet = Inlet(self._node, self._name, kind,
                                lambda raw: self._take(usable[0], kind, raw))

    def _take(self, type_name: str, kind: type, raw: bytes) -> None:
        self._node.command_queue.take_state(
            self._name, raw, kind, lambda message: self.poses.take(type_name, message))

    def close(self) -> None:
        """Destroy the subscription."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        if self._inlet is not None:
            self._inlet.close()
