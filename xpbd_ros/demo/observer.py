"""
The observer of the demo: a separate program that subscribes to the node's topics.

It prints a line when the first point cloud arrives, collects point clouds, pin states and
diagnostics until SIGINT or SIGTERM, then writes them to a file.
"""

import json
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from sensor_msgs.msg import MultiDOFJointState, PointCloud2

from xpbd_ros.ros.signals import collected_signals


class Observer(Node):
    """A node that collects the messages of the demo."""

    def __init__(self):
        super().__init__('observer')
        self.stamps, self.heard, self.clouds = [], [], []
        self.pins, self.diagnostics = [], {}
        self.create_subscription(PointCloud2, '/cloth/particles', self.on_cloud, 50)
        self.create_subscription(MultiDOFJointState, '/cloth/pin_states', self.on_pins, 50)
        self.create_subscription(DiagnosticArray, '/diagnostics', self.on_diagnostics, 10)

    def on_cloud(self, cloud):
        """Keep a point cloud, its stamp and its arrival time [s]."""
        if not self.clouds:
            print('receives', flush=True)
        self.heard.append(time.monotonic())
        self.stamps.append(Time.from_msg(cloud.header.stamp).nanoseconds * 1e-9)
        self.clouds.append(np.frombuffer(cloud.data, np.float32).reshape(
            cloud.height, cloud.width, 3))

    def on_pins(self, states):
        """Keep the positions of the pins [m] and the forces on them [N]."""
        stamp = Time.from_msg(states.header.stamp).nanoseconds * 1e-9
        for name, place, wrench in zip(states.joint_names, states.transforms, states.wrench):
            p, f = place.translation, wrench.force
            self.pins.append([stamp, name, [p.x, p.y, p.z], [f.x, f.y, f.z]])

    def on_diagnostics(self, array):
        """Keep the latest diagnostics."""
        for status in array.status:
            self.diagnostics = {pair.key: pair.value for pair in status.values}


def main() -> int:
    """Collect until SIGINT or SIGTERM, then write: ``observer.py FILE.npz``."""
    # rclpy's own handlers would shut its context down, which a conversion of a message or a wait
    # under way reports as an error
    with collected_signals() as received:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        observer, executor = Observer(), SingleThreadedExecutor()
        executor.add_node(observer)
        while not received:
            executor.spin_once(timeout_sec=0.1)
    np.savez(sys.argv[1], stamps=observer.stamps, heard=observer.heard, clouds=observer.clouds,
             pins=json.dumps(observer.pins), diagnostics=json.dumps(observer.diagnostics))
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
