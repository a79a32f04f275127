"""A node that hears what ``replay`` publishes in a process of its own."""

import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

PATIENCE = 60.0    # s; only a failure takes that long


class Listener:
    """A node in this process that hears messages as bytes and calls the replay's services."""

    def __init__(self):
        self.node = rclpy.create_node('listener')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.heard: list[tuple[str, bytes]] = []
        self._clients = {}

    def listen(self, kind, topic, qos=1000, raw=True):
        self.node.create_subscription(
            kind, topic, lambda message: self.heard.append((topic, message)), qos, raw=raw)

    def until(self, true):
        """Spin until something is so."""
        deadline = time.monotonic() + PATIENCE
        while not true():
            assert time.monotonic() < deadline, f'waited in vain; heard {self.heard[-5:]}'
            self.executor.spin_once(timeout_sec=0.05)

    def spin(self, seconds):
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.01)

    def call(self, name, *, after=0.0):
        """Call a service, and look for its answer after some seconds."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(Trigger, f'/xpbd_ros_replay/{name}')
            self.until(self._clients[name].service_is_ready)
            self.spin(0.3)    # or the server may not know yet where to send its answer
        client = self._clients[name]
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        time.sleep(after)
        self.until(future.done)
        return future.result().success, future.result().message

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()


def padded(data: bytes) -> bytes:
    """Return a message as it arrives: DDS fills up the last four bytes with zeros."""
    return data + bytes(-len(data) % 4)


def nanoseconds(message: Clock) -> int:
    """Return what a clock message tells (ns)."""
    return message.clock.sec * 10**9 + message.clock.nanosec
