"""Whatever bytes come over an input: they are taken, or refused and counted, and nothing else."""

from collections import Counter
from dataclasses import astuple
import math
import random

from geometry_msgs.msg import PointStamped, Vector3Stamped
import pytest
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from support.node import collider, pin, pose_stamped, targets
from xpbd_ros.ros.clouds import cloud_of
from xpbd_ros.ros.command_queue import CommandQueue
from xpbd_ros.ros.inputs import input_of

NAN = float('nan')
GOOD = {
    'pins': [MarkerArray(markers=[pin('a', (0.1, 0.2, 0.3)), pin('b', action=2)]),
             MarkerArray(markers=[pin('a', lifetime_ns=10**9), pin('', action=3)])],
    'colliders': [MarkerArray(markers=[collider('a'), collider('b', kind=2)]),
                  MarkerArray(markers=[collider('c', kind=3, lifetime_ns=5)])],
    'pin_targets': [targets(a=(0, 0, 1), b=(NAN, 0, 0)), targets(a=(1, 2, 3), stamp=10**18)],
    'collider_states': [targets(ball=(0, 0, 1))],
    'collider/a/pose': [pose_stamped((0, 0, 0)), pose_stamped((0, 0, 0), frame_id='é')],
    'wind': [Vector3Stamped()],
    'clicked_point': [PointStamped()],
    'saved_states': [String(data='save')],
    'cloth/a/set_state': [cloud_of([0.1 * k for k in range(24)], 'world', 10**9)],
}
"""messages to begin with, by topic"""
NUMBERS = [b'\xff' * 4, b'\xff' * 8, b'\0' * 8, b'\xff\xff\xff\x7f', b'\0\0\0\x80',
           b'\0\0\0\0\0\0\xf0\x7f', b'\0\0\0\0\0\0\xf8\x7f', b'\xff\xff\xff\xff\xff\xff\xef\x7f',
           b'\x01\0\0\0\0\0\0\0', b'\xc3\x28\xff\0']
"""counts, infinite and tiny numbers, and what is no UTF-8"""


def spoilt(noise: random.Random, data: bytes) -> bytes:
    """Return a message with something done to its bytes."""
    data = bytearray(data)
    for _ in range(noise.randint(0, 4)):
        at, how = noise.randrange(len(data) + 1), noise.randrange(5)
        if how == 0 and data:
            data[at % len(data)] = noise.randrange(256)
        elif how == 1:
            del data[at:]
        elif how == 2:
            at = at // 4 * 4
            number = noise.choice(NUMBERS)
            data[at:at + len(number)] = number
        elif how == 3:
            data[at:at] = noise.randbytes(noise.randint(0, 40))
        else:
            data += data[4:] * noise.randint(1, 20)
    return bytes(data)


def numbers_in(value):
    """Return all floats in a command."""
    if isinstance(value, float):
        return [value]
    return [x for each in value for x in numbers_in(each)] if isinstance(value, tuple) else []


def attack(count: int, seed: int) -> Counter:
    """Send so many spoilt messages to the inputs and return what came of them."""
    noise, said = random.Random(seed), []
    box = CommandQueue(said.append, max_message_bytes=20_000, max_names=64)
    sent = {name: [serialize_message(one) for one in GOOD[name]] for name in GOOD}
    found = Counter()
    for _ in range(count):
        name = noise.choice(list(GOOD))
        kind, read = input_of(f'/{name}')[:2]
        before = box.accepted.total(), box.refused.total()
        data = spoilt(noise, noise.choice(sent[name]))
        box.take(f'/{name}', data, kind, lambda message, read=read: read(message, 'world'))
        taken, refused = (a - b for a, b in zip((box.accepted.total(), box.refused.total()),
                                                before))
        assert taken + refused == 1, (name, data)
        box.close()    # or most would not be said
        commands = [command for group in box.drain() for command in group]
        assert taken or not commands, (name, data)
        for command in commands:
            assert all(map(math.isfinite, numbers_in(astuple(command)))), (name, data)
        found['taken'] += taken
        found['refused'] += refused
    assert not [line for line in said if '\n' in line]
    return found


def test_spoilt_messages():
    found = attack(3000, 1)
    assert found['refused'] > 500
    assert found['taken'] > 100


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(10))
def test_a_hundred_thousand_spoilt_messages(seed):
    found = attack(10_000, 100 + seed)
    print(dict(found))
    assert found['refused'] > 1000
