"""Nodes of the demo and of the tests have sockets on loopback only, and find one another."""

import os
from pathlib import Path
import subprocess
import sys

import pytest

from xpbd_ros.demo.domain import FAST_DDS, private_environment

NODE = """
import sys, time
import rclpy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node(sys.argv[1])
heard = []
publisher = node.create_publisher(String, 'topic', 1)
node.create_subscription(String, sys.argv[2], heard.append, 1)
node.create_timer(0.05, lambda: publisher.publish(String()))
end = time.monotonic() + 60.0
while not heard and time.monotonic() < end:
    rclpy.spin_once(node)
print('heard' if heard else 'alone', flush=True)
while True:
    rclpy.spin_once(node)
"""
"""publishes on a topic, and tells whether it hears another"""

pytestmark = pytest.mark.skipif(
    os.environ.get('RMW_IMPLEMENTATION') not in (None, '', *FAST_DDS), reason='not Fast DDS')


def addresses(process: int) -> set[str]:
    """Return the local IP addresses of a process' sockets, as /proc/net has them."""
    files = [os.readlink(file) for file in Path(f'/proc/{process}/fd').iterdir()]
    found = set()
    for table in ('udp', 'udp6', 'tcp', 'tcp6'):
        for line in Path(f'/proc/{process}/net/{table}').read_text().splitlines()[1:]:
            words = line.split()
            if f'socket:[{words[9]}]' in files:
                found.add(words[1].split(':')[0])
    return found


@pytest.mark.parametrize('environment', [private_environment, lambda: dict(os.environ)],
                         ids=['demo', 'tests'])
def test_sockets_are_on_loopback_only(own_domain, environment):
    pytest.importorskip('rclpy', reason="rclpy is missing: source a ROS, or pip install '.[ros]'")
    variables, nodes = environment(), []
    try:
        for name, other in (('left', '/right/topic'), ('right', '/left/topic')):
            nodes.append(subprocess.Popen(
                [sys.executable, '-c', NODE, name, other, '--ros-args', '-r',
                 f'topic:=/{name}/topic'], env=variables, stdout=subprocess.PIPE, text=True))
        for node in nodes:
            assert node.stdout.readline() == 'heard\n'
            assert addresses(node.pid) == {'0100007F'}    # 127.0.0.1
    finally:
        for node in nodes:
            node.kill()
            node.communicate()
