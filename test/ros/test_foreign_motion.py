"""Motion from logs of other programs: the same in each storage, true to the path, and refusals."""

import importlib
from importlib.util import find_spec
import json
from math import cos, sin
from pathlib import Path
import shutil
import sys

from mcap.writer import Writer
import numpy as np
import pytest

from support.foreign import (
    in_base,
    joint_states,
    LATENCY,
    plan,
    pose_written,
    robot_log,
    START,
    tool,
    transform_stamped,
    write_bag,
    written,
)
from support.node import TOWEL
from support.strict_reader import read_strictly
from support.tiers import quick_only
from xpbd_ros.cli.main import main
from xpbd_ros.errors import InputError
from xpbd_ros.log.foreign import ForeignLog
from xpbd_ros.ros.foreign_motion import ForeignMotion
from xpbd_ros.ros.logged_tf import LoggedTransforms
from xpbd_ros.ros.pose_messages import read_transforms, Transform
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_text
from xpbd_ros.share import share_folder
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.pose import compose

HAND = """
pins:
  hand: {cloth: towel, at: corner_00}
"""
SOURCES = {
    'tf': '  /tf: {pin: hand, frame: tool}\n',
    'pose': '  /tool_pose: {pin: hand}\n',
    'joint': '  /trackers: {pin: hand, joint: hand}\n',
}
"""inputs that are all the same motion"""
BOTH = '  /trackers: [{pin: hand, joint: hand}, {collider: ball, joint: ball}]\n'


def scene_text(inputs: str) -> str:
    """Return the text of a scene with a pin, a ball and inputs."""
    return f'{TOWEL}{HAND}inputs:\n{inputs}'


def motion_of(log: Path, inputs: str, *, frames: int = 90, offset: float = 0.0):
    """Return the simulation of the scene, and the motion of a log for it."""
    scene = scene_from_text(scene_text(inputs), where='scene.yaml', name='scene')
    simulation = compile_scene(scene)
    return simulation, ForeignMotion(ForeignLog(log), scene, simulation, frames=frames,
                                     offset=offset)


def moved(log: Path, inputs: str, *, frames: int = 90, offset: float = 0.0) -> list:
    """Return the frames of a run."""
    simulation, motion = motion_of(log, inputs, frames=frames, offset=offset)
    found = [simulation.step(motion.commands(index)) for index in range(1, frames + 1)]
    assert motion.texts() == []
    assert not any(frame.refused for frame in found)
    return found


@pytest.fixture(scope='module')
def bags(tmp_path_factory) -> dict[str, Path]:
    """Return the same log in each storage."""
    folder = tmp_path_factory.mktemp('bags')
    return {storage: write_bag(folder / storage, robot_log(), storage)
            for storage in ('sqlite3', 'mcap', 'plain')}


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap', 'plain'])
def test_each_storage_gives_the_same_commands(bags, storage):
    commands = {}
    for name in {storage, 'mcap'}:
        _, motion = motion_of(bags[name], SOURCES['pose'] + '  /tf: {collider: ball, frame: tool}')
        commands[name] = [motion.commands(index) for index in range(1, 91)]
    assert commands[storage] == commands['mcap']
    assert sum(map(len, commands['mcap'])) > 100


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap', 'plain'])
def test_a_topic_without_its_slash_is_the_absolute_one(bags, tmp_path, storage):
    """Logs converted from ROS 1 have such names, and TF frames come by ``tf`` there."""
    inputs = SOURCES['pose'] + '  tf: {collider: ball, frame: tool}'
    bare = [each._replace(topic=each.topic.lstrip('/')) for each in robot_log()]
    commands = []
    for log in (bags['mcap'], write_bag(tmp_path / 'bag', bare, storage)):
        _, motion = motion_of(log, inputs)
        commands.append([motion.commands(index) for index in range(1, 91)])
    assert commands[1] == commands[0]
    both = [*bare, *(each._replace(topic='/tool_pose', time=each.time + 0.5) for each in bare
                     if each.topic == 'tool_pose')]
    assert set(ForeignLog(write_bag(tmp_path / 'both', both, storage)).topics) == {
        '/tool_pose', 'tool_pose', '/tf', '/tf_static', '/trackers', '/status'}


@pytest.mark.parametrize('source', SOURCES)
def test_a_pin_is_on_the_path_at_a_constant_delay(bags, source):
    """Whichever the topic, the pin is at most 20 µm from the path, some frames late."""
    frames = moved(bags['mcap'], SOURCES[source])[30:]
    seen = np.array([frame.pins['hand'].pose.position for frame in frames])
    turned = np.array([frame.pins['hand'].pose.orientation for frame in frames])
    ends = np.array([1e-9 * frame.time_ns for frame in frames])

    def apart(delay: float) -> float:
        path = np.array([tool(t - delay).position for t in ends])
        return np.linalg.norm(seen - path, axis=1).max()
    delays = np.arange(0.04, 0.2, 2e-4)
    delay = min(delays, key=apart)
    assert apart(delay) < 3e-5
    assert LATENCY < delay < 0.15
    expected = np.array([tool(t - delay).orientation for t in ends])
    assert np.abs(np.abs(np.sum(turned * expected, axis=1)) - 1.0).max() < 1e-6


def test_a_collider_begins_at_the_topic_and_follows_with_its_offset(bags):
    first = moved(bags['mcap'], BOTH.replace('joint: ball', 'joint: ball, position: [0, 0.5, 0]'),
                  frames=20)
    assert 'ball' not in first[0].colliders, 'its first message has not arrived'
    there = next(frame for frame in first if 'ball' in frame.colliders)
    begin = tool(0.4)
    assert there.colliders['ball'].pose.position == pytest.approx(
        [begin.position[0], begin.position[1] + 0.5, begin.position[2]], abs=2e-3)
    assert not there.colliders['ball'].linear.any(), 'it did not travel there'
    last = first[-1].colliders['ball'].pose
    assert last.position[1] == pytest.approx(begin.position[1] + 0.5)
    assert last.position[2] > begin.position[2] + 0.02


def test_an_offset_begins_later_with_static_transforms_of_before(bags):
    late = moved(bags['sqlite3'], SOURCES['pose'], frames=30, offset=1.0)
    found = np.array(late[-1].pins['hand'].pose.position)
    times = 1.0 + 0.5 - np.arange(0.04, 0.2, 1e-4)
    assert min(np.linalg.norm(found - tool(t).position) for t in times) < 3e-5


def test_a_run_is_recorded_so_that_it_repeats_without_the_log(bags, tmp_path, capsys):
    scene, run = tmp_path / 'scene.yaml', tmp_path / 'run'
    scene.write_text(scene_text(BOTH))
    assert main(['run', str(scene), '--commands', str(bags['sqlite3']), '-o', str(run), '--json',
                 '-']) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers['frames'] == 121, 'as long as the log: 0.03 s after the last stamp'
    assert (numbers['refused'], numbers['notes']) == (0, [])
    counts = read_strictly(run)
    assert counts['/cloth/pin_targets'] > 90
    assert counts['/cloth/collider_states'] > 90
    assert main(['resim', str(run), '--json', '-']) == 0
    assert json.loads(capsys.readouterr().out)['identical']
    assert main(['run', str(scene), '--commands', str(run), '-o', str(tmp_path / 'again'),
                 '--json', '-']) == 0
    assert json.loads(capsys.readouterr().out)['commands']['identical']


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_log_cut_short_by_a_crash_is_used_as_far_as_it_goes(bags, tmp_path, storage, capsys):
    """A bag without metadata.yaml, and an MCAP file without its end."""
    scene, bag = tmp_path / 'scene.yaml', tmp_path / 'bag'
    scene.write_text(scene_text(SOURCES['pose']))
    shutil.copytree(bags[storage], bag)
    (bag / 'metadata.yaml').unlink()
    if storage == 'mcap':
        file, = bag.glob('*.mcap')
        data = file.read_bytes()
        file.write_bytes(data[:-40])
    assert main(['run', str(scene), '--commands', str(bag), '-o', str(tmp_path / 'run'),
                 '--duration', '0.5']) == 0
    assert ('damaged log: ' in capsys.readouterr().err) == (storage == 'mcap')
    assert read_strictly(tmp_path / 'run')['/cloth/pin_targets'] > 5


def test_sqlite_without_rosbags_names_the_extra(bags, tmp_path, monkeypatch, capsys):
    scene = tmp_path / 'scene.yaml'
    scene.write_text(scene_text(SOURCES['pose']))
    monkeypatch.setitem(sys.modules, 'rosbags.rosbag2', None)
    assert main(['run', str(scene), '--commands', str(bags['sqlite3'])]) == 2
    assert "needs rosbags: pip install 'xpbd_ros[bags]'" in capsys.readouterr().err


def test_a_log_of_a_single_time_is_refused_in_one_line(tmp_path, capsys):
    scene = tmp_path / 'scene.yaml'
    scene.write_text(scene_text(SOURCES['pose']))
    log = write_bag(tmp_path / 'bag', [pose_written(0.5, '/tool_pose', 'world', Pose())], 'mcap')
    assert main(['run', str(scene), '--commands', str(log)]) == 2
    assert capsys.readouterr().err == (
        f'xpbd_ros run: {log}: all its messages have one time, so nothing moves; record for '
        'longer\n')


def test_a_file_that_is_no_bag_is_refused_in_one_line(tmp_path, capsys):
    scene, bag = tmp_path / 'scene.yaml', tmp_path / 'bag.db3'
    scene.write_text(scene_text(SOURCES['pose']))
    bag.write_bytes(b'no database')
    assert main(['run', str(scene), '--commands', str(bag)]) == 2
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert err.startswith(f'xpbd_ros run: {bag}: cannot be read: ')


def test_a_plan_is_joined_by_lines_and_held_at_its_end(tmp_path):
    a, b = Pose((-0.2, -0.2, 0.05)), Pose((-0.2, -0.2, 0.45))
    log = write_bag(tmp_path / 'bag', [
        written(0.0, '/status', 'std_msgs/msg/String', data='well'),
        plan(0.1, ['hand'], [(0.2, [a]), (1.2, [b])]),
        written(3.0, '/status', 'std_msgs/msg/String', data='well')], 'mcap')
    frames = moved(log, '  /plan: {pin: hand}\n', frames=170)
    height = np.array([frame.pins['hand'].pose.position[2] for frame in frames])
    speed = 60.0 * np.diff(height)
    assert speed[35:70] == pytest.approx(np.full(35, 0.4), abs=1e-6)
    assert height[-80:] == pytest.approx(np.full(80, 0.45), abs=1e-9), 'held beyond its timeout'


@pytest.mark.skipif(find_spec('yourdfpy') is None,
                    reason="yourdfpy is missing: pip install '.[robot]'")
@pytest.mark.parametrize('by', quick_only(['joint_states', 'tf'], 'joint_states'))
def test_a_recorded_robot_picks_up_a_cloth_that_was_not_there(tmp_path, by):
    from xpbd_ros.scene.urdf import Description
    robots = share_folder() / 'robots'
    spec = importlib.util.spec_from_file_location('motion', robots / 'two_finger_motion.py')
    table = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(table)
    description, messages = Description(robots / 'two_finger.urdf'), []
    for k in range(250):
        at = dict(zip(table.JOINTS, table.positions(k / 100.0)))
        messages.append(joint_states(k / 100.0, **at))
        description.move(at)
        messages.append(written(k / 100.0, '/tf', 'tf2_msgs/msg/TFMessage', transforms=[
            transform_stamped(k / 100.0, 'world', link, description.pose(link))
            for link in description.links[1:]]))
    text = (robots / 'robot.yaml').read_text().replace('follow: joint_states', f'follow: {by}')
    scene = scene_from_text(text, where='robot.yaml', name='robot', folder=robots)
    simulation = compile_scene(scene)
    motion = ForeignMotion(ForeignLog(write_bag(tmp_path / 'bag', messages, 'sqlite3')), scene,
                           simulation, frames=149)
    for index in range(1, 150):
        frame = simulation.step(motion.commands(index))
    assert motion.texts() == []
    assert set(frame.pins) == {'arm_gripper'}
    assert frame.x[10 * 21 + 10][2] > 0.2, 'lifted'
    assert frame.x[10 * 21 + 10][0] > 0.05, 'and on its way'


@pytest.fixture(scope='module')
def odd(tmp_path_factory) -> Path:
    """Return a log with topics that are of no use."""
    return write_bag(tmp_path_factory.mktemp('odd') / 'odd', [
        *robot_log(1.0), pose_written(0.0, '/lost', 'mars', Pose()),
        joint_states(0.1, arm=0.0)], 'plain')


@pytest.mark.parametrize(('inputs', 'said'), [
    ('/tool_pos: {pin: hand}', [
        'inputs./tool_pos: ', 'has no such topic; did you mean /tool_pose? (it has ',
        '/tool_pose (geometry_msgs/msg/PoseStamped)',
        '/trackers (sensor_msgs/msg/MultiDOFJointState)']),
    ('/status: {pin: hand}', [
        'inputs./status: is std_msgs/msg/String, and must be geometry_msgs/msg/PoseStamped or ']),
    ('/joint_states: {pin: hand}', [
        'is sensor_msgs/msg/JointState, and must be ', "follows joint states by its key "
        "'joint_states'"]),
    ('/tf: {pin: hand}', ['is tf2_msgs/msg/TFMessage', "name the TF frame with 'frame'"]),
    ('/tool_pose: {pin: hand, frame: tool}', [
        'is geometry_msgs/msg/PoseStamped, and must be tf2_msgs/msg/TFMessage']),
    ('/tf: {pin: hand, frame: tol}', [
        "pins.hand.frame: 'tol': unknown TF frame; did you mean 'tool'? (known: "]),
    ('/trackers: {pin: hand}', ["several joints; name one with 'joint' (hand, ball)"]),
    ('/trackers: {pin: hand, joint: hnd}', ["unknown joint; did you mean 'hand'?"]),
    ('/lost: {pin: hand}', ["inputs./lost: 'mars': unknown TF frame"]),
])
def test_mistakes_are_one_line(odd, inputs, said, tmp_path, capsys):
    scene = tmp_path / 'scene.yaml'
    scene.write_text(scene_text(f'  {inputs}'))
    assert main(['run', str(scene), '--commands', str(odd), '-o', str(tmp_path / 'run')]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count('\n')) == ('', 1)
    assert err.startswith(f'xpbd_ros run: {scene}: ')
    for text in said:
        assert text in err
    assert not (tmp_path / 'run').exists()


def refusal(log: Path, inputs: str, **options) -> str:
    """Return the reason why a log cannot move a scene."""
    with pytest.raises(InputError) as error:
        motion_of(log, inputs, **options)
    return str(error.value)


def test_a_topic_outside_the_time_of_the_run_is_named_with_its_times(tmp_path):
    log = write_bag(tmp_path / 'bag', [
        written(0.0, '/status', 'std_msgs/msg/String', data='well'),
        *(pose_written(3.0 + 0.1 * k, '/tool_pose', 'world', Pose()) for k in range(11))], 'mcap')
    assert refusal(log, SOURCES['pose'], frames=60) == (
        f'inputs./tool_pose: /tool_pose has messages from 3.030 s to 4.030 s of {log}, and the '
        'run takes 0.000 s to 1.000 s of it; change --start-offset or --duration')
    motion_of(log, SOURCES['pose'], frames=60, offset=3.0)
    early = write_bag(tmp_path / 'early', [
        *(pose_written(0.1 * k, '/tool_pose', 'world', Pose()) for k in range(11)),
        written(3.0, '/status', 'std_msgs/msg/String', data='well')], 'mcap')
    assert 'has messages from 0.000 s to 1.000 s of ' in refusal(early, SOURCES['pose'],
                                                                 frames=60, offset=2.0)


def test_a_log_without_tf_cannot_move_a_tf_frame(tmp_path):
    log = write_bag(tmp_path / 'bag', [
        pose_written(0.1 * k, '/tool_pose', 'base', Pose()) for k in range(9)], 'mcap')
    assert refusal(log, SOURCES['tf']).endswith(
        f'{log} has no such topic (it has no topic of tf2_msgs/msg/TFMessage)')
    assert refusal(log, SOURCES['pose']) == (
        "inputs./tool_pose: no pose on /tool_pose; /tool_pose: 9 messages refused: TF frame "
        f"'base' is not the scene's 'world'; transforming it needs TF, and {log} has no topic of "
        f'tf2_msgs/msg/TFMessage ({log})')


def test_a_scene_that_maps_no_topic_is_told_which_there_are(odd, tmp_path):
    scene = scene_from_text(TOWEL, where='scene.yaml', name='scene')
    with pytest.raises(InputError) as error:
        ForeignMotion(ForeignLog(odd), scene, compile_scene(scene), frames=10)
    assert "maps none of its topics to a pin or collider under 'inputs' (it has " in str(
        error.value)
    assert '/tool_pose (geometry_msgs/msg/PoseStamped)' in str(error.value)


@pytest.mark.parametrize(('encoding', 'schema', 'said'), [
    ('json', ('geometry_msgs/msg/PoseStamped', 'jsonschema'),
     "has it in the encoding 'json', and only cdr can be read"),
    ('cdr', None, 'does not say of which type it is: its messages have no definition there')])
def test_a_topic_in_another_encoding_or_without_a_type_is_refused(tmp_path, encoding, schema,
                                                                  said):
    path = tmp_path / 'other.mcap'
    with open(path, 'wb') as file:
        log = Writer(file)
        log.start('', 'another')
        number = log.register_schema(*schema, b'{}') if schema else 0
        log.add_message(log.register_channel('/tool_pose', encoding, number), START, b'{}', START)
        log.finish()
    assert refusal(path, SOURCES['pose']) == f'inputs./tool_pose: {path} {said}'


def test_messages_that_cannot_be_unpacked_are_counted(tmp_path):
    good = [pose_written(0.02 * k, '/tool_pose', 'world', tool(0.02 * k)) for k in range(50)]
    good[10] = good[10]._replace(data=good[10].data[:20])
    simulation, motion = motion_of(write_bag(tmp_path / 'bag', good, 'mcap'), SOURCES['pose'],
                                   frames=60)
    for index in range(1, 61):
        simulation.step(motion.commands(index))
    assert len(motion.texts()) == 1
    assert motion.texts()[0].startswith('/tool_pose: 1 message refused: cannot be unpacked')


def test_a_silent_topic_releases_its_pin_and_is_told(tmp_path):
    few = [pose_written(0.02 * k, '/tool_pose', 'world', tool(0.02 * k)) for k in range(20)]
    few.append(written(3.0, '/status', 'std_msgs/msg/String', data='well'))
    simulation, motion = motion_of(
        write_bag(tmp_path / 'bag', few, 'mcap'),
        '  /tool_pose: {pin: hand, frame_timeout: 0.5}', frames=120)
    for index in range(1, 121):
        frame = simulation.step(motion.commands(index))
    assert not frame.pins
    assert motion.texts() == [
        '/tool_pose: silent for more than 0.5 s: pin hand released']


def test_a_refused_grasp_is_told_with_its_reason(tmp_path, capsys):
    """The topic is silent, and back where the released cloth is not."""
    far = Pose((5.0, 5.0, 5.0), (0.0, 0.0, 0.0, 1.0))
    few = [pose_written(0.02 * k, '/tool_pose', 'world', tool(0.02 * k)) for k in range(10)]
    few += [pose_written(1.5 + 0.02 * k, '/tool_pose', 'world', far) for k in range(20)]
    scene = tmp_path / 'scene.yaml'
    scene.write_text(scene_text('  /tool_pose: {pin: hand, frame_timeout: 0.5}'))
    assert main(['run', str(scene), '--commands', str(write_bag(tmp_path / 'bag', few, 'mcap')),
                 '-o', str(tmp_path / 'run'), '--json', '-']) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers['refused'] == 1
    assert "Grasp is refused: pin 'hand': no free particle within" in numbers['notes'][-1]


@pytest.mark.parametrize(('inputs', 'said'), [
    ('{/tool pose: {pin: hand}}', 'inputs./tool pose: is not the name of a topic'),
    ('{/a: {pin: hnd}}', "inputs./a.pin: unknown pin; did you mean 'hand'? (known: hand)"),
    ('{/a: {}}', "inputs./a: needs either 'pin' or 'collider', and only one of them"),
    ('{/a: {pin: hand, joint: a, frame: b}}', "needs either 'joint' or 'frame', not both"),
    ('{/a: {pin: hand}, /b: {pin: hand}}',
     "inputs./b: pins.hand has 'frame' already, and follows one thing only"),
    ('{/a: [{pin: hand}, {collder: ball}]}',
     "inputs./a[1].collder: unknown key; did you mean 'collider'?"),
    ('[]', 'inputs: must be a mapping'),
])
def test_wrong_inputs_are_refused_when_the_scene_is_read(inputs, said):
    with pytest.raises(InputError, match='^scene.yaml: ') as error:
        scene_from_text(f'{TOWEL}{HAND}inputs: {inputs}', where='scene.yaml', name='scene')
    assert said in str(error.value)


def test_transforms_between_those_of_a_log_are_interpolated():
    """A base that moves along x, at 10 Hz, carries an arm that turns about z, at 50 Hz."""
    tf = LoggedTransforms()

    def turned(seconds: float) -> Pose:
        return Pose((0.0, 0.0, 0.5), (0.0, 0.0, sin(0.5 * seconds), cos(0.5 * seconds)))
    for k in range(101):
        stamp_ns, time = START + 20_000_000 * k, 0.02 * k
        if k % 5 == 0:
            tf.take([Transform('world', 'base', stamp_ns, Pose((0.3 * time, 0.0, 0.0)))],
                    static=False)
        tf.take([Transform('base', 'arm', stamp_ns, turned(time))], static=False)
    tf.take([Transform('arm', 'tip', 0, Pose((0.4, 0.0, 0.0)))], static=True)
    assert tf.latest_ns('world', 'tip') == START + 2 * 10**9
    assert tf.latest_ns('arm', 'tip') == 0
    for time in (0.51, 0.987, 1.3):
        found = tf.pose('world', 'tip', START + round(1e9 * time))
        assert found.position == pytest.approx(
            (0.3 * time + 0.4 * cos(time), 0.4 * sin(time), 0.5), abs=3e-5)
        back = tf.pose('tip', 'world', START + round(1e9 * time))
        assert compose(found, back).position == pytest.approx((0.0, 0.0, 0.0), abs=1e-15)
    with pytest.raises(InputError, match="no transform of 'arm' at"):
        tf.pose('world', 'tip', START + 2 * 10**9 + 1)
    tf.take([Transform('mars', 'rover', START, Pose())], static=False)
    with pytest.raises(InputError, match="TF does not connect 'rover' with 'world'"):
        tf.pose('world', 'rover', 0)


@pytest.mark.parametrize('order', ['<', '>'])
def test_transforms_are_read_in_both_byte_orders(order):
    poses = [in_base(0.1 * k) for k in range(3)]
    names = ['a', 'link_22', 'x' * 9]
    little = written(0.0, '/tf', 'tf2_msgs/msg/TFMessage', transforms=[
        transform_stamped(0.5, 'world', name, pose) for name, pose in zip(names, poses)]).data
    if order == '>':
        from support.foreign import STORE
        message = STORE.deserialize_cdr(little, 'tf2_msgs/msg/TFMessage')
        little = bytes(STORE.serialize_cdr(message, 'tf2_msgs/msg/TFMessage',
                                           little_endian=False))
    found = read_transforms(little)
    assert [each.child for each in found] == names
    for each, pose in zip(found, poses):
        assert each == Transform('world', each.child, START + 500_000_000, each.pose)
        assert each.pose.position == pytest.approx(pose.position, abs=1e-15)
        assert each.pose.orientation == pytest.approx(pose.orientation, abs=1e-15)
    for cut in range(1, len(little)):
        with pytest.raises(InputError, match='cannot be unpacked'):
            read_transforms(little[:cut])
