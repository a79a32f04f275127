"""What makes no sense is refused whole, said once, counted, and changes nothing."""

from math import nan
import random
import struct
import time

from geometry_msgs.msg import PointStamped, PoseStamped, Twist
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from support.node import Cloth, collider, PATIENCE, pin, points, pose_stamped, targets
from xpbd_ros.log.reader import LogReader
from xpbd_ros.ros.clouds import cloud_of
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene

KINDS = {'pins': MarkerArray, 'pin_targets': MultiDOFJointState,
         'colliders': MarkerArray, 'collider_states': MultiDOFJointState,
         'collider/ball/pose': PoseStamped, 'clicked_point': PointStamped,
         'set_state': PointCloud2}
TINY = Twist()
TINY.linear.x = 1e-200
"""its square is 0"""
CORNER = (-0.2, -0.2, 0.004)


def markers(*found: Marker) -> MarkerArray:
    """Return a message for ~/pins."""
    return MarkerArray(markers=list(found))


def uneven() -> MultiDOFJointState:
    """Return a message with more names than transforms."""
    message = targets(left=(0, 0, 0))
    message.joint_names.append('right')
    return message


def clicked(x: float, frame_id: str = 'world') -> PointStamped:
    """Return a message for ~/clicked_point."""
    message = PointStamped()
    message.header.frame_id, message.point.x = frame_id, float(x)
    return message


def cloud(count: int, frame_id: str = 'world', **changes) -> PointCloud2:
    """Return a message for ~/set_state."""
    message = cloud_of([0.0] * 3 * count, frame_id, 0)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


BAD = {
    'clicked_point': [
        (clicked(1.2), 'no particle within 0.05 m of [1.2, 0.0, 0.0]; the nearest is 1 m away'),
        (clicked(nan), 'point [nan, 0.0, 0.0] is not finite'),
        (clicked(0.0, 'camera'), "header: TF frame 'camera' is not the scene's 'world'"),
        (b'\0\1\0\0', 'cannot be unpacked'),
    ],
    'set_state': [
        (cloud(80), "80 points, and 'towel' has 81 particles: too few to register"),
        (cloud(99, 'camera'), "header: TF frame 'camera' is not the scene's 'world'"),
        (cloud(99, fields=[]), 'fields: no x, y, z (there are: none)'),
        (cloud(99, row_step=2000), '1 rows of 99 points of 24 bytes, row_step 2000: and there'),
    ],
    'pins': [
        (markers(pin('a', CORNER, frame_id='map')),
         "marker a/0: TF frame 'map' is not the scene's 'world'; "),
        (markers(pin('a', (5.0, 0.0, 0.0))), "pin 'a': no free particle within 0.01 m of "
                                             '[5.0, 0.0, 0.0]; the nearest is 4.8'),
        (markers(pin('good', CORNER), pin('bad', (nan, 0.0, 0.0))), 'marker bad/0: position or'),
        (markers(pin('good', action=Marker.DELETE)), "pin 'good' holds nothing (holding: none)"),
        (markers(*[Marker()] * 10_000), '10000 entries, and there is room for 65'),
        (MarkerArray(markers=[Marker(text='x' * 5_000_000)]),
         'bytes are more than max_message_bytes (4194304)'),
    ],
    'pin_targets': [
        (targets(left=(0, 0, 0)), "pin 'left' holds nothing (holding: none)"),
        (uneven(), '2 names but 1 transform and 0 twists'),
        (targets(**{'no good!': (0, 0, 0)}), "joint_names: bad name 'no good!'"),
        (b'\0\1\0\0' + b'\xff' * 40, 'cannot be unpacked'),
    ],
    'colliders': [
        (markers(collider('a', size=(0.1, 0.0, 0.1))), 'marker a/0: scale [0.1, 0.0, 0.1] must'),
        (markers(collider('a'), collider('a', (0, 0, nan))), 'marker a/0: position or'),
        (markers(collider('absent', action=Marker.DELETE)), "unknown collider 'absent' (known: "),
        (markers(*[Marker()] * 66), '66 entries, and there is room for 65'),
    ],
    'collider_states': [
        (targets(absent=(0, 0, 0)), "unknown collider 'absent' (known: table, ball)"),
        (targets(ball=(0, nan, 0)), 'ball: position or orientation is not finite'),
        (serialize_message(String(data='not at all ' * 9)), 'cannot be unpacked'),
    ],
    'collider/ball/pose': [
        (pose_stamped((0, 0, 0), (0, 0, 0, 0)), 'ball: orientation [0.0, 0.0, 0.0, 0.0] is not a '
                                                'unit quaternion'),
        (pose_stamped((0, 0, 0), frame_id='tool0'), "header: TF frame 'tool0' is not the scene's"),
        (b'\0\1\0\0', 'cannot be unpacked'),
    ],
}


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """Return where the node records to."""
    return tmp_path_factory.mktemp('log') / 'run'


@pytest.fixture(scope='module')
def cloth(start, peer, towel, run):
    """Return a node in real time."""
    cloth = Cloth(peer, start(scene=towel, record__path=run))
    peer.until(lambda: cloth.clouds and cloth.statuses, 'the node')
    return cloth


def refused(cloth, topic: str) -> int:
    """Return how many inputs of a topic /diagnostics says were refused."""
    return int(cloth.statuses[-1].get(f'rejected {cloth.name}/{topic}', 0))


def warnings(cloth, topic: str, start: int = 0) -> list[str]:
    """Return what was said about a topic, from a line of the output on."""
    return [line for line in cloth.node.lines[start:]
            if f'{cloth.name}/{topic}: refused: ' in line]


def test_each_refusal_is_one_line_with_topic_name_and_reason(cloth):
    """All topics at a time, as there is one warning a second from each."""
    todo = {topic: list(bad) for topic, bad in BAD.items()}
    starts = dict.fromkeys(todo, 0)
    deadline = time.monotonic() + PATIENCE
    while any(todo.values()):
        assert time.monotonic() < deadline, (todo, cloth.node.lines)
        for topic, bad in todo.items():
            if bad:
                cloth.peer.say(f'/cloth/{topic}', bad[0][0], KINDS[topic])
        cloth.peer.spin(0.2)
        for topic, bad in todo.items():
            said = [line for line in warnings(cloth, topic, starts[topic])
                    if bad and bad[0][1] in line]
            if said:
                assert said[0].startswith('[WARN]')
                starts[topic] = len(cloth.node.lines)
                bad.pop(0)
    status = cloth.status(lambda status: all(f'rejected /cloth/{topic}' in status
                                             for topic in BAD))
    assert int(status['rejected_inputs']) == sum(refused(cloth, topic) for topic in BAD) > 0
    assert not cloth.node.said('Traceback')


def test_nothing_of_it_had_any_effect(cloth, run, towel):
    """The states are those of the scene left alone, bit for bit, and the log holds no input."""
    count = int(cloth.status()['frame'])
    assert cloth.record(False)[0]
    reader = LogReader(run)
    hashes = [struct.unpack_from('<Q', message.data, 4)[0]
              for message in reader.messages({'/cloth/state_hash'})]
    assert len(hashes) > count
    simulation = compile_scene(load_scene(str(towel)))
    assert hashes[0] == simulation.hash()
    for frame, value in enumerate(hashes[1:], 1):
        simulation.step()
        assert value == simulation.hash(), frame
    assert not {f'/cloth/{topic}' for topic in BAD} & set(reader.topics)


def test_a_flood_is_said_once_a_second_and_counted_in_full(cloth):
    topic, bad = 'collider/ball/pose', pose_stamped((nan, 0, 0))

    def told() -> int:
        """Return how many refusals the lines of the output account for."""
        lines = warnings(cloth, topic)
        return sum(int(line.split('… and ')[1].split()[0]) if '… and ' in line else 1
                   for line in lines)

    cloth.peer.spin(1.5)
    before, start, begin = refused(cloth, topic), len(cloth.node.lines), time.monotonic()
    while refused(cloth, topic) < before + 300:
        assert time.monotonic() < begin + PATIENCE
        cloth.peer.say(f'/cloth/{topic}', bad)
        cloth.peer.spin(0.002)
    lines = warnings(cloth, topic, start)
    assert 1 <= len(lines) <= time.monotonic() - begin + 1.0
    cloth.peer.spin(1.5)
    cloth.peer.until(lambda: told() == refused(cloth, topic), 'all of them', lambda: (
        told(), refused(cloth, topic)))


def test_a_speed_too_small_to_square_is_none(cloth):
    cloth.peer.say('/cloth/collider_states', targets(ball=(0.0, 1.0, 0.2), twist=TINY))
    cloth.peer.say('/cloth/pins', markers(pin('slow', CORNER)))
    cloth.status(lambda status: status['pins'] == '1')
    cloth.peer.say('/cloth/pin_targets', targets(slow=(-0.2, -0.2, 0.1), twist=TINY))
    cloth.peer.until(lambda: points(cloth.clouds[-1])[0, 0, 2] > 0.09, 'the pin')
    cloth.peer.say('/cloth/pins', markers(pin('slow', action=Marker.DELETE)))
    cloth.status(lambda status: status['pins'] == '0')


def test_noise_does_no_harm(cloth):
    """Good messages with a few bytes changed: most are refused, some pass, none kills."""
    noise = random.Random(7)
    speed = Twist()
    speed.linear.x = 0.1
    good = {'pins': markers(pin('a', CORNER, lifetime_ns=10**8), pin('a', CORNER)),
            'pin_targets': targets(a=(0.1, 0.0, 0.1), twist=speed),
            'collider_states': targets(ball=(0.0, 1.0, 0.15), twist=speed),
            'collider/ball/pose': pose_stamped((0.0, 1.0, 0.15))}
    for count in range(1500):
        topic = noise.choice(list(good))
        data = bytearray(serialize_message(good[topic]))
        for _ in range(noise.randint(1, 3)):
            at = noise.randrange(4, len(data))
            data[at:at + 1] = noise.choice([b'', b'\0', b'\xff', b'\x7f', b'\x80', b'\0\0\0\0',
                                            noise.randbytes(8)])
        cloth.peer.say(f'/cloth/{topic}', bytes(data), KINDS[topic])
        if count % 10 == 0:
            cloth.peer.spin(0.005)
    frame = int(cloth.status()['frame'])
    assert int(cloth.status()['frame']) > frame, 'goes on'
    assert np.isfinite(points(cloth.clouds[-1])).all()
    assert not cloth.node.said('FATAL')
    assert not cloth.node.said('Traceback')


def test_what_the_simulation_refuses_is_said_of_the_topic_that_it_came_by(cloth):
    cloth.peer.say('/cloth/colliders', markers(collider('ball', action=Marker.DELETE)))
    topic, before = 'collider/ball/pose', len(cloth.node.lines)
    cloth.peer.spin(1.0)    # frames that remove it
    cloth.peer.say(f'/cloth/{topic}', pose_stamped((0.0, 1.0, 0.2)))
    cloth.peer.until(lambda: any("unknown collider 'ball'" in line
                                 for line in warnings(cloth, topic, before)), 'the refusal')
