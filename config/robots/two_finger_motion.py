"""
Move the two-finger robot: publish joint states along a table, once, then the last ones.

::

    python3 two_finger_motion.py

The motion begins once /joint_states has as many subscribers as parameter ``subscribers`` says: 1,
or 2 where robot_state_publisher listens beside the cloth node.
"""

from bisect import bisect_right
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState

RATE = 100.0
"""[Hz]"""
BEFORE = 0.5
"""time at the first positions before the motion begins [s]"""
JOINTS = 'reach', 'lift', 'finger'
TABLE = [
    (0.0, 0.0, 0.1, 0.03),      # s, m, m, m
    (0.6, 0.0, -0.06, 0.03),    # down to the cloth
    (0.9, 0.0, -0.06, 0.004),   # close
    (1.0, 0.0, -0.06, 0.004),
    (1.8, 0.0, 0.2, 0.004),     # lift
    (2.4, 0.2, 0.2, 0.004),     # carry
    (3.2, 0.2, -0.055, 0.004),  # lay down
    (3.4, 0.2, -0.055, 0.004),
    (3.6, 0.2, -0.055, 0.03),   # open
    (4.2, 0.2, 0.1, 0.03),
]


def positions(time: float) -> list[float]:
    """Return the joint positions at a time [s]: linear between rows [m]."""
    k = min(bisect_right([row[0] for row in TABLE], time), len(TABLE) - 1)
    (begin, *first), (end, *second) = TABLE[k - 1], TABLE[k]
    share = min(max((time - begin) / (end - begin), 0.0), 1.0)
    return [a + share * (b - a) for a, b in zip(first, second)]


class Motion(Node):
    """Publishes /joint_states."""

    def __init__(self):
        super().__init__('two_finger_motion')
        self._publisher = self.create_publisher(JointState, '/joint_states', 10)
        self._begin_ns = None
        self._subscribers = self.declare_parameter('subscribers', 1).value
        self.create_timer(1.0 / RATE, self._publish)

    def _publish(self) -> None:
        now = self.get_clock().now()
        if (self._begin_ns is None
                and self._publisher.get_subscription_count() >= self._subscribers):
            self._begin_ns = now.nanoseconds + round(1e9 * BEFORE)
            self.get_logger().info('moving')
        time = 0.0 if self._begin_ns is None else 1e-9 * (now.nanoseconds - self._begin_ns)
        message = JointState(name=JOINTS, position=positions(time))
        message.header.stamp = now.to_msg()
        self._publisher.publish(message)


def main() -> None:
    """Publish until ended."""
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Motion())


if __name__ == '__main__':
    main()
