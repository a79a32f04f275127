"""The observer of the demo, with messages that take long to convert."""

from importlib.util import find_spec
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

from support.node import child_environment

pytestmark = pytest.mark.skipif(
    find_spec('rclpy') is None, reason="rclpy is missing: source a ROS, or pip install '.[ros]'")
JOINTS = 3000
"""so many that a signal comes while their message is converted"""


def test_a_signal_during_the_conversion_of_a_message_ends_it_in_order(context, tmp_path):
    from geometry_msgs.msg import Transform, Wrench
    from rclpy.node import Node
    from sensor_msgs.msg import MultiDOFJointState, PointCloud2
    node = Node('sender', context=context)
    clouds = node.create_publisher(PointCloud2, '/cloth/particles', 10)
    pins = node.create_publisher(MultiDOFJointState, '/cloth/pin_states', 10)
    states = MultiDOFJointState(joint_names=['hand'] * JOINTS, transforms=[Transform()] * JOINTS,
                                wrench=[Wrench()] * JOINTS)
    ended = threading.Event()

    def send() -> None:
        while not ended.wait(0.005):
            clouds.publish(PointCloud2())
            pins.publish(states)
    sender = threading.Thread(target=send)
    sender.start()
    file = tmp_path / 'observed.npz'
    observer = subprocess.Popen([sys.executable, '-m', 'xpbd_ros.demo.observer', str(file)],
                                env=child_environment(), stdout=subprocess.PIPE, text=True)
    try:
        assert observer.stdout.readline() == 'receives\n'
        with pytest.raises(subprocess.TimeoutExpired):
            observer.wait(0.5)
        observer.send_signal(signal.SIGINT)
        assert observer.wait(30.0) == 0
    finally:
        observer.kill()
        ended.set()
        sender.join()
        node.destroy_node()
    assert len(np.load(file)['stamps']) > 0
