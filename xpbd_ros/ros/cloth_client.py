"""
A client of a running ``cloth_node``: hears its topics, sends it commands, calls its services.

Commands travel as the messages of ``command_messages``, on the topics that any other program would
use; the node cannot tell the client from a robot.
"""

from collections.abc import Callable
from contextlib import suppress
import os
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rcl_interfaces.srv import SetParametersAtomically
import rclpy
from rclpy.context import Context
from rclpy.exceptions import InvalidServiceNameException, InvalidTopicNameException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from xpbd_ros.errors import InputError
from xpbd_ros.ros.clouds import positions_of
from xpbd_ros.ros.command_messages import as_messages
from xpbd_ros.ros.inputs import INPUTS
from xpbd_ros.scene.load import scene_from_text
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import Command, SetKey

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""a client that is slow loses messages, and delays neither the node nor its other listeners"""
PATIENCE = 5.0
"""longest wait for a node [s]"""
SENT = 'pins', 'pin_targets', 'collider_states', 'clicked_point'
"""input topics of the node that the client publishes on"""


class ClothClient:
    """
    The latest messages of one node.

    Parameters
    ----------
    name : full name of the node, such as '/cloth'

    Raises
    ------
    InputError : not a name of a node

    """

    def __init__(self, name: str):
        self.name = '/' + name.strip('/')
        self.told: Callable[[str], None] = lambda text: None
        """called with a text when the node refuses something"""
        self.scene_text = ''
        """the scene as it runs, as YAML; empty until it has arrived"""
        self.positions: dict[str, np.ndarray] = {}
        """by cloth [m], float32, shape (particles, 3)"""
        self.triangles: dict[str, np.ndarray] = {}
        """by cloth, shape (triangles, 3)"""
        self.start: dict[str, np.ndarray] = {}
        """positions at the scene's start, by cloth [m], shape (particles, 3)"""
        self.pins = MultiDOFJointState()
        self.colliders = MultiDOFJointState()
        self.placed: list = []
        """messages on ~/colliders since the last call of ``take_placed``"""
        self.status: dict[str, str] = {}
        """values in /diagnostics, and 'message', its text"""
        self.time_ns = 0
        """stamp of the latest cloud [ns]"""
        self.count = 0
        """number of clouds that have arrived"""
        self.heard = 0.0
        """time at which the last message arrived (``time.monotonic``) [s]"""
        self.frame_id = ''
        self._heard_clouds: list = []
        self._clouded: set[str] = set()
        """cloths that a cloud has come of"""
        self._lock = threading.Lock()
        self._publishers: dict = {}
        self._clients: dict = {}
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node(f'view_{os.getpid()}', context=self._context,
                         start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name='cloth_client', daemon=True)
        try:
            self._listen('scene', String, self._on_scene, LATCHED)
        except (InvalidTopicNameException, InvalidServiceNameException, ValueError) as error:
            self.close()
            raise InputError(f'--node {name}: is no name of a node '
                             f'({str(error).splitlines()[0]})') from None
        self._thread.start()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self) -> None:
        """Leave ROS."""
        self._executor.shutdown()
        self._context.try_shutdown()
        if self._thread.is_alive():
            self._thread.join()
        self.node.destroy_node()

    def connect(self) -> Scene:
        """
        Wait for the node, subscribe to the topics of its scene, and return the scene.

        Raises
        ------
        InputError : the node is not there, or publishes no scene; with the remedy

        """
        self._wait(lambda: self.scene_text)
        scene = self.scene()
        self.frame_id = scene.top.frame_id
        self._listen('pin_states', MultiDOFJointState, self._on_pins, LATEST)
        self._listen('collider_wrenches', MultiDOFJointState, self._on_colliders, LATEST)
        self._listen('colliders', MarkerArray, self._on_placed, 10)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_status, 10)
        self.listen_to(scene)
        for service in ('play', 'pause', 'step', 'reset', 'release_all'):
            self._clients[service] = self.node.create_client(Trigger, f'{self.name}/{service}')
        self._clients['record'] = self.node.create_client(SetBool, f'{self.name}/record')
        self._clients['set'] = self.node.create_client(
            SetParametersAtomically, f'{self.name}/set_parameters_atomically')
        for topic in SENT:
            if INPUTS[topic].effect in scene.effect_names:
                self._publishers[topic] = self.node.create_publisher(
                    INPUTS[topic].kind, f'{self.name}/{topic}', 10)
        self.wait_for_meshes(scene)
        return scene

    def wait_for_meshes(self, scene: Scene) -> None:
        """Wait for the mesh of each cloth; raise InputError if one does not come."""
        self._wait(lambda: self.triangles.keys() >= scene.cloths.keys())

    def wait_for_state(self, scene: Scene) -> None:
        """
        Wait for a cloud of each cloth, and for the colliders.

        Raises
        ------
        InputError : no cloud comes, as from a node that is paused

        """
        deadline = time.monotonic() + PATIENCE
        while not (self._clouded >= scene.cloths.keys() and (
                'contact' not in scene.effect_names or self.colliders.joint_names)):
            if time.monotonic() > deadline:
                raise InputError(f'--node {self.name}: publishes no frame; if it is paused: ros2 '
                                 f'service call {self.name}/play std_srvs/srv/Trigger')
            time.sleep(0.02)

    def listen_to(self, scene: Scene) -> None:
        """Subscribe to the clouds and meshes of a scene's cloths, and forget all others."""
        for subscription in self._heard_clouds:
            self.node.destroy_subscription(subscription)
        with self._lock:
            self.positions, self.triangles, self.start = {}, {}, {}
        several = len(scene.cloths) > 1
        self._heard_clouds = []
        for cloth in scene.cloths:
            base = f'cloth/{cloth}/' if several else ''
            self._heard_clouds += [
                self._listen(f'{base}mesh', Mesh,
                             lambda message, cloth=cloth: self._on_mesh(cloth, message), LATCHED),
                self._listen(f'{base}particles', PointCloud2,
                             lambda message, cloth=cloth: self._on_cloud(cloth, message), LATEST)]

    def _listen(self, topic: str, kind: type, act: Callable, qos):
        return self.node.create_subscription(kind, f'{self.name}/{topic}', act, qos)

    def _wait(self, true: Callable) -> None:
        deadline = time.monotonic() + PATIENCE
        while not true():
            if time.monotonic() > deadline:
                raise InputError(self._missing())
            time.sleep(0.02)

    def _missing(self) -> str:
        """Return what is missing, and the remedy."""
        nodes = sorted('/'.join((space.rstrip('/'), name)) for name, space in
                       self.node.get_node_names_and_namespaces() if name != self.node.get_name())
        if self.name not in nodes:
            return (f'--node {self.name}: no such node in ROS domain '
                    f"{os.environ.get('ROS_DOMAIN_ID', '0')} (there: "
                    f"{', '.join(nodes) or 'none'}); start it with xpbd_ros node, or set "
                    'ROS_DOMAIN_ID to its domain')
        return (f'--node {self.name}: is there, and publishes no scene; a cloth_node does once it '
                f'has compiled it, for up to a minute, and is active: ros2 lifecycle set '
                f'{self.name} configure, then activate, unless it does so itself')

    def scene(self) -> Scene:
        """Return the scene as it runs."""
        return scene_from_text(self.scene_text, where=f'{self.name}/scene',
                               name=self.name.strip('/'))

    def put(self, *commands: Command) -> None:
        """Send commands: live keys as parameters, all others as messages."""
        keys = [command for command in commands if isinstance(command, SetKey)]
        others = [command for command in commands if not isinstance(command, SetKey)]
        for topic, message in as_messages(others, self.frame_id, 0):
            self._publishers[topic].publish(message)
        if keys:
            self._ask('set', SetParametersAtomically.Request(parameters=[
                Parameter(key.key, value=list(key.value) if isinstance(key.value, tuple)
                          else key.value).to_parameter_msg() for key in keys]),
                lambda answer: self._judge('set', answer.result.successful, answer.result.reason))

    def call(self, service: str, done: Callable[[], None] = lambda: None) -> None:
        """Call a Trigger service of the node; ``done`` follows its success."""
        self._ask(service, Trigger.Request(), lambda answer: self._judge(
            service, answer.success, answer.message, done))

    def record(self, on: bool) -> None:
        """Start or stop recording."""
        self._ask('record', SetBool.Request(data=on), lambda answer: self.told(
            f'{"recording to" if on and answer.success else "record:"} {answer.message}'))

    def _ask(self, service: str, request, act: Callable) -> None:
        client = self._clients[service]
        if client.service_is_ready():
            client.call_async(request).add_done_callback(lambda future: act(future.result()))
        else:
            self.told(f'{client.srv_name}: there is no such service now')

    def _judge(self, service: str, good: bool, reason: str,
               done: Callable[[], None] = lambda: None) -> None:
        if good:
            done()
        else:
            self.told(f'{service}: {reason}')

    def take_placed(self) -> list:
        """Return the messages on ~/colliders since the last call."""
        with self._lock:
            found, self.placed = self.placed, []
        return found

    # the executor's thread

    def _on_scene(self, message: String) -> None:
        self.scene_text = message.data

    def _on_mesh(self, cloth: str, message: Mesh) -> None:
        start = np.array([(p.x, p.y, p.z) for p in message.vertices], np.float32).reshape(-1, 3)
        with self._lock:
            self.start = {**self.start, cloth: start}
            self.positions = {**self.positions, cloth: start}
            self.triangles = {**self.triangles, cloth: np.array(
                [each.vertex_indices for each in message.triangles], np.int32).reshape(-1, 3)}

    def _on_cloud(self, cloth: str, message: PointCloud2) -> None:
        try:
            found = positions_of(message)
        except InputError as error:
            self.told(f'{cloth}: {error}')
            return
        with self._lock:
            self.positions = {**self.positions, cloth: found}
        self.time_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        self.heard = time.monotonic()
        self._clouded.add(cloth)
        self.count += 1

    def _on_pins(self, message: MultiDOFJointState) -> None:
        self.pins = message

    def _on_colliders(self, message: MultiDOFJointState) -> None:
        self.colliders = message

    def _on_placed(self, message: MarkerArray) -> None:
        with self._lock:
            self.placed.append(message)

    def _on_status(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name == f'{self.name.strip("/")}: simulation':
                self.heard = time.monotonic()
                self.status = {'message': status.message,
                               **{pair.key: pair.value for pair in status.values}}
