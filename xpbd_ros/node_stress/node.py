"""A node process under test, with a client node."""

from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

TIMEOUT = 240.0
"""longest wait for an event [s]; compiling may take a minute"""
SCENE = """
cloths:
  towel:
    grid: {size: [0.4, 0.4], resolution: [9, 9]}
    pose: {position: [-0.2, -0.2, 0.004]}
    density: 0.25
    effects:
      stretch: {warp: 500.0, weft: 500.0}
colliders:
  table: {plane: {normal: [0, 0, 1]}, friction: 0.5}
  ball: {sphere: {radius: 0.1}, position: [0.0, 1.0, 0.15], friction: 0.3}
effects:
  pin: {max_pins: 4}
  contact: {thickness: 0.004}
  friction: {}
  damping: {rate: 2.0}
solver: {method: gauss_seidel, integrator: backward_euler, substeps: SUBSTEPS}
"""
"""a towel on a table, and a ball beside it"""


class LostError(Exception):
    """The node ended, or an expected event did not happen within TIMEOUT."""


class NodeUnderTest:
    """
    A node process on a scene with a towel, and a client node in this process.

    Parameters
    ----------
    folder : new folder for the scene and the node's output
    substeps : of the scene
    parameters : further ROS parameters of the node

    """

    def __init__(self, folder: Path, *, substeps: int = 20, **parameters):
        folder.mkdir(parents=True)
        scene = folder / 'towel.yaml'
        scene.write_text(SCENE.replace('SUBSTEPS', str(substeps)))
        words = [word for name, value in {'scene': scene, **parameters}.items()
                 for word in ('-p', f'{name}:={value}')]
        self._output = folder / 'node.log'
        with self._output.open('wb') as file:
            self.process = subprocess.Popen(
                [sys.executable, '-m', 'xpbd_ros', 'node', '--ros-args', *words], stdout=file,
                stderr=subprocess.STDOUT)
        self.node = Node('hard_case')
        self.clouds: list[PointCloud2] = []
        self.status: dict[str, str] = {}
        self.warned: list[str] = []
        self.node.create_subscription(PointCloud2, '/cloth/particles', self.clouds.append, 50)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._diagnosed, 10)
        self._publishers: dict[str, Any] = {}

    def _diagnosed(self, array) -> None:
        for status in array.status:
            self.status = {pair.key: pair.value for pair in status.values}
            if status.level != b'\0':
                self.warned.append(status.message)

    def spin(self, seconds: float) -> None:
        """Receive messages for a time [s]."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.01)

    def wait_for(self, true, what: str):
        """Receive messages until ``true()`` is true, and return its value; ``what`` names it."""
        end = time.monotonic() + TIMEOUT
        while not (found := true()):
            if self.process.poll() is not None:
                raise LostError(f'the node ended with exit code {self.process.returncode}: '
                                + ' '.join(self._output.read_text().splitlines()[-1:]))
            if time.monotonic() > end:
                raise LostError(f'timed out waiting for {what}')
            rclpy.spin_once(self.node, timeout_sec=0.05)
        return found

    def publish(self, topic: str, message) -> None:
        """Publish a message, after the node has subscribed to its topic."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(type(message), topic,
                                                                 QoSProfile(depth=100))
            if topic != '/clock':
                self.wait_for(self._publishers[topic].get_subscription_count, topic)
        self._publishers[topic].publish(message)

    def call(self, kind, service: str, request):
        """Call a service, and return the response."""
        client = self.node.create_client(kind, service)
        self.wait_for(client.service_is_ready, service)
        future = client.call_async(request)
        self.wait_for(future.done, service)
        return future.result()

    def message_with(self, text: str) -> str:
        """Return the first message in the node's output that contains a text; empty if none."""
        return next((line.split(']: ')[-1] for line in self._output.read_text().splitlines()
                     if text in line), '')

    def points(self, cloud=None) -> np.ndarray:
        """Return the positions in a cloud (None: the last one) [m], shape (particles, 3)."""
        return np.frombuffer((cloud or self.clouds[-1]).data, np.float32).reshape(-1, 3)

    @property
    def finite(self) -> bool:
        """True if all positions of all received clouds are finite."""
        return all(np.isfinite(self.points(cloud)).all() for cloud in self.clouds)

    def rising(self, since: int = 0) -> bool:
        """Return whether stamps rise strictly, from cloud number ``since`` on."""
        stamps = [(c.header.stamp.sec, c.header.stamp.nanosec) for c in self.clouds[since:]]
        return all(a < b for a, b in zip(stamps, stamps[1:]))

    def end(self) -> bool:
        """Interrupt the node; return whether it ended with exit code 0 and without traceback."""
        self.process.send_signal(signal.SIGINT)
        try:
            good = self.process.wait(60.0) == 0
        except subprocess.TimeoutExpired:
            good = False
        self.process.kill()
        self.node.destroy_node()
        return good and 'Traceback' not in self._output.read_text()
