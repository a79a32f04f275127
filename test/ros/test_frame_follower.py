"""Which commands followers of TF frames give, and how those act; the transforms are given."""

from importlib.util import find_spec
from pathlib import Path
import re
from types import SimpleNamespace

from geometry_msgs.msg import Point, PointStamped, PoseStamped, Twist, Vector3, Vector3Stamped
import numpy as np
import pytest
from rclpy.clock import Clock
from visualization_msgs.msg import Marker, MarkerArray
import yaml

from support.node import pin, pose_stamped, targets, TOWEL
from xpbd_ros.errors import InputError
from xpbd_ros.ros.clouds import cloud_of, points_of
from xpbd_ros.ros.following import Following
from xpbd_ros.ros.frame_follower import FrameFollower
from xpbd_ros.ros.frame_inputs import FrameInputs, NotYet, to_scene_frame
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.frames import followers, notes_without_tf
from xpbd_ros.scene.load import scene_from_text
from xpbd_ros.sim.commands import (
    Grasp,
    MoveCollider,
    MovePin,
    Pose,
    Release,
    RemoveCollider,
    Reset,
    Twist as Velocity,
)
from xpbd_ros.sim.geometry.pose import compose

HALF = 0.5**0.5
FLIPPED = (1.0, 0.0, 0.0, 0.0)
"""half a turn about x, as a gripper that points down"""
SCENE = TOWEL.replace('position: [0.0, 1.0, 0.15]', 'frame: tool, position: [0.0, 0.0, 0.1]') + """
pins:
  hand: {cloth: towel, at: corner_00, frame: hand, frame_timeout: 0.5, radius: 0.05}
"""
CORNER = (-0.2, -0.2, 0.004)


class Given:
    """Transforms by frame: (stamp [ns], pose)."""

    def __init__(self, source='TF', **poses):
        self.name, self.poses = source, poses

    def latest_ns(self, frame: str, source: str) -> int:
        """Return the stamp of a pose."""
        if source not in self.poses:
            raise InputError(f'"{source}" does not exist')
        return self.poses[source][0]

    def pose(self, frame: str, source: str, stamp_ns: int) -> Pose:
        """Return a pose."""
        assert stamp_ns == self.latest_ns(frame, source)
        return self.poses[source][1]


class Follow:
    """A scene, its followers, and a clock that tests set."""

    def __init__(self, **poses):
        self.scene = scene_from_text(SCENE, where='scene.yaml', name='scene')
        self.simulation = compile_scene(self.scene)
        self.given, self.now_ns, self.said, self.told = Given(**poses), 0, [], []
        self.follower = FrameFollower(
            self.simulation, 'world', [(each, self.given) for each in followers(self.scene)],
            now_ns=lambda: self.now_ns, warn=self.said.append, tell=self.told.append)

    def step(self, *commands):
        """Advance by a frame of 1/60 s; return it."""
        found = self.follower.commands(reset=any(isinstance(c, Reset) for c in commands))
        frame = self.simulation.step([*commands, *found])
        assert not frame.refused
        self.now_ns = self.simulation.time_ns(frame.index)
        return frame

    def tell(self, stamp_ns: int | None = None, **places) -> None:
        """Give new transforms, stamped now or as given."""
        for name, place in places.items():
            self.given.poses[name] = (self.now_ns + 10**9 if stamp_ns is None else stamp_ns,
                                      place if isinstance(place, Pose) else Pose(place))


def kinds(frame) -> list[type]:
    """Return the types of the commands that acted on a frame."""
    return [type(command) for command in frame.applied]


def test_a_collider_is_there_once_its_frame_is_known():
    follow = Follow()
    first = follow.step()
    assert kinds(first) == [RemoveCollider]
    assert set(first.colliders) == {'table'}
    assert kinds(follow.step()) == []
    follow.tell(tool=Pose((0.3, 0.0, 2.0), (0.0, HALF, 0.0, HALF)))
    frame = follow.step()
    assert kinds(frame) == [MoveCollider]
    assert frame.colliders['ball'].pose.position == pytest.approx((0.4, 0.0, 2.0))
    assert not frame.colliders['ball'].linear.any(), 'it did not travel there'
    assert frame.colliders['ball'].entry.friction == 0.3
    assert kinds(follow.step()) == [], 'nothing new'


def test_a_removed_collider_stays_removed():
    follow = Follow(tool=(10**9, Pose()))
    follow.step()
    follow.step(RemoveCollider('ball'))
    follow.tell(tool=(0.0, 0.0, 1.0))
    assert 'ball' not in follow.step().colliders


def test_a_pin_takes_the_axes_of_its_frame_and_turns_with_it():
    """The first transform turns nothing; from then on, what it holds turns with it."""
    follow = Follow(tool=(0, Pose()))
    before = follow.step().x[0]
    follow.tell(hand=Pose((-0.2, -0.2, 0.1), FLIPPED))
    for _ in range(5):
        frame = follow.step()
    assert frame.pins['hand'].pose == Pose((-0.2, -0.2, 0.1), FLIPPED)
    assert frame.x[0] == pytest.approx(before + (0.0, 0.0, 0.096))
    (index,) = frame.pins['hand'].particles
    offset = follow.simulation.effects['pin'].held['hand'].offsets
    assert (index, np.abs(offset).max()) == (0, 0.0)


def test_an_offset_particle_stays_where_it_is_as_the_axes_are_taken():
    text = SCENE.replace('at: corner_00', 'near: [-0.2, -0.2, 0.0]')
    scene = scene_from_text(text, where='scene.yaml', name='scene')
    simulation = compile_scene(scene)
    before = simulation.frame().x[0]
    simulation.step([MovePin('hand', Pose((-0.2, -0.2, 0.0), FLIPPED), None, 1)])
    frame = simulation.step()
    assert frame.x[0] == pytest.approx(before, abs=1e-12)
    for _ in range(30):
        frame = simulation.step([MovePin('hand', Pose((-0.2, -0.2, 0.0)))])
    assert frame.x[0] == pytest.approx(np.array([-0.2, -0.2, -0.004]), abs=1e-12)


def test_silence_releases_a_pin_and_holds_a_collider_until_the_frame_is_back():
    follow = Follow(tool=(10**9, Pose((0.0, 1.0, 0.5))), hand=(10**9, Pose(CORNER)))
    assert kinds(follow.step()) == [MovePin, MoveCollider]
    for _ in range(30):    # 0.5 s
        assert kinds(follow.step()) == []
    assert follow.said == [], 'held'
    applied = [kinds(follow.step()) for _ in range(5)]
    assert sum(applied, []) == [Release]
    assert follow.said == ['TF: hand silent for more than 0.5 s: pin hand released']
    for _ in range(30):
        frame = follow.step()
    assert follow.said[1] == 'TF: tool silent for more than 1 s: collider ball held'
    assert 'ball' in frame.colliders
    assert follow.follower.finding == ('TF: hand, tool silent: pin hand released, collider ball '
                                       'held')
    assert follow.follower.diagnostics()['frame_age_s tool'] == pytest.approx(1.1)
    follow.tell(hand=tuple(frame.x[0].tolist()), tool=(0.0, 1.0, 0.6))
    frame = follow.step()
    assert kinds(frame) == [Grasp, MoveCollider]
    assert len(follow.said) == 2, 'the return is no warning'
    assert follow.told == ['TF: hand, tool back']
    assert 'hand' in frame.pins
    assert follow.follower.finding == ''


def test_a_released_pin_still_follows_and_grasps_where_its_frame_is():
    follow = Follow(tool=(0, Pose((0.0, 0.0, 1.0))), hand=(10**9, Pose(CORNER)))
    follow.step()
    follow.step(Release('hand'))
    there = 0.2, -0.2, 0.004    # another corner
    follow.tell(hand=there)
    assert kinds(follow.step()) == [MovePin]
    for _ in range(10):
        frame = follow.step()
    assert frame.pins == {}
    pin = follow.simulation.effects['pin']
    assert pin.pose('hand').position == pytest.approx(there)
    frame = follow.step(Grasp('hand', pin.pose('hand'), 0.02))
    assert frame.pins['hand'].particles.tolist() == [8]


def test_a_grasp_between_frames_follows_in_the_next_one(monkeypatch):
    """A service grasps somewhere else; its TF frame, whose pose is not new, draws the pin."""
    given = Given(tool=(0, Pose((0.0, 0.0, 1.0))), hand=(0, Pose(CORNER)))
    monkeypatch.setattr(FrameInputs, 'transforms', lambda self: given)
    scene = scene_from_text(SCENE, where='scene.yaml', name='scene')
    simulation = compile_scene(scene)
    silent = SimpleNamespace(info=None, warning=None)
    node = SimpleNamespace(command_queue=SimpleNamespace(refuse=None), pace=lambda: (lambda: 0,),
                           get_logger=lambda: silent, get_clock=Clock)
    following = Following(node, scene, simulation, None)

    def step(*groups) -> list[type]:
        frame = simulation.step([*groups, *following.commands(groups)])
        assert not frame.refused
        return kinds(frame)
    assert step() == [MovePin, MoveCollider]
    assert step((Release('hand'),)) == [Release]
    grasp = Grasp('hand', Pose((-0.15, -0.2, 0.004)), 0.06)
    assert not simulation.apply([grasp])
    assert step() == [Grasp, MovePin]
    assert step() == []
    assert simulation.effects['pin'].pose('hand').position == pytest.approx(CORNER)
    assert step((Release('hand'),), (grasp,)) == [Release, Grasp, MovePin], 'by a topic'
    assert not simulation.apply([Reset()])
    assert step() == [Reset, MovePin, MoveCollider]


def test_silence_tells_the_reason_of_tf():
    """A loop, or a parent that is another one now: there are transforms, and none is found."""
    follow = Follow(hand=(1, Pose(CORNER)), tool=(0, Pose()))
    follow.step()
    del follow.given.poses['hand']
    while not follow.said:
        follow.step()
    assert follow.said == ['TF: hand silent for more than 0.5 s: pin hand released; '
                           '"hand" does not exist']


def test_reports_name_the_source_and_what_a_pin_does():
    """Joint states and topics are no TF, and a pin that holds nothing is neither held nor free."""
    follow = Follow(tool=(10**9, Pose((0.0, 1.0, 0.5))))
    follow.given.name = '/joint_states'
    follow.step(Release('hand'))
    for _ in range(70):
        follow.step()
    assert follow.said == [
        '/joint_states: no pose of hand in 0.5 s: pin hand holds nothing; "hand" does not exist',
        '/joint_states: tool silent for more than 1 s: collider ball held']
    assert follow.follower.finding == ('/joint_states: hand, tool silent: pin hand holds nothing, '
                                       'collider ball held')
    text = TOWEL + """
pins:
  hand: {cloth: towel, at: corner_00}
inputs:
  /tool_pose: {pin: hand}
  /trackers: {collider: ball, joint: ball}
"""
    scene = scene_from_text(text, where='scene.yaml', name='scene')
    now_ns, said = [0], []
    pin_of, ball_of = followers(scene)
    follower = FrameFollower(compile_scene(scene), 'world', [
        (pin_of, Given('/tool_pose')), (ball_of, Given('/trackers'))],
        now_ns=lambda: now_ns[0], warn=said.append, tell=said.append)
    follower.commands()
    now_ns[0] = 2 * 10**9
    follower.commands()
    assert [line.split('; ')[0] for line in said] == [
        '/tool_pose: no pose in 1 s: pin hand held',
        '/trackers: no pose of ball in 1 s: collider ball absent']
    assert follower.finding == ('/tool_pose: silent: pin hand held; /trackers: ball silent: '
                                'collider ball absent')


def test_a_static_frame_is_never_silent():
    follow = Follow(tool=(0, Pose((0.0, 0.0, 1.0))), hand=(0, Pose(CORNER)))
    assert kinds(follow.step()) == [MovePin, MoveCollider]
    for _ in range(90):
        assert kinds(follow.step()) == []
    assert follow.said == []
    follow.tell(0, tool=(0.0, 0.0, 1.1))
    assert kinds(follow.step()) == [MoveCollider], 'it was published again'


def test_a_reset_puts_followers_back_to_their_frames():
    follow = Follow(tool=(10**9, Pose((0.0, 0.5, 1.0))))
    follow.step()
    follow.tell(tool=(0.0, 0.6, 1.0))
    follow.step()
    frame = follow.step(Reset())
    assert kinds(frame) == [Reset, MoveCollider]
    assert frame.colliders['ball'].pose.position == pytest.approx((0.0, 0.6, 1.1))
    assert not frame.colliders['ball'].linear.any()


def test_a_reset_in_a_silence_holds_nothing():
    follow = Follow(tool=(0, Pose()), hand=(10**9, Pose(CORNER)))
    for _ in range(40):
        frame = follow.step()
    assert not frame.pins
    frame = follow.step(Reset())
    assert kinds(frame) == [Reset, Release, MoveCollider]
    assert not frame.pins
    follow.tell(hand=CORNER)
    assert kinds(follow.step()) == [Grasp]


def test_a_reset_removes_what_has_no_frame_yet():
    follow = Follow()
    follow.step()
    frame = follow.step(Reset())
    assert kinds(frame) == [Reset, RemoveCollider]
    assert 'ball' not in frame.colliders


def test_a_run_without_tf_says_what_stands_still():
    follow = Follow()
    assert notes_without_tf(follow.scene) == [
        'pins: no TF and no topics here, so hand (hand) stay where they hold, unless commands of '
        'a log move them',
        'colliders: no TF and no topics here, so ball (tool) stay where they start, unless '
        'commands of a log move them']
    assert follow.simulation.frame().colliders['ball'].pose == Pose((0.0, 0.0, 0.1))


@pytest.mark.parametrize(('old', 'new', 'reason'), [
    ('frame: hand', 'frame: /hand',
     "pins.hand: frame: TF frames have no leading '/'; take 'hand'"),
    ('frame: hand', 'target: [0, 0, 1], frame: hand', "needs either 'target' or 'frame'"),
    ('frame: hand', 'motion: [[0, 0, 0, 1]], frame: hand', "needs either 'motion' or 'frame'"),
    ('frame: hand, ', '', "pins.hand: frame_timeout: needs 'frame', the TF frame to follow"),
    ('frame: hand, frame_timeout: 0.5', 'position: [0, 0, 1]',
     "pins.hand: position and orientation: need 'frame'"),
    ('frame_timeout: 0.5', 'frame_timeout: 0', 'frame_timeout: must be > 0 s (got 0)'),
    ('frame: tool', 'frme: tool', "colliders.ball.frme: unknown key; did you mean 'frame'?"),
    ('frame: tool', 'frame: tool, motion: [[0, 0, 0, 1]]',
     "colliders.ball: needs either 'motion' or 'frame', not both"),
])
def test_what_a_scene_cannot_say_about_frames(old, new, reason):
    assert old in SCENE
    with pytest.raises(InputError) as error:
        scene_from_text(SCENE.replace(old, new), where='scene.yaml', name='scene')
    assert reason in str(error.value)


def test_the_example_of_the_page_of_scenes():
    page = (Path(__file__).parents[2] / 'doc' / 'scenes.md').read_text()
    (block,) = re.findall(r'\n    pins:\n      hand:.*?\n\n', page, re.DOTALL)
    towel = yaml.safe_load(TOWEL)
    found = scene_from_text(yaml.safe_dump({**towel, **yaml.safe_load(block)}),
                            where='scenes.md', name='scenes')
    assert [(each.name, each.frame, each.timeout) for each in followers(found)] == [
        ('hand', 'tool0', 0.5), ('tip', 'gripper_left_tip', 1.0)]
    compile_scene(found)


@pytest.mark.skipif(find_spec('tf2_ros') is not None, reason='tf2_ros is installed')
def test_without_tf2_the_package_to_install_is_named(start, tmp_path):
    apt = 'needs tf2_ros (sudo apt install ros-jazzy-tf2-ros-py)'
    inputs = FrameInputs(None, 'world', lambda *_: None, lambda *_: None)
    with pytest.raises(InputError) as error:
        inputs._lookup('map', 0, 'header', final=False)
    assert f"header: TF frame 'map' is not the scene's 'world'; transforming it {apt}" in str(
        error.value)
    (tmp_path / 'scene.yaml').write_text(SCENE)
    node = start(scene=tmp_path / 'scene.yaml')
    said = node.wait_for(apt)
    assert f'{tmp_path / "scene.yaml"}: pins.hand.frame: {apt}' in said
    assert node.process.wait(60) == 2


def test_a_clock_that_goes_back_causes_no_silence():
    follow = Follow(tool=(10**9, Pose((0.0, 1.0, 0.5))), hand=(10**9, Pose(CORNER)))
    follow.now_ns = 10**12
    follow.step()
    follow.now_ns = 0
    follow.step()
    follow.now_ns = 4 * 10**8
    follow.step()
    assert follow.said == []
    follow.now_ns = 6 * 10**8
    follow.step()
    assert follow.said == ['TF: hand silent for more than 0.5 s: pin hand released']


TURNED = Pose((1.0, 2.0, 3.0), (0.0, 0.0, HALF, HALF))
"""x becomes y"""


def test_poses_compose():
    found = compose(TURNED, Pose((1.0, 0.0, 0.0), (0.0, 0.0, HALF, HALF)))
    assert found.position == pytest.approx((1.0, 3.0, 3.0))
    assert found.orientation == pytest.approx((0.0, 0.0, 1.0, 0.0))


def test_messages_in_another_frame_are_transformed():
    asked = []

    def lookup(frame, stamp_ns, what):
        asked.append((frame, stamp_ns, what))
        return TURNED

    def still(frame, stamp_ns, what):
        return Velocity()
    message = targets(frame_id='tool', stamp=7, a=(1.0, 0.0, 0.0))
    message.twist = [Twist(linear=Vector3(x=2.0))]
    to_scene_frame(message, 'world', lookup, still)
    t = message.transforms[0].translation
    assert (t.x, t.y, t.z) == pytest.approx((1.0, 3.0, 3.0))
    assert message.twist[0].linear.y == pytest.approx(2.0)
    assert message.header.frame_id == 'world'
    assert asked == [('tool', 7, 'header')]

    pose: PoseStamped = pose_stamped((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0), 'tool')
    to_scene_frame(pose, 'world', lookup, still)
    assert pose.pose.position.y == pytest.approx(3.0)
    assert pose.pose.orientation.w == pytest.approx(2.0 * HALF), 'refused later, as it came'

    wind = Vector3Stamped(vector=Vector3(x=1.0))
    wind.header.frame_id = 'tool'
    to_scene_frame(wind, 'world', lookup, still)
    assert (wind.vector.x, wind.vector.y) == pytest.approx((0.0, 1.0))

    click = PointStamped(point=Point(x=1.0))
    click.header.frame_id = 'tool'
    to_scene_frame(click, 'world', lookup, still)
    assert click.point.y == pytest.approx(3.0)

    cloud = cloud_of([1.0, 0.0, 0.0, np.nan, np.nan, np.nan, 0.0, 1.0, 0.5], 'tool', 7)
    cloud.width, cloud.height, cloud.row_step = 1, 3, 24
    to_scene_frame(cloud, 'world', lookup, still)
    assert points_of(cloud)[:, 0] == pytest.approx(np.array(
        [[1.0, 3.0, 3.0], [np.nan] * 3, [0.0, 2.0, 3.5]]), nan_ok=True)
    assert (cloud.header.frame_id, cloud.header.stamp.nanosec) == ('world', 7)

    asked.clear()
    marks = MarkerArray(markers=[pin('here', (1.0, 0.0, 0.0)),
                                 pin('there', (1.0, 0.0, 0.0), frame_id='tool'),
                                 pin('gone', frame_id='tool', action=Marker.DELETE)])
    to_scene_frame(marks, 'world', lookup, still)
    assert [m.pose.position.y for m in marks.markers] == pytest.approx([0.0, 3.0, 0.0])
    assert [m.header.frame_id for m in marks.markers] == ['world'] * 3
    assert asked == [('tool', 0, 'marker there/0')]


class Turntable(Given):
    """A frame ``tool`` that turns about z at 2 rad/s and travels along x at 0.5 m/s."""

    def __init__(self, latest_ns: int = 10**9):
        self.now_ns, self.first_ns = latest_ns, 0
        self.is_static = False

    def latest_ns(self, frame: str, source: str) -> int:
        """Return the stamp of the latest pose."""
        return 0 if self.is_static else self.now_ns

    def pose(self, frame: str, source: str, stamp_ns: int) -> Pose:
        """Return the pose at a time; refuse times without one."""
        t = 1e-9 * (stamp_ns or self.now_ns)
        if not self.first_ns <= (stamp_ns or self.now_ns) <= self.now_ns:
            raise InputError('extrapolation')
        return Pose((0.5 * t, 0.0, 1.0), (0.0, 0.0, float(np.sin(t)), float(np.cos(t))))


@pytest.mark.parametrize('stamp_ns', [9 * 10**8, 0])
def test_a_twist_in_a_frame_that_moves_gets_its_velocity_too(stamp_ns):
    """As the derivative of the transformed position and orientation says."""
    taken, refused = [], []

    def take(topic, raw, kind, read):
        try:
            read(raw())
        except InputError as error:
            refused.append(str(error))
    inputs = FrameInputs(Clockwork(), 'world', take, lambda topic, reason: None)
    inputs._transforms = table = Turntable()

    def say(twist: Twist, stamp_ns: int) -> None:
        inputs.take('a', lambda: targets(frame_id='tool', stamp=stamp_ns, twist=twist,
                                         a=(0.3, 0.1, 0.0)), None, taken.append)
    say(Twist(linear=Vector3(y=0.2), angular=Vector3(x=1.0)), stamp_ns)
    t = 1e-9 * (stamp_ns or table.now_ns)
    c, s = np.cos(2.0 * t), np.sin(2.0 * t)
    x, y = c * 0.3 - s * 0.1, s * 0.3 + c * 0.1
    found = taken[0].twist[0]
    assert (found.linear.x, found.linear.y, found.linear.z) == pytest.approx(
        (0.5 - 2.0 * y - s * 0.2, 2.0 * x + c * 0.2, 0.0), abs=1e-9)
    assert (found.angular.x, found.angular.y, found.angular.z) == pytest.approx(
        (c, s, 2.0), abs=1e-9)
    table.first_ns = 895 * 10**6
    table.now_ns = 9 * 10**8
    say(Twist(), 9 * 10**8)
    assert refused == ["header: twist: TF frame 'tool' is not the scene's 'world'; extrapolation"]
    table.is_static = True
    say(Twist(linear=Vector3(x=2.0)), 9 * 10**8)
    found = taken[1].twist[0].linear
    assert (found.x, found.y) == pytest.approx((2.0 * np.cos(1.8), 2.0 * np.sin(1.8)))


class Clockwork:
    """A node that only makes a timer, which the test rings."""

    def create_timer(self, period, again, clock):
        """Keep the callback."""
        self.again, self.running = again, False
        return self

    def reset(self):
        """Run."""
        self.running = True

    def cancel(self):
        """Stop."""
        self.running = False


def test_messages_wait_for_their_transform_in_order():
    class Late(Given):
        def pose(self, frame, source, stamp_ns):
            if stamp_ns > self.latest_ns(frame, source):
                raise InputError('extrapolation')
            return self.poses[source][1]
    node, taken, refused = Clockwork(), [], []

    def take(topic, raw, kind, read):
        try:
            taken.append((topic, read(raw())))
        except InputError as error:
            refused.append(str(error))
    inputs = FrameInputs(node, 'world', take, lambda topic, reason: refused.append(reason))
    inputs._transforms = late = Late(tool=(5, TURNED))

    def say(topic, stamp, frame='tool'):
        inputs.take(topic, lambda: targets(frame_id=frame, stamp=stamp, a=(0.0, 0.0, 0.0)), None,
                    lambda message: message.header.stamp.nanosec)
    say('a', 4)
    assert taken == [('a', 4)]
    say('a', 6)
    say('a', 3)
    say('a', 9, 'world')
    say('b', 5)
    assert taken == [('a', 4), ('b', 5)]
    assert node.running
    node.again()
    assert len(taken) == 2
    late.poses['tool'] = (6, TURNED)
    node.again()
    assert taken[2:] == [('a', 6), ('a', 3), ('a', 9)]
    assert not node.running
    assert not refused
    say('b', 8)
    inputs._waiting['b'][0] = inputs._waiting['b'][0]._replace(until=0.0)
    node.again()
    assert refused == ["header: TF frame 'tool' is not the scene's 'world'; extrapolation"]
    with pytest.raises(NotYet):
        inputs._lookup('tool', 9, 'header', final=False)
