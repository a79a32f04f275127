"""
The node under test in a process of its own, and a node of this process that talks to it over DDS.

Nothing is mocked and nothing depends on how fast the machine is: what should happen is waited for,
and what must not happen is looked for behind something that does.
"""

from collections.abc import Callable
from contextlib import suppress
from fractions import Fraction
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Transform, Twist
from lifecycle_msgs.srv import ChangeState, GetState
import numpy as np
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from xpbd_ros.node_stress.node import SCENE, TIMEOUT as PATIENCE

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOWEL = SCENE.replace('SUBSTEPS', '20')
"""a towel on a table, and a ball out of its way: four corners at ±0.2 m"""
PINNED = TOWEL + """
pins:
  left: {cloth: towel, at: corner_00, radius: 0.02}
  right: {cloth: towel, near: [0.2, -0.2, 0.004], radius: 0.06}
"""
"""the towel with two pins"""
WEIGHT = 0.25 * 0.4 * 0.4 * 9.80665
"""of that towel [N]"""
OF_EVERY_NODE = '/rosout', '/parameter_events', '/diagnostics', '/clock'
"""topics that no scene calls for"""
SECOND_CALL = 8.0
"""after which a new client asks again [s]: a server drops answers to one not yet known to it"""


class NodeProcess:
    """``xpbd_ros node``, started with parameters (name=value, as YAML) and ROS arguments."""

    def __init__(self, folder: Path, *arguments: str, parameters: dict | None = None,
                 environment: dict | None = None):
        folder.mkdir(parents=True, exist_ok=True)
        self.output = folder / 'node.out'
        words = [word for name, value in (parameters or {}).items()
                 for word in ('-p', f'{name}:={value}')]
        with self.output.open('wb') as file:
            self.process = subprocess.Popen(
                [sys.executable, '-m', 'xpbd_ros', 'node', '--ros-args', *words, *arguments],
                stdout=file, stderr=subprocess.STDOUT, cwd=folder,
                env={**child_environment(), 'ROS_LOG_DIR': str(folder / 'ros_log'),
                     **(environment or {})})

    @property
    def lines(self) -> list[str]:
        """What it has said so far."""
        return self.output.read_text(errors='replace').splitlines()

    def said(self, *texts: str) -> list[str]:
        """Return the lines that hold all of these texts."""
        return [line for line in self.lines if all(text in line for text in texts)]

    def wait_for(self, *texts: str) -> str:
        """Wait until it has said something, and return that line."""
        deadline = time.monotonic() + PATIENCE
        while not self.said(*texts):
            assert self.process.poll() is None, self.lines
            assert time.monotonic() < deadline, (texts, self.lines)
            time.sleep(0.02)
        return self.said(*texts)[0]

    def end(self, number: int = signal.SIGINT) -> int:
        """Tell it to end, and return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(PATIENCE)

    def kill(self) -> None:
        """End it, whatever it is doing."""
        with suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()


def child_environment() -> dict[str, str]:
    """Return the environment for a process that imports what this one does."""
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path)),
            'PYTHONUNBUFFERED': '1', 'RCUTILS_COLORIZED_OUTPUT': '0'}


class Peer:
    """A node of this process that hears, says and asks."""

    def __init__(self, context: Context):
        self.node = Node('peer', context=context, start_parameter_services=False)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.company: list[NodeProcess] = []
        """processes that ought to live"""
        self._publishers = {}
        self._clients = {}

    def close(self) -> None:
        """Leave."""
        self.executor.shutdown()
        self.node.destroy_node()

    def until(self, true: Callable, what: str, seen: Callable = lambda: ''):
        """Spin until something is so, and return it; ``seen`` tells what there was instead."""
        deadline = time.monotonic() + PATIENCE
        while not (found := true()):
            assert time.monotonic() < deadline, f'waited in vain for {what} {seen()}'
            for node in self.company:
                assert node.process.poll() is None, node.lines
            self.executor.spin_once(timeout_sec=0.05)
        return found

    def spin(self, seconds: float) -> None:
        """Listen for a while."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=min(left, 0.01))

    def hear(self, kind, topic: str, qos=50, *, raw: bool = False) -> list:
        """Return a list that fills with the messages of a topic."""
        heard = []
        self.node.create_subscription(kind, topic, heard.append, qos, raw=raw)
        return heard

    def say(self, topic: str, message, kind=None) -> None:
        """Publish; ``kind`` is the type of a message that is given as bytes."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(
                kind or type(message), topic, QoSProfile(depth=1000))
            self.until(self._publishers[topic].get_subscription_count, f'a listener to {topic}')
            self.spin(0.1)    # what a listener gets before it knows the writer is seconds late
        self._publishers[topic].publish(message)

    def ask(self, kind, service: str, request=None):
        """Call a service and return its answer."""
        known = (kind, service) in self._clients
        if not known:
            self._clients[kind, service] = self.node.create_client(kind, service)
            self.until(self._clients[kind, service].service_is_ready, service)
            self.spin(0.1)    # or the server may not know yet where to send its answer
        client = self._clients[kind, service]
        self.until(client.service_is_ready, service)
        request = kind.Request() if request is None else request
        futures = [client.call_async(request)]
        late = time.monotonic() + SECOND_CALL
        self.until(lambda: futures[0].done() or not known and time.monotonic() > late,
                   f'an answer of {service}')
        if not futures[0].done():    # the server still did not know, or is busy
            futures.append(client.call_async(request))
            self.until(lambda: any(future.done() for future in futures), f'an answer of {service}')
        return next(future for future in futures if future.done()).result()

    def forget(self) -> None:
        """Drop all subscriptions, publishers and clients."""
        for subscription in list(self.node.subscriptions):
            self.node.destroy_subscription(subscription)
        for publisher in self._publishers.values():
            self.node.destroy_publisher(publisher)
        for client in self._clients.values():
            self.node.destroy_client(client)
        self._publishers, self._clients = {}, {}


class Cloth:
    """One node under test, by its name, and what it has published."""

    def __init__(self, peer: Peer, node: NodeProcess, name: str = '/cloth'):
        self.peer, self.node, self.name = peer, node, name
        peer.company = [node]
        self.clouds = peer.hear(PointCloud2, f'{name}/particles')
        self.pins = peer.hear(MultiDOFJointState, f'{name}/pin_states')
        self.statuses: list[dict[str, str]] = []
        self.epoch_ns = None
        """stamp of frame 0, where stamps are simulation time"""
        peer.node.create_subscription(DiagnosticArray, '/diagnostics', self._diagnosed, 50)

    def _diagnosed(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name == f'{self.name.lstrip("/")}: simulation':
                values = {pair.key: pair.value for pair in status.values}
                self.statuses.append({'level': status.level, 'message': status.message, **values})
                self.epoch_ns = int(values['epoch_ns'])

    def status(self, true: Callable = lambda status: True) -> dict[str, str]:
        """Return what /diagnostics says, from now on, once it says what is waited for."""
        count = len(self.statuses)
        return self.peer.until(
            lambda: next((status for status in self.statuses[count:] if true(status)), None),
            'diagnostics', lambda: self.statuses[-1:])

    def topics(self) -> tuple[set[str], set[str]]:
        """
        Return what the node publishes and what it listens to, but for what every node does.

        Its services may be seen before its name is.
        """
        node, name = self.peer.node, self.name.lstrip('/')
        self.peer.until(lambda: name in node.get_node_names(), f'{name} among the nodes')
        return tuple({topic for topic, _ in ask(name, '/')}
                     - {f'{self.name}/transition_event', *OF_EVERY_NODE}
                     for ask in (node.get_publisher_names_and_types_by_node,
                                 node.get_subscriber_names_and_types_by_node))

    # services

    def trigger(self, service: str) -> tuple[bool, str]:
        """Call one of the Trigger services."""
        answer = self.peer.ask(Trigger, f'{self.name}/{service}')
        return answer.success, answer.message

    def grasp(self, pin: str, on: bool) -> tuple[bool, str]:
        """Call ~/pin/<name>/grasp."""
        answer = self.peer.ask(SetBool, f'{self.name}/pin/{pin}/grasp', SetBool.Request(data=on))
        return answer.success, answer.message

    def record(self, on: bool) -> tuple[bool, str]:
        """Start or stop recording."""
        answer = self.peer.ask(SetBool, f'{self.name}/record', SetBool.Request(data=on))
        return answer.success, answer.message

    def meet(self, **harmless) -> None:
        """
        In mode lockstep: step until both sides hear each other.

        ``harmless`` are messages by topic, sent until they are taken. From then on nothing is
        lost, and what is said before a service is called is there before it is served.
        """
        topics = {f'{self.name}/{topic.replace("__", "/")}': message
                  for topic, message in harmless.items()}
        while not (self.clouds and self.pins and self.statuses
                   and all(f'age_s {topic}' in self.statuses[-1] for topic in topics)):
            assert self.trigger('step')[0]
            for topic, message in topics.items():
                self.peer.say(topic, message)
            self.peer.spin(0.1)

    def step(self, count: int = 1) -> int:
        """In mode lockstep: advance by some frames, and return the frame."""
        for _ in range(count):
            good, said = self.trigger('step')
            assert good, said
        return int(said.removeprefix('at frame '))

    def cloud(self, frame: int) -> np.ndarray:
        """Return the positions of a frame, shape (rows, columns, 3)."""
        return points(self._of_frame(self.clouds, frame))

    def pin_state(self, frame: int) -> dict[str, tuple]:
        """Return (pose, twist, wrench) of each pin in a frame."""
        message = self._of_frame(self.pins, frame)
        return {name: (message.transforms[k], message.twist[k], message.wrench[k])
                for k, name in enumerate(message.joint_names)}

    def _of_frame(self, heard: list, frame: int):
        return self.peer.until(
            lambda: next((m for m in reversed(heard)
                          if stamp_ns(m) == self.epoch_ns + time_ns(frame)), None),
            f'frame {frame}')

    # parameters and lifecycle

    def set(self, **values) -> tuple[bool, str]:
        """Set parameters at once; ``__`` stands for a dot."""
        answer = self.peer.ask(
            SetParametersAtomically, f'{self.name}/set_parameters_atomically',
            SetParametersAtomically.Request(parameters=[
                Parameter(name.replace('__', '.'), value=value).to_parameter_msg()
                for name, value in values.items()]))
        return answer.result.successful, answer.result.reason

    def get(self, *names: str) -> list:
        """Return the values of parameters."""
        answer = self.peer.ask(GetParameters, f'{self.name}/get_parameters',
                               GetParameters.Request(names=names))
        return [parameter_value_to_python(value) for value in answer.values]

    def describe(self, *names: str) -> list:
        """Return the descriptors of parameters."""
        return self.peer.ask(DescribeParameters, f'{self.name}/describe_parameters',
                             DescribeParameters.Request(names=names)).descriptors

    @property
    def state(self) -> str:
        """Its lifecycle state."""
        return self.peer.ask(GetState, f'{self.name}/get_state').current_state.label

    def go(self, *transitions: str) -> bool:
        """Ask for lifecycle transitions until one is refused."""
        for label in transitions:
            request = ChangeState.Request()
            request.transition.label = label
            if not self.peer.ask(ChangeState, f'{self.name}/change_state', request).success:
                return False
        return True

    def restart(self, **values) -> None:
        """Configure anew with other parameters."""
        while (state := self.state) != 'unconfigured':
            assert self.go('deactivate' if state == 'active' else 'cleanup')
        assert self.set(**values) == (True, '')
        assert self.go('configure'), self.node.lines
        self.clouds.clear()
        self.pins.clear()
        self.statuses.clear()
        self.epoch_ns = None
        assert self.go('activate'), self.node.lines

    # inputs

    def mark(self, *markers: Marker) -> None:
        """Send markers to ~/pins; they have arrived on return."""
        self.peer.say(f'{self.name}/pins', MarkerArray(markers=list(markers)))

    def aim(self, **places) -> None:
        """Send named targets to ~/pin_targets."""
        self.peer.say(f'{self.name}/pin_targets', targets(**places))


def time_ns(frame: int) -> int:
    """Return the simulation time of a frame at 60 Hz [ns]."""
    return round(Fraction(frame * 10**9, 60))


def points(cloud: PointCloud2) -> np.ndarray:
    """Return the positions in a cloud, shape (rows, columns, 3)."""
    return np.frombuffer(cloud.data, np.float32).reshape(cloud.height, cloud.width, 3)


def stamp_ns(message) -> int:
    """Return when a message is from [ns]."""
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def pin(name: str, place=(0.0, 0.0, 0.0), *, action: int = Marker.ADD, radius: float = 0.01,
        lifetime_ns: int = 0, frame_id: str = 'world') -> Marker:
    """Return a marker for ~/pins."""
    marker = Marker(ns=name, type=Marker.SPHERE, action=action)
    marker.header.frame_id = frame_id
    marker.pose.position.x, marker.pose.position.y, marker.pose.position.z = map(float, place)
    marker.scale.x = marker.scale.y = marker.scale.z = 2.0 * radius
    marker.lifetime.sec, marker.lifetime.nanosec = divmod(lifetime_ns, 10**9)
    return marker


def collider(name: str, place=(0.0, 0.0, 0.0), size=(0.1, 0.1, 0.1), *, kind: int = Marker.CUBE,
             action: int = Marker.ADD, lifetime_ns: int = 0) -> Marker:
    """Return a marker for ~/colliders; ``size`` is its scale [m]."""
    marker = pin(name, place, action=action, lifetime_ns=lifetime_ns)
    marker.type = kind
    marker.scale.x, marker.scale.y, marker.scale.z = map(float, size)
    return marker


def transform(place, orientation=(0.0, 0.0, 0.0, 1.0)) -> Transform:
    """Return a place and an orientation."""
    found = Transform()
    t, q = found.translation, found.rotation
    t.x, t.y, t.z = map(float, place)
    q.x, q.y, q.z, q.w = map(float, orientation)
    return found


def targets(*, frame_id: str = 'world', stamp: int = 0, twist: Twist | None = None,
            **places) -> MultiDOFJointState:
    """Return a message for ~/pin_targets or ~/collider_states; a place may be a Transform."""
    message = MultiDOFJointState(joint_names=list(places))
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    message.transforms = [place if isinstance(place, Transform) else transform(place)
                          for place in places.values()]
    message.twist = [] if twist is None else [twist] * len(places)
    return message


def pose_stamped(place, orientation=(0.0, 0.0, 0.0, 1.0), frame_id: str = 'world') -> PoseStamped:
    """Return a message for ~/collider/<name>/pose."""
    message = PoseStamped()
    message.header.frame_id = frame_id
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = map(float, place)
    q.x, q.y, q.z, q.w = map(float, orientation)
    return message
