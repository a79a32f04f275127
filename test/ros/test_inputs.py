"""Messages to commands and back: what is refused, with which words, and what comes through."""

from math import inf, nan
import random
import time

from geometry_msgs.msg import Point, PoseStamped, Twist, Vector3, Vector3Stamped
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import MultiDOFJointState
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker, MarkerArray

from support.node import pin, pose_stamped, targets, transform
from support.waiting import until
from xpbd_ros.errors import InputError
from xpbd_ros.ros import command_queue
from xpbd_ros.ros.command_messages import as_messages
from xpbd_ros.ros.command_queue import CommandQueue
from xpbd_ros.ros.inputs import (
    count_in,
    input_of,
    INPUTS,
    read_colliders,
    read_pins,
    read_pose,
    read_targets,
    read_wind,
    unpacked,
)
from xpbd_ros.sim import commands
from xpbd_ros.sim.commands import (
    Click,
    Grasp,
    LoadState,
    MoveCollider,
    MovePin,
    PlaceCollider,
    Pose,
    Release,
    ReleaseAll,
    RemoveAllColliders,
    RemoveCollider,
    Reset,
    SaveState,
    SetKey,
    SetState,
    SetWind,
)

NO_ROTATION = (0.0, 0.0, 0.0, 0.0)
HERE = Pose((0.1, 0.2, 0.3))


def changed(message, **changes):
    """Return a message with something in it changed; a dot is written as ``__``."""
    for path, value in changes.items():
        *parents, name = path.split('__')
        part = message
        for parent in parents:
            part = getattr(part, parent)
        setattr(part, name, value)
    return message


def twist(**linear) -> Twist:
    """Return a twist with these linear components [m/s]."""
    return changed(Twist(), **{f'linear__{axis}': value for axis, value in linear.items()})


def twice(name: str) -> MultiDOFJointState:
    """Return a message with two targets of one name."""
    message = targets(**{name: (0, 0, 0)})
    message.joint_names.append(name)
    message.transforms.append(message.transforms[0])
    return message


def lengths(names: int, transforms: int, twists: int) -> MultiDOFJointState:
    """Return a message whose arrays may not match."""
    return MultiDOFJointState(joint_names=[f'n{k}' for k in range(names)],
                              transforms=[transform((0.0, 0.0, 0.0))] * transforms,
                              twist=[Twist()] * twists)


@pytest.mark.parametrize(('changes', 'reason'), [
    ({'header__frame_id': 'map'}, "marker a/0: TF frame 'map' is not the scene's 'world'; "
                                  'transform it first'),
    ({'pose__position__x': nan}, 'marker a/0: position or orientation is not finite'),
    ({'pose__orientation__w': inf}, 'marker a/0: position or orientation is not finite'),
    ({'pose__orientation__w': 0.0}, 'marker a/0: orientation [0.0, 0.0, 0.0, 0.0] is not a unit '
                                    'quaternion'),
    ({'pose__position__z': -1e7}, 'marker a/0: position [0.0, 0.0, -10000000.0] is further than '
                                  '1e+06 m away'),
    ({'scale__x': 0.0}, 'marker a/0: scale.x is twice the grasp radius and must be finite '
                        'and > 0 m (got 0.0)'),
    ({'scale__x': -1.0}, 'must be finite and > 0 m (got -1.0)'),
    ({'scale__x': nan}, 'must be finite and > 0 m (got nan)'),
    ({'scale__x': inf}, 'must be finite and > 0 m (got inf)'),
    ({'scale__x': 5e-324}, 'must be finite and > 0 m (got 5e-324)'),
    ({'ns': 'no good!'}, "marker no good!/0: bad name 'no good!'"),
    ({'ns': 'ä'}, "marker ä/0: bad name 'ä'"),
    ({'id': -1}, "marker a/-1: bad name 'a_-1'"),
    ({'action': 7}, 'marker a/0: unknown action 7'),
    ({'lifetime__sec': -1}, 'marker a/0: lifetime: -1 s and 0 ns are not a valid time'),
    ({'lifetime__nanosec': 2**32 - 1},
     'marker a/0: lifetime: 0 s and 4294967295 ns are not a valid time'),
])
def test_a_grasp_that_makes_no_sense(changes, reason):
    good = pin('good', (0.0, 0.0, 0.0))
    with pytest.raises(InputError) as error:
        read_pins(MarkerArray(markers=[good, changed(pin('a'), **changes)]), 'world')
    assert reason in str(error.value)


@pytest.mark.parametrize(('changes', 'reason'), [
    ({'header__frame_id': 'map'}, "marker a/0: TF frame 'map' is not the scene's 'world'"),
    ({'pose__position__x': nan}, 'marker a/0: position or orientation is not finite'),
    ({'scale__y': 0.3}, 'marker a/0: scale [0.2, 0.3, 0.2] must be the same across'),
    ({'scale__z': 0.3}, 'marker a/0: scale [0.2, 0.2, 0.3] must be the same across'),
    ({'scale__z': 0.0}, 'marker a/0: scale [0.2, 0.2, 0.0] must be > 0 m'),
    ({'scale__z': -0.2}, 'must be > 0 m'),
    ({'scale__x': nan}, 'must be > 0 m'),
    ({'scale__x': inf}, 'must be > 0 m'),
    ({'scale__x': 5e-324}, 'must be > 0 m'),
    ({'type': Marker.ARROW}, 'marker a/0: type 0 is no collider (known: CUBE, SPHERE, CYLINDER'),
    ({'type': Marker.CYLINDER, 'scale__x': 0.3}, 'must be the same across'),
    ({'type': Marker.TRIANGLE_LIST}, 'marker a/0: 0 points are no triangles'),
    ({'type': Marker.TRIANGLE_LIST, 'points': [Point()] * 4}, '4 points are no triangles'),
    ({'type': Marker.TRIANGLE_LIST, 'points': [Point(x=nan)] * 3}, '3 points are no triangles'),
    ({'ns': 'no good!'}, "bad name 'no good!'; it must match [A-Za-z_][A-Za-z0-9_]*"),
    ({'id': -1}, "bad name 'a_-1'"),
    ({'action': 7}, 'marker a/0: unknown action 7'),
    ({'lifetime__sec': -1}, 'marker a/0: lifetime: -1 s and 0 ns are not a valid time'),
])
def test_a_collider_that_makes_no_sense(changes, reason):
    good = pin('good', (0.0, 0.0, 0.0))
    with pytest.raises(InputError) as error:
        read_colliders(MarkerArray(markers=[good, changed(pin('a', radius=0.1), **changes)]),
                       'world')
    assert reason in str(error.value)


def test_markers_become_colliders():
    ball, tube, box = pin('a', radius=0.1), pin('', (1, 2, 3)), pin('c', lifetime_ns=7)
    changed(tube, type=Marker.CYLINDER, id=4, scale__x=0.2, scale__y=0.2, scale__z=0.5)
    changed(box, type=Marker.CUBE, scale__x=0.1, scale__y=0.2, scale__z=0.3)
    wipe, gone = pin('', action=Marker.DELETEALL), pin('b', action=Marker.DELETE)
    assert read_colliders(MarkerArray(markers=[wipe, ball, tube, box, gone]), 'world') == [
        RemoveAllColliders(), PlaceCollider('a', 'sphere', (0.1,), Pose()),
        PlaceCollider('collider_4', 'cylinder', (0.1, 0.5), Pose((1.0, 2.0, 3.0))),
        PlaceCollider('c', 'box', (0.1, 0.2, 0.3), Pose(), 7), RemoveCollider('b')]


@pytest.mark.parametrize(('message', 'reason'), [
    (targets(frame_id='map', left=(0, 0, 0)), "header: TF frame 'map' is not the scene's 'world'"),
    (targets(left=(nan, 0, 0)), 'left: position or orientation is not finite'),
    (targets(left=transform((0, 0, 0), NO_ROTATION)), 'left: orientation [0.0, 0.0, 0.0, 0.0]'),
    (targets(left=transform((0, 0, 0), (0, 0, 0, 1e200))), 'is not a unit quaternion'),
    (lengths(2, 1, 0), '2 names but 1 transform and 0 twists'),
    (lengths(0, 1, 0), '0 names but 1 transform and 0 twists'),
    (lengths(2, 2, 1), '2 names but 2 transforms and 1 twist'),
    (targets(left=(0, 0, 0), twist=twist(x=nan)), 'left: twist is not finite'),
    (targets(left=(0, 0, 0), twist=twist(z=1e200)), 'is faster than 1e+06'),
    (targets(left=(0, 0, 0), stamp=-1),
     'header: stamp: -1 s and 999999999 ns are not a valid time'),
    (changed(targets(left=(0, 0, 0)), header__stamp__nanosec=10**9), '0 s and 1000000000 ns'),
    (twice('left'), "joint_names: 'left' twice; send one target of each"),
    (targets(**{'a/b': (0, 0, 0)}), "joint_names: bad name 'a/b'"),
    (targets(**{'': (0, 0, 0)}), "joint_names: bad name ''"),
    (targets(**{'x' * 1000 + '!': (0, 0, 0)}), f"joint_names: bad name '{'x' * 40}'"),
])
@pytest.mark.parametrize('kind', [MovePin, MoveCollider])
def test_targets_that_make_no_sense(message, reason, kind):
    with pytest.raises(InputError) as error:
        read_targets(message, 'world', kind)
    assert reason in str(error.value)


@pytest.mark.parametrize(('message', 'reason'), [
    (pose_stamped((0, 0, 0), frame_id='tool0'), "header: TF frame 'tool0'"),
    (pose_stamped((0, inf, 0)), 'ball: position or orientation is not finite'),
    (pose_stamped((0, 0, 0), NO_ROTATION), 'ball: orientation [0.0, 0.0, 0.0, 0.0] is not'),
    (changed(pose_stamped((0, 0, 0)), header__stamp__sec=-5), 'header: stamp: -5 s and 0 ns'),
])
def test_a_pose_that_makes_no_sense(message, reason):
    with pytest.raises(InputError) as error:
        read_pose(message, 'world', 'ball')
    assert reason in str(error.value)


def test_an_empty_tf_frame_is_the_scenes():
    (command,) = read_pose(pose_stamped((1, 2, 3), frame_id=''), 'base_link', 'ball')
    assert command == MoveCollider('ball', Pose((1.0, 2.0, 3.0)), None, 0)


def test_a_quaternion_that_is_nearly_one_is_made_one():
    (command,) = read_pose(pose_stamped((0, 0, 0), (0, 0, 0.6, 0.801)), 'world', 'ball')
    assert sum(c * c for c in command.pose.orientation) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize('garbage', [
    b'', b'\0', b'\0\1\0\0', b'\0\1\0\0' + b'\xff' * 40, b'\0\0\0\0' + b'\xff' * 40,
    bytes(range(256)), serialize_message(String(data='not at all ' * 9)),
], ids=['empty', 'one byte', 'header only', 'little endian', 'big endian', 'bytes', 'a string'])
@pytest.mark.parametrize('kind', [MarkerArray, MultiDOFJointState, PoseStamped])
def test_bytes_that_are_no_message(garbage, kind):
    count_in(garbage, kind)    # of a kind that has a count; never raises
    with pytest.raises(InputError, match='cannot be unpacked'):
        unpacked(garbage, kind)


@pytest.mark.parametrize('good', [MarkerArray(markers=[pin('a')]), targets(left=(0, 0, 0)),
                                  pose_stamped((0, 0, 0))], ids=lambda m: type(m).__name__)
def test_a_message_cut_off_anywhere(good):
    data = serialize_message(good)
    for end in range(len(data) - 4):    # what CDR pads with may be gone
        count_in(data[:end], type(good))
        with pytest.raises(InputError, match='cannot be unpacked'):
            unpacked(data[:end], type(good))


@pytest.mark.parametrize('frame_id', ['', 'w', 'wo', 'wor', 'world', 'a_longer_one'])
def test_the_count_is_read_without_unpacking(frame_id):
    names = {f'n{k}': (0, 0, 0) for k in range(7)}
    assert count_in(serialize_message(targets(frame_id=frame_id, **names)),
                    MultiDOFJointState) == 7
    assert count_in(serialize_message(MarkerArray(markers=[Marker()] * 5)), MarkerArray) == 5


def random_commands(count: int) -> list[commands.Command]:
    """Return commands of all kinds, with numbers of any size."""
    noise = random.Random(3)

    def number():
        return noise.choice([0.0, -0.0, 5e-324, 1.0, -1e5, noise.gauss(0.0, 1.0)])

    def pose():
        q = [noise.gauss(0.0, 1.0) for _ in range(4)]
        length = sum(c * c for c in q)**0.5
        return Pose((number(), number(), number()), tuple(c / length for c in q))

    def move(kind):
        speed = commands.Twist((number(), number(), number()), (number(), number(), number()))
        return kind(noise.choice(['left', 'right']), pose(), noise.choice([None, speed]),
                    noise.choice([0, 1, 1_700_000_000_999_999_999]))

    def place():
        shape, count = noise.choice([('box', 3), ('sphere', 1), ('cylinder', 2),
                                      ('mesh', 36)])
        size = tuple(noise.random() + 1e-9 for _ in range(count))
        return PlaceCollider('ball', shape, size, pose(), noise.choice([0, 1, 10**10 + 1]))
    kinds = [lambda: Grasp('a', pose(), noise.random() + 1e-9, noise.choice([0, 1, 10**10 + 1])),
             lambda: Release('a'), ReleaseAll, Reset,
             lambda: move(MovePin), lambda: move(MoveCollider),
             lambda: RemoveCollider('ball'), RemoveAllColliders, place,
             lambda: SetKey('solver.substeps', noise.randint(1, 99)),
             lambda: SetKey('gravity', [number(), number(), number()]),
             lambda: SetKey('cloths.towel.friction', noise.random()),
             lambda: SetWind((number(), number(), number())),
             lambda: Click((number(), number(), number())), SaveState, LoadState,
             lambda: SetState('towel', tuple(number() for _ in range(6)))]
    return [noise.choice(kinds)() for _ in range(count)]


def test_commands_come_out_of_the_log_as_they_went_in():
    """Bit for bit and in order: all that a repeated run depends on."""
    before = [command for some in random_commands(2000) for command in (some, some)]
    before += [MovePin(name, HERE) for name in ('left', 'right', 'left', 'up', 'right')]
    after = []
    for topic, message in as_messages(before, 'world', 1_700_000_000_123_456_789):
        kind, read = input_of(topic)[:2]
        after += read(unpacked(serialize_message(message), kind), 'world')
    assert list(map(repr, after)) == list(map(repr, before))    # repr tells -0.0 from 0.0


@pytest.mark.parametrize('count', [2**64 - 1, 2**40, 4097])
def test_a_log_with_an_impossible_count_of_resets_is_refused(count):
    kind, read = INPUTS['resets'][:2]
    with pytest.raises(InputError, match=f'{count} resets in one frame'):
        read(unpacked(serialize_message(kind(data=count)), kind), 'world')
    assert read(kind(data=4096), 'world') == [Reset()] * 4096


# the command queue


@pytest.fixture
def said():
    """Return what was warned about."""
    return []


@pytest.fixture
def box(said):
    """Return an empty command queue."""
    return CommandQueue(said.append, max_message_bytes=1000, max_names=4)


def take(box, message, topic='/t'):
    """Give a command queue a message of ~/pin_targets."""
    box.take(topic, serialize_message(message), MultiDOFJointState,
             lambda m: read_targets(m, 'world', MovePin))


def test_only_the_last_target_of_a_name_waits(box):
    for k in range(3):
        take(box, targets(left=(k, 0, 0), right=(-k, 0, 0)))
    (last,) = box.drain()
    assert [(c.pin, c.pose.position[0]) for c in last] == [('left', 2.0), ('right', -2.0)]
    assert box.drain() == []


def test_the_last_target_of_each_name_waits_whoever_says_it(box):
    for k in range(3):
        take(box, targets(left=(k, 0, 0)))
        take(box, targets(right=(-k, 0, 0)))
    take(box, targets(left=(3, 0, 0), up=(0, 0, 0)))
    assert [[c.pin for c in group] for group in box.drain()] == [['right'], ['left', 'up']]


def test_a_newer_target_does_not_alter_an_older_message(box):
    """``missing`` is refused with its message, and the newer target stands on its own."""
    take(box, targets(left=(1, 0, 0), missing=(0, 0, 0)))
    take(box, targets(left=(2, 0, 0)))
    assert [[c.pin for c in group] for group in box.drain()] == [['left', 'missing'], ['left']]


def test_of_a_stream_with_stamps_the_latest_are_kept(box):
    for k in range(3 * command_queue.MAX_STAMPED):
        take(box, targets(stamp=1 + k, left=(k, 0, 0)))
        take(box, targets(stamp=1 + k, right=(k, 0, 0)))
    places = [group[0].pose.position[0] for group in box.drain() if group[0].pin == 'left']
    assert places == list(range(2 * command_queue.MAX_STAMPED, 3 * command_queue.MAX_STAMPED))


def test_a_target_keeps_its_order_to_grasps_and_releases(box):
    first, second = (MovePin('a', HERE),), (MovePin('a', Pose()),)
    for between in (Grasp('a', HERE, 1.0), Release('a'), ReleaseAll(), Reset()):
        other = (MovePin('b', HERE),)
        for group in (first, other, (between,), second):
            box.put('/t', group)
        assert box.drain() == [first, other, (between,), second]


def test_a_command_keeps_the_topic_that_it_came_by_until_the_next_frame(box):
    one, other = MoveCollider('c', HERE), MovePin('a', HERE)
    box.put('/cloth/collider/c/pose', (one, other))
    assert box.topic_of(one) is None
    box.drain()
    assert (box.topic_of(one), box.topic_of(other)) == ('/cloth/collider/c/pose', None)
    box.drain()
    assert box.topic_of(one) is None


def test_the_arrival_is_that_of_the_last_accepted_message(box):
    box.put('/t')
    first = box.arrived['/t']
    until(lambda: time.monotonic() > first)
    box.refuse('/t', 'no')
    assert box.arrived['/t'] == first
    box.put('/t')
    assert box.arrived['/t'] > first
    box.close()


def test_only_the_last_wind_waits_unless_a_reset_comes_between(box):
    first, second = (SetWind((1.0, 0.0, 0.0)),), (SetWind((2.0, 0.0, 0.0)),)
    other = (MovePin('a', HERE),)
    box.put('/t', first, other, second)
    assert box.drain() == [other, second]
    box.put('/t', first, (Reset(),), second)
    assert box.drain() == [first, (Reset(),), second]


@pytest.mark.parametrize(('message', 'reason'), [
    (Vector3Stamped(vector=Vector3(y=nan)), 'vector is not finite'),
    (Vector3Stamped(vector=Vector3(z=-inf)), 'vector is not finite'),
    (Vector3Stamped(vector=Vector3(x=2e6)), 'is faster than 1e+06 m/s'),
    (Vector3Stamped(header=Header(frame_id='map')), "header: TF frame 'map' is not the scene's"),
])
def test_a_wind_that_makes_no_sense(message, reason):
    with pytest.raises(InputError) as error:
        read_wind(message, 'world')
    assert reason in str(error.value)


def test_a_collider_and_a_pin_of_the_same_name_are_two(box):
    both = [(MovePin('a', HERE),), (MoveCollider('a', HERE),)]
    box.put('/t', *both)
    assert box.drain() == both


def test_refuses_what_is_too_long_or_too_much(box, said):
    take(box, targets(**{f'n{k}': (0, 0, 0) for k in range(5)}), '/a')
    take(box, targets(left=(0, 0, 0), frame_id='w' * 2000), '/b')
    assert said == ['/a: refused: 5 entries, and there is room for 4',
                    '/b: refused: 2108 bytes are more than max_message_bytes (1000)']
    assert box.drain() == []
    assert box.refused == {'/a': 1, '/b': 1}


def test_refuses_what_no_frame_takes_away(box, said, monkeypatch):
    monkeypatch.setattr(command_queue, 'MAX_WAITING', 6)
    for k in range(4):
        take(box, targets(**{f'a{k}': (0, 0, 0), f'b{k}': (0, 0, 0)}))
    assert said == ['/t: refused: more than 6 commands wait for the next frame']
    assert sum(map(len, box.drain())) == 6
    take(box, targets(left=(0, 0, 0)))
    assert len(box.drain()) == 1


def test_what_is_refused_within_a_second_is_said_at_its_end(box, said, monkeypatch):
    monkeypatch.setattr(command_queue, 'WARN_PERIOD', 0.2)
    for _ in range(38):
        box.refuse('/a', 'no')
    box.refuse('/b', 'neither')
    assert said == ['/a: refused: no', '/b: refused: neither']
    until(lambda: len(said) > 2)
    assert said[2:] == ['/a: refused: … and 37 more, the last one: no']
    box.refuse('/a', 'not yet')
    assert len(said) == 3, 'one line in that time'
    until(lambda: len(said) > 3)
    assert said[3:] == ['/a: refused: … and 1 more, the last one: not yet']
    time.sleep(0.35)
    box.refuse('/a', 'again')
    assert said[4:] == ['/a: refused: again']
    assert box.refused == {'/a': 40, '/b': 1}


def test_what_was_refused_in_silence_is_said_when_it_closes(box, said):
    for _ in range(3):
        box.refuse('/a', 'no')
    box.close()
    assert said == ['/a: refused: no', '/a: refused: … and 2 more, the last one: no']
