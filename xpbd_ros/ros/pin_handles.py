"""
Handles for the pins of a scene in RViz: interactive markers, with the parameter
``interactive_markers``.

Dragging a handle sets its pin's target. Its menu grasps and releases, as ``~/pin/<name>/grasp``
does. The messages and the service of visualization_msgs are spoken directly, as RViz' display
expects them of any server: all handles by the service, then updates with rising sequence numbers.
"""

import threading
import time

from geometry_msgs.msg import Quaternion
from rclpy.qos import QoSProfile
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import (
    InteractiveMarker,
    InteractiveMarkerControl,
    InteractiveMarkerFeedback,
    InteractiveMarkerPose,
    InteractiveMarkerUpdate,
    Marker,
    MenuEntry,
)
from visualization_msgs.srv import GetInteractiveMarkers

from xpbd_ros.errors import InputError
from xpbd_ros.ros.inputs import read_pose
from xpbd_ros.ros.messages import quaternion, vector
from xpbd_ros.ros.pin_services import grasp, release
from xpbd_ros.sim.commands import MovePin

NAME = 'pin_handles'
"""the namespace below the node's name that RViz' display subscribes to"""
PERIOD = 0.05
"""time between two updates of the poses [s of wall time]"""
SIZE = 0.15
"""of a handle [m]"""
GRASP, RELEASE = 1, 2
"""ids of the menu's entries"""


class PinHandles:
    """
    The handles of all pins of a scene.

    Parameters
    ----------
    node : the ``ClothNode`` that offers them

    """

    def __init__(self, node):
        self._node = node
        self._frame_id = node.scene.top.frame_id
        self._names = list(node.scene.sections.get('pins', {}))
        self._lock = threading.Lock()    # the executor's thread and the stepper's send updates
        self._count = 0
        self._poses: dict = {}
        self._next = 0.0
        self._publisher = node.create_publisher(InteractiveMarkerUpdate, f'~/{NAME}/update',
                                                QoSProfile(depth=100))
        self._subscription = node.create_subscription(
            InteractiveMarkerFeedback, f'~/{NAME}/feedback', self._feedback, 100)
        self._service = node.create_service(
            GetInteractiveMarkers, f'~/{NAME}/get_interactive_markers', self._all)
        self._topic = node.resolve_topic_name(f'~/{NAME}/feedback')

    def close(self) -> None:
        """Destroy the topics and the service."""
        self._node.destroy_publisher(self._publisher)
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_service(self._service)

    def _pose(self, name: str):
        return self._node.simulation.effects['pin'].pose(name)

    def _all(self, request, response):
        with self._lock:
            response.sequence_number = self._count
            response.markers = [handle(name, self._pose(name), self._frame_id)
                                for name in self._names]
        return response

    def publish(self) -> None:
        """Publish the poses that changed, at most once in PERIOD, while someone listens."""
        now = time.monotonic()
        if now < self._next or not self._publisher.get_subscription_count():
            return
        self._next = now + PERIOD
        poses = {name: self._pose(name) for name in self._names}
        changed = [name for name in self._names if poses[name] != self._poses.get(name)]
        self._poses = poses
        with self._lock:
            self._count += bool(changed)
            update = InteractiveMarkerUpdate(
                server_id=NAME, seq_num=self._count,
                type=InteractiveMarkerUpdate.UPDATE if changed
                else InteractiveMarkerUpdate.KEEP_ALIVE)
            for name in changed:
                pose = InteractiveMarkerPose(name=name)
                pose.header.frame_id = self._frame_id
                place(pose.pose, poses[name])
                update.poses.append(pose)
            self._publisher.publish(update)

    def _feedback(self, message: InteractiveMarkerFeedback) -> None:
        """Move a pin that is dragged; grasp or release from the menu."""
        node, name = self._node, message.marker_name
        if name not in self._names:
            node.command_queue.refuse(self._topic, f'no handle is called {name[:40]!r}')
        elif node.stepper is None:
            node.command_queue.refuse(self._topic, 'the node is not active')
        elif message.event_type == InteractiveMarkerFeedback.POSE_UPDATE:
            try:
                node.command_queue.put(self._topic, tuple(
                    read_pose(message, self._frame_id, name, MovePin)))
            except InputError as error:
                node.command_queue.refuse(self._topic, str(error))
        elif message.event_type == InteractiveMarkerFeedback.MENU_SELECT and (
                message.menu_entry_id in (GRASP, RELEASE)):
            act = grasp if message.menu_entry_id == GRASP else release
            node.stepper.ask(lambda: act(node, name)).add_done_callback(self._tell)

    def _tell(self, future) -> None:
        """Log what came of a menu entry."""
        error = future.exception()
        if error is None:
            self._node.get_logger().info(f'{self._topic}: {future.result()}')
        else:
            self._node.command_queue.refuse(self._topic, str(error))


def place(message, pose) -> None:
    """Fill in a geometry_msgs/Pose."""
    message.position = vector(type(message.position), pose.position)
    message.orientation = quaternion(pose.orientation)


def handle(name: str, pose, frame_id: str) -> InteractiveMarker:
    """Return the handle of a pin: a ball to drag, six axes and a menu."""
    found = InteractiveMarker(name=name, description=name, scale=SIZE)
    found.header.frame_id = frame_id
    place(found.pose, pose)
    ball = Marker(type=Marker.SPHERE)
    ball.scale.x = ball.scale.y = ball.scale.z = 0.3 * SIZE
    ball.color = ColorRGBA(r=0.95, g=0.75, b=0.1, a=0.8)
    found.controls = [InteractiveMarkerControl(
        name='menu', interaction_mode=InteractiveMarkerControl.MOVE_3D, always_visible=True,
        markers=[ball])]
    half = 0.5**0.5
    for axis, turn in (('x', Quaternion(x=half, y=0.0, z=0.0, w=half)),
                       ('y', Quaternion(x=0.0, y=0.0, z=half, w=half)),
                       ('z', Quaternion(x=0.0, y=half, z=0.0, w=half))):
        for kind, mode in (('move', InteractiveMarkerControl.MOVE_AXIS),
                           ('turn', InteractiveMarkerControl.ROTATE_AXIS)):
            found.controls.append(InteractiveMarkerControl(
                name=f'{kind}_{axis}', interaction_mode=mode, orientation=turn))
    found.menu_entries = [MenuEntry(id=number, title=title) for number, title in (
        (GRASP, 'grasp'), (RELEASE, 'release'))]
    return found
