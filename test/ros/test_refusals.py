"""What makes no sense is refused whole, said once, counted, and changes nothing."""

from math import inf, nan
import random
import struct

from geometry_msgs.msg import PoseStamped, Twist
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from ros.rig import Cloth, pin, points, pose_stamped, targets, transform
from sensor_msgs.msg import MultiDOFJointState
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from xpbd_ros.log.reader import LogReader
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene

KINDS = {'pins': MarkerArray, 'pin_targets': MultiDOFJointState,
         'collider_states': MultiDOFJointState, 'collider/ball/pose': PoseStamped}
NO_ROTATION = (0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """Return where the node records to."""
    return tmp_path_factory.mktemp('log') / 'run'


@pytest.fixture(scope='module')
def cloth(start, peer, towel, run):
    """Return a node in real time; nothing that it takes has any effect in this file."""
    cloth = Cloth(peer, start(scene=towel, record__path=run))
    peer.until(lambda: cloth.clouds and cloth.statuses, 'the node')
    return cloth


def marker(**changes) -> Marker:
    """Return a grasp with something changed; a dot is written as ``__``."""
    found = pin('a', (0.0, 0.0, 0.0))
    for path, value in changes.items():
        *parents, name = path.split('__')
        part = found
        for parent in parents:
            part = getattr(part, parent)
        setattr(part, name, value)
    return found


def twist(**changes) -> Twist:
    """Return a twist with these linear components."""
    found = Twist()
    for axis, value in changes.items():
        setattr(found.linear, axis, value)
    return found


def lengths(names: int, transforms: int, twists: int) -> MultiDOFJointState:
    """Return a message whose arrays do not match."""
    return MultiDOFJointState(joint_names=[f'n{k}' for k in range(names)],
                              transforms=[transform((0.0, 0.0, 0.0))] * transforms,
                              twist=[Twist()] * twists)


def stamped(message, sec: int, nanosec: int):
    """Return a message with another stamp."""
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    return message


BAD_MARKERS = [
    (marker(header__frame_id='map'), "marker a/0: TF frame 'map' is not the scene's 'world'"),
    (marker(pose__position__x=nan), 'marker a/0: position or orientation is not finite'),
    (marker(pose__orientation__w=inf), 'marker a/0: position or orientation is not finite'),
    (marker(pose__orientation__w=0.0), 'marker a/0: orientation [0.0, 0.0, 0.0, 0.0] is not a '
                                       'unit quaternion'),
    (marker(pose__position__z=-1e7), 'is further than 1e+06 m away'),
    (marker(scale__x=0.0), 'scale.x is twice the grasp radius and must be > 0 m (got 0.0)'),
    (marker(scale__x=nan), 'scale.x is twice the grasp radius and must be > 0 m (got nan)'),
    (marker(ns='no good!'), "marker no good!/0: bad name 'no good!'"),
    (marker(id=-1), "marker a/-1: bad name 'a_-1'"),
    (marker(action=7), 'marker a/0: unknown action 7'),
    (marker(lifetime__sec=-1), 'marker a/0: lifetime: -1 s and 0 ns make no sense'),
    (marker(lifetime__nanosec=2**32 - 1), 'marker a/0: lifetime: 0 s and 4294967295 ns'),
    (marker(pose__position__x=5.0), "pin 'a': no free particle within 0.01 m of "
                                    '[5.0, 0.0, 0.0]; the nearest is 4.8 m away'),
    (pin('ghost', action=Marker.DELETE), "pin 'ghost' holds nothing (holding: none)"),
]
BAD_TARGETS = [
    ('pin_targets', targets(frame_id='map', left=(0, 0, 0)), "header: TF frame 'map'"),
    ('pin_targets', targets(left=(0, 0, 0)), "pin 'left' holds nothing"),
    ('pin_targets', targets(left=(nan, 0, 0)), 'left: position or orientation is not finite'),
    ('pin_targets', targets(left=transform((0, 0, 0), NO_ROTATION)), 'left: orientation [0.0, '),
    ('pin_targets', lengths(2, 1, 0), '2 names but 1 transforms and 0 twists'),
    ('pin_targets', lengths(0, 1, 0), '0 names but 1 transforms'),
    ('pin_targets', lengths(2, 2, 1), '2 names but 2 transforms and 1 twists'),
    ('pin_targets', targets(left=(0, 0, 0), twist=twist(x=nan)), 'left: twist is not finite'),
    ('pin_targets', targets(left=(0, 0, 0), twist=twist(z=1e200)), 'is faster than 1e+06'),
    ('pin_targets', stamped(targets(left=(0, 0, 0)), 0, 10**9), 'stamp: 0 s and 1000000000 ns'),
    ('pin_targets', stamped(targets(left=(0, 0, 0)), -1, 0), 'stamp: -1 s and 0 ns'),
    ('pin_targets', targets(**{'a/b': (0, 0, 0)}), "joint_names: bad name 'a/b'"),
    ('collider_states', targets(nobody=(0, 0, 0)),
     "unknown collider 'nobody' (known: table, ball)"),
    ('collider_states', targets(**{'': (0, 0, 0)}), "joint_names: bad name ''"),
    ('collider/ball/pose', pose_stamped((0, 0, 0), frame_id='tool0'),
     "header: TF frame 'tool0' is not the scene's 'world'; transform it first"),
    ('collider/ball/pose', pose_stamped((0, inf, 0)), 'ball: position or orientation is not'),
    ('collider/ball/pose', pose_stamped((0, 0, 0), NO_ROTATION), 'is not a unit quaternion'),
]


@pytest.mark.parametrize(('bad', 'reason'), BAD_MARKERS, ids=lambda value: str(value)[:40])
def test_refuses_a_grasp_that_makes_no_sense(cloth, bad, reason):
    line = cloth.refuses('pins', MarkerArray(markers=[bad]), reason)
    assert line.startswith('[WARN]')


@pytest.mark.parametrize(('topic', 'bad', 'reason'), BAD_TARGETS,
                         ids=[f'{topic}: {reason}' for topic, _, reason in BAD_TARGETS])
def test_refuses_a_target_that_makes_no_sense(cloth, topic, bad, reason):
    cloth.refuses(topic, bad, reason)


def test_refuses_a_message_whole(cloth):
    """A good grasp beside a bad one: neither is done."""
    corner = pin('good', (-0.2, -0.2, 0.004))
    cloth.refuses('pins', MarkerArray(markers=[corner, marker(pose__position__x=nan)]),
                  'not finite')
    cloth.refuses('pins', MarkerArray(markers=[pin('good', action=Marker.DELETE)]),
                  "pin 'good' holds nothing")


def test_refuses_more_entries_than_there_is_room_for(cloth):
    """Said by the count that stands at the front of it, before anything is unpacked."""
    cloth.refuses('pins', MarkerArray(markers=[Marker()] * 10_000),
                  '10000 entries, and there is room for 65')
    many = {f'n{k}': (0, 0, 0) for k in range(100)}
    cloth.refuses('collider_states', targets(**many), '100 entries, and there is room for 65')


def test_refuses_a_message_that_is_too_long(cloth):
    cloth.refuses('pins', MarkerArray(markers=[marker(text='x' * 5_000_000)]),
                  'bytes are more than max_message_bytes (4194304)')


@pytest.mark.parametrize('topic', KINDS)
@pytest.mark.parametrize('garbage', [
    b'\0\1\0\0', b'\0\1\0\0' + b'\xff' * 40, b'\0\0\0\0' + b'\xff' * 40,
    bytes(range(256)), serialize_message(String(data='not at all ' * 9)),
], ids=['header only', 'little endian', 'big endian', 'bytes', 'a string'])
def test_refuses_bytes_that_are_no_message(cloth, topic, garbage):
    cloth.refuses(topic, garbage, kind=KINDS[topic])


def test_nothing_of_it_had_any_effect(cloth, run, towel):
    """The states are those of the scene left alone, bit for bit."""
    count = int(cloth.status()['frame'])
    assert cloth.record(False)[0]
    hashes = [struct.unpack_from('<Q', message.data, 4)[0]
              for message in LogReader(run).messages({'/cloth/state_hash'})]
    assert len(hashes) > count > 60
    simulation = compile_scene(load_scene(str(towel)))
    assert hashes[0] == simulation.hash()
    for frame, value in enumerate(hashes[1:], 1):
        simulation.step()
        assert value == simulation.hash(), frame
    inputs = {'/cloth/pins', '/cloth/pin_targets', '/cloth/collider_states'}
    assert not inputs & set(LogReader(run).topics)


def test_a_flood_is_counted_in_full_and_said_once_a_second(cloth):
    counter = 'rejected /cloth/collider/ball/pose'
    first = cloth.refuses('collider/ball/pose', pose_stamped((nan, 0, 0)), 'not finite')
    start = cloth.node.lines.index(first)
    before = int(cloth.status()[counter])
    warned = len(cloth.node.said('/cloth/collider/ball/pose: refused'))
    begin = cloth.node.process.args and cloth.status()
    while int(cloth.statuses[-1][counter]) < before + 300:
        cloth.peer.say('/cloth/collider/ball/pose', pose_stamped((nan, 0, 0)))
        cloth.peer.spin(0.002)
    seconds = (float(cloth.statuses[-1]['frame']) - float(begin['frame'])) / 60.0
    lines = len(cloth.node.said('/cloth/collider/ball/pose: refused')) - warned
    assert lines <= 2.0 * seconds + 2.0
    del start


def test_noise_does_no_harm(cloth):
    """Good messages with a few bytes changed: most are refused, some pass, none kills."""
    noise = random.Random(7)
    good = {'pins': MarkerArray(markers=[pin('a', (0.0, 0.0, 0.004), lifetime_ns=10**8)] * 2),
            'pin_targets': targets(a=(0.1, 0.0, 0.1), twist=twist(x=0.1)),
            'collider_states': targets(ball=(0.0, 1.0, 0.15), twist=twist(x=0.1)),
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
