"""Broadcast frames that move: a process of its own, as a robot's driver is."""

from collections import deque
from math import cos, sin
import sys
import time

RADIUS = 0.2
"""of the circle of the frame 'tool' [m]"""
SPEED = 0.5
"""[m/s]"""
LATENCY = 0.03
"""from the stamp of a transform to its publication [s]"""
RATE = 50.0
"""[Hz]"""
CENTRE = 0.0, 1.0, 0.6
"""of the circle, in 'world' [m]"""
BASE = 0.0, 0.0, 0.5
"""place of the static frame 'base', turned by a quarter turn about z"""


def tool(seconds: float) -> tuple[float, float, float]:
    """Return the place of 'tool' in 'world' at a time [s]."""
    angle = SPEED / RADIUS * seconds
    return CENTRE[0] + RADIUS * cos(angle), CENTRE[1] + RADIUS * sin(angle), CENTRE[2]


def main() -> None:
    """Broadcast until ended."""
    from geometry_msgs.msg import TransformStamped
    import rclpy
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from tf2_msgs.msg import TFMessage

    from support.node import transform

    def stamped(parent: str, child: str, stamp_ns: int, place,
                orientation=(0.0, 0.0, 0.0, 1.0)) -> TransformStamped:
        found = TransformStamped(child_frame_id=child, transform=transform(place, orientation))
        found.header.frame_id = parent
        found.header.stamp.sec, found.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        return found

    rclpy.init()
    node = rclpy.create_node('broadcaster')
    publisher = node.create_publisher(TFMessage, '/tf', 100)
    latched = node.create_publisher(TFMessage, '/tf_static', QoSProfile(
        depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    half = 0.5**0.5
    latched.publish(TFMessage(transforms=[
        stamped('world', 'base', 0, BASE, (0.0, 0.0, half, half))]))
    due, under_way = time.time(), deque()
    while True:
        due += 1.0 / RATE
        time.sleep(max(0.0, due - time.time()))
        now_ns = time.time_ns()
        under_way.append((now_ns, TFMessage(transforms=[
            stamped('world', 'tool', now_ns, tool(1e-9 * now_ns)),
            stamped('world', 'hand', now_ns, (-0.2, -0.2, 0.15))])))
        while under_way and under_way[0][0] <= now_ns - 1e9 * LATENCY:
            publisher.publish(under_way.popleft()[1])


if __name__ == '__main__':
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(0)
