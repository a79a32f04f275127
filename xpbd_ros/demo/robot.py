"""
The robot of the demo: a separate program that uses only the topics of the node.

It waits for the first point cloud, grasps two corners of the towel, lifts it, holds it still,
sweeps a ball through it, carries it over a stool and releases it. All its messages are standard
ones. Its time is that of the stamps, so a slow machine runs the same demo, only later.
"""

import json
import sys

from geometry_msgs.msg import PoseStamped, Transform
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

PHASES = {'wait': 0.08, 'grasp': 0.02, 'lift': 0.18, 'hold': 0.2, 'sweep': 0.17, 'carry': 0.1,
          'lower': 0.13, 'settle': 0.02, 'rest': 0.1}
"""parts of the duration; in 'settle' the grippers, which follow with a delay, come to rest"""
LIFT = np.array([0.0, 0.1, 0.9])
CARRY = np.array([0.0, 0.3, 0.0])
LOWER = np.array([0.0, 0.36, -0.6])
SWEEP = np.array([0.0, 2.0, 0.0])
"""displacements of the grippers and of the ball [m]"""


def smooth(s: float) -> float:
    """Return the minimum-jerk polynomial from 0 to 1 at ``s``, clamped."""
    s = min(max(s, 0.0), 1.0)
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)


class Robot(Node):
    """A node that moves two grippers, and a ball on an arm."""

    def __init__(self, duration: float, diary: str):
        super().__init__('robot')
        self.duration, self.diary = duration, diary
        self.pins = self.create_publisher(MarkerArray, '/cloth/pins', 10)
        self.targets = self.create_publisher(MultiDOFJointState, '/cloth/pin_targets', 10)
        self.ball = self.create_publisher(PoseStamped, '/cloth/collider/sphere/pose', 10)
        self.start: float | None = None
        self.phase: str | None = None
        self.corners: dict[str, np.ndarray] = {}
        self.notes: list[dict] = []
        self.path: list[list] = []
        self.holding: set[str] = set()
        self.done = False
        self.create_subscription(MultiDOFJointState, '/cloth/pin_states', self.on_pins, 5)
        self.create_subscription(PointCloud2, '/cloth/particles', self.on_cloud, 5)

    def on_pins(self, pins: MultiDOFJointState) -> None:
        """Remember the names of the pins that hold cloth."""
        self.holding = set(pins.joint_names)

    def on_cloud(self, cloud: PointCloud2) -> None:
        """Send the commands that are due at the stamp of a cloud."""
        now = Time.from_msg(cloud.header.stamp).nanoseconds * 1e-9
        ready = self.pins.get_subscription_count() and self.ball.get_subscription_count()
        if self.start is None and ready:
            self.start = now
        if self.start is None or self.done:
            return
        phase, s = self.where((now - self.start) / self.duration)
        while self.phase != phase:    # enter all phases in turn, also when clouds were lost
            self.enter(self.after(self.phase), now, cloud)
        self.act(phase, s, cloud)

    @staticmethod
    def where(share: float) -> tuple[str, float]:
        """Return the phase at a part (0 to 1) of the duration, and its progress (0 to 1)."""
        for phase, length in PHASES.items():
            if share < length:
                return phase, share / length
            share -= length
        return 'end', 1.0

    @staticmethod
    def after(phase: str | None) -> str:
        """Return the next phase; None comes before the first."""
        order = [*PHASES, 'end']
        return order[0 if phase is None else order.index(phase) + 1]

    def enter(self, phase: str, now: float, cloud: PointCloud2) -> None:
        """Begin a phase: record it, and grasp or release where it asks for that."""
        self.phase = phase
        self.notes.append({'phase': phase, 'time': now})
        print(phase, flush=True)
        if phase == 'grasp':
            points = np.frombuffer(cloud.data, np.float32).reshape(cloud.height, cloud.width, 3)
            self.corners = {'left': points[-1, 0].astype(float),
                            'right': points[-1, -1].astype(float)}
            self.mark(Marker.ADD)
        elif phase == 'rest':
            self.mark(Marker.DELETE)
        elif phase == 'end':
            self.done = True
            with open(self.diary, 'x', encoding='utf-8') as file:
                json.dump({'phases': self.notes, 'path': self.path}, file)

    def mark(self, action: int) -> None:
        """Grasp the corners (Marker.ADD) or release them (Marker.DELETE)."""
        markers = []
        for name, corner in self.corners.items():
            marker = Marker(ns=name, type=Marker.SPHERE, action=action)
            marker.header.frame_id = 'world'
            x, y, z = corner
            marker.pose.position.x, marker.pose.position.y, marker.pose.position.z = x, y, z
            marker.scale.x = marker.scale.y = marker.scale.z = 0.07    # twice the radius
            markers.append(marker)
        self.pins.publish(MarkerArray(markers=markers))

    def act(self, phase: str, s: float, cloud: PointCloud2) -> None:
        """Publish the targets of the grippers and of the ball at progress ``s`` of a phase."""
        order = list(PHASES)
        done = {name: 1.0 if order.index(name) < order.index(phase) else
                smooth(s) if name == phase else 0.0 for name in order} if phase in order else {}
        if phase in ('lift', 'hold', 'sweep', 'carry', 'lower', 'settle'):
            way = done['lift'] * LIFT + done['carry'] * CARRY + done['lower'] * LOWER
            targets = {name: corner + way for name, corner in self.corners.items()}
            message = MultiDOFJointState(joint_names=list(targets))
            message.header = cloud.header
            for x, y, z in targets.values():
                transform = Transform()
                transform.translation.x, transform.translation.y = x, y
                transform.translation.z = z
                message.transforms.append(transform)
            self.targets.publish(message)
            self.path.append([Time.from_msg(cloud.header.stamp).nanoseconds * 1e-9,
                              *(list(map(float, p)) for p in targets.values())])
        if phase == 'sweep':
            there_and_back = 0.5 - 0.5 * np.cos(2.0 * np.pi * s)
            x, y, z = np.array([0.0, -0.75, 0.55]) + 0.6 * there_and_back * SWEEP
            pose = PoseStamped(header=cloud.header)
            pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = x, y, z
            self.ball.publish(pose)


def main() -> int:
    """Run the robot for a duration [s]; write its path as JSON: ``robot.py DURATION FILE``."""
    rclpy.init()
    robot = Robot(float(sys.argv[1]), sys.argv[2])
    try:
        while rclpy.ok() and not robot.done:
            rclpy.spin_once(robot, timeout_sec=0.5)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    robot.destroy_node()
    rclpy.try_shutdown()
    return 0 if robot.done else 1


if __name__ == '__main__':
    sys.exit(main())
