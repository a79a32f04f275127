"""The launch files: what they take, and what they start."""

import ast
from pathlib import Path
import sys

import pytest
import yaml

from xpbd_ros.share import share_folder

try:
    from launch import LaunchContext
    from launch.actions import (
        DeclareLaunchArgument,
        ExecuteProcess,
        IncludeLaunchDescription,
        RegisterEventHandler,
        Shutdown,
    )
    from launch.events.process import ProcessExited
    from launch.launch_description_sources import PythonLaunchDescriptionSource
    from launch.substitutions import LocalSubstitution
    from launch_ros.actions import LifecycleNode, Node
except ImportError as error:
    missing = f'needs ROS 2 launch and launch_ros: {error}'
else:
    missing = ''

needs_launch = pytest.mark.skipif(bool(missing), reason=missing)

LAUNCH = share_folder() / 'launch'
ARGUMENTS = {
    'cloth': {'scene', 'params_file', 'namespace', 'use_sim_time', 'record', 'mode', 'log_level',
              'rviz'},
    'replay': {'run', 'rate', 'start_offset', 'clock', 'topics', 'remap', 'loop', 'start_paused',
               'rviz'},
    'robot': {'scene', 'description', 'record', 'tf', 'rviz'},
}


@pytest.fixture(autouse=True)
def no_bytecode(monkeypatch):
    """Leave no __pycache__ beside the launch files, which would be installed with them."""
    monkeypatch.setattr(sys, 'dont_write_bytecode', True)


def started(name: str, **given):
    """Return what a launch file starts with these arguments, and the context to ask it in."""
    context = LaunchContext()
    context.launch_configurations.update(given)
    source = PythonLaunchDescriptionSource(str(LAUNCH / f'{name}.launch.py'))
    *arguments, function = source.get_launch_description(context).entities
    for argument in arguments:
        argument.execute(context)
    return function.execute(context), context


def command_line(node, context) -> list[str]:
    """Return the words that a node is started with, after the path of its executable."""
    node._perform_substitutions(context)
    return [''.join('' if isinstance(part, LocalSubstitution) else part.perform(context)
                    for part in word) for word in node.cmd[1:]]


def parameters(node, context) -> dict:
    """Return the parameters of a node, as the last file to name each has it."""
    words = command_line(node, context)
    merged = {}
    for word, file in zip(words, words[1:]):
        if word == '--params-file':
            (values,) = yaml.safe_load(Path(file).read_text()).values()
            merged.update(values['ros__parameters'])
    return merged


@pytest.mark.parametrize('name', ARGUMENTS)
def test_declares_each_argument_with_a_description(name):
    """``ros2 launch --show-args`` is how a user finds them; asked of the source, without ROS."""
    calls = [node for node in ast.walk(ast.parse((LAUNCH / f'{name}.launch.py').read_text()))
             if isinstance(node, ast.Call)
             and getattr(node.func, 'id', '') == 'DeclareLaunchArgument']
    assert {call.args[0].value for call in calls} == ARGUMENTS[name]
    for call in calls:
        assert 'description' in {keyword.arg for keyword in call.keywords}, call.args[0].value


@needs_launch
@pytest.mark.parametrize('name', ARGUMENTS)
def test_loads_as_launch_loads_it(name):
    source = PythonLaunchDescriptionSource(str(LAUNCH / f'{name}.launch.py'))
    description = source.get_launch_description(LaunchContext())
    arguments = description.get_launch_arguments()
    included = ARGUMENTS['cloth'] if name == 'robot' else set()
    assert {argument.name for argument in arguments} == ARGUMENTS[name] | included
    assert all(isinstance(argument, DeclareLaunchArgument) and argument.description
               for argument in arguments)
    required = {argument.name for argument in arguments if argument.default_value is None}
    assert required == ({'run'} if name == 'replay' else set())


@needs_launch
def test_starts_the_cloth_node_under_its_name():
    (rviz, cloth), context = started('cloth')
    assert isinstance(cloth, LifecycleNode)
    assert (cloth.node_package, cloth.node_executable) == ('xpbd_ros', 'cloth_node')
    command_line(cloth, context)
    assert cloth.node_name == '/cloth'
    assert not rviz.condition.evaluate(context)


@needs_launch
def test_an_empty_argument_leaves_the_parameter_file_alone(tmp_path):
    """Else ``params_file:=mine.yaml`` could not set the scene, the mode or the recording."""
    mine = tmp_path / 'mine.yaml'
    mine.write_text('/**:\n  ros__parameters: {scene: towel, mode: fast, record: {path: /data}}\n')
    (_, cloth), context = started('cloth', params_file=str(mine))
    assert parameters(cloth, context) == {
        'scene': 'towel', 'mode': 'fast', 'record': {'path': '/data'}, 'use_sim_time': False}


@needs_launch
def test_an_argument_given_wins_over_the_parameter_file():
    (_, cloth), context = started('cloth', scene='1', mode='lockstep', record='/data/run',
                                  use_sim_time='true', log_level='debug')
    words = command_line(cloth, context)
    assert words[words.index('--log-level') + 1] == 'debug'
    values = parameters(cloth, context)
    assert values['scene'] == '1'    # a name, although it reads like a number
    assert values['mode'] == 'lockstep'
    assert values['record.path'] == '/data/run'
    assert values['use_sim_time'] is True
    assert values['marker_rate'] == 15.0    # from the shipped file


@needs_launch
def test_a_namespace_moves_the_node_and_what_rviz_listens_to():
    (rviz, cloth), context = started('cloth', namespace='left', rviz='true')
    command_line(cloth, context)
    assert cloth.node_name == '/left/cloth'
    assert rviz.condition.evaluate(context)
    assert '/cloth/particles:=/left/cloth/particles' in command_line(rviz, context)
    assert parameters(cloth, context)['interactive_markers'] is True


@needs_launch
@pytest.mark.parametrize(('given', 'name'), [({}, '/robot/cloth'),
                                             ({'namespace': 'left'}, '/robot/left/cloth')])
def test_a_namespace_pushed_around_it_moves_both(given, name):
    """By PushRosNamespace, in a launch file that includes this one."""
    (rviz, cloth), context = started('cloth', rviz='true', ros_namespace='/robot', **given)
    command_line(cloth, context)
    assert cloth.node_name == name
    assert f'/cloth/particles:={name}/particles' in command_line(rviz, context)


@needs_launch
def test_refuses_a_parameter_file_that_is_not_there():
    """Launch itself would warn, and start the node on its defaults."""
    with pytest.raises(ValueError, match=r'params_file: no such file: nope\.yaml'):
        started('cloth', params_file='nope.yaml')


@needs_launch
@pytest.mark.parametrize(('given', 'flags'), [
    ({}, '--rate 1.0 --start-offset 0.0'),
    ({'rate': '0.5', 'clock': '40', 'loop': 'true'},
     '--rate 0.5 --start-offset 0.0 --clock 40 --loop'),
    ({'topics': '/a /b', 'remap': '/a:=/c', 'start_paused': 'true'},
     '--rate 1.0 --start-offset 0.0 --topics /a /b --remap /a:=/c --start-paused'),
])
def test_replay_passes_the_flags_of_ros2_bag_play(given, flags):
    (_, replay), context = started('replay', run='/data/flag', **given)
    words = [''.join(part.perform(context) for part in word) for word in replay.cmd[1:]]
    assert words == ['replay', '/data/flag', *flags.split()]


@needs_launch
@pytest.mark.parametrize(('given', 'count'), [({}, 1), ({'tf': 'true'}, 2)])
def test_the_robot_moves_once_the_cloth_node_listens(given, count):
    """Not when robot_state_publisher does, which starts faster."""
    context = LaunchContext()
    context.launch_configurations.update({'tf': 'false', **given})
    source = PythonLaunchDescriptionSource(str(LAUNCH / 'robot.launch.py'))
    publisher, *_, motion = source.get_launch_description(context).entities[-4:]
    assert publisher.condition.evaluate(context) == (count == 2)
    words = [''.join(part.perform(context) for part in word) for word in motion.cmd]
    assert words[-1] == f'subscribers:={count}'


@needs_launch
def test_the_robot_stops_with_the_cloth_node():
    """Which may refuse the scene: then its motion would wait for ever."""
    source = PythonLaunchDescriptionSource(str(LAUNCH / 'robot.launch.py'))
    handler, = (each.event_handler for each in
                source.get_launch_description(LaunchContext()).entities
                if isinstance(each, RegisterEventHandler))
    (_, cloth), context = started('cloth')
    command_line(cloth, context)

    def ended(action):
        return ProcessExited(action=action, name='cloth', cmd=[], cwd=None, env=None, pid=1,
                             returncode=2)
    assert handler.matches(ended(cloth))
    action, = handler.handle(ended(cloth), context)
    assert isinstance(action, Shutdown)
    assert not handler.matches(ended(ExecuteProcess(cmd=['true'])))


@needs_launch
def test_what_may_be_missing_comes_before_the_cloth_node():
    """Launch gives up where a package is missing, and leaves what it has started running."""
    source = PythonLaunchDescriptionSource(str(LAUNCH / 'robot.launch.py'))
    entities = source.get_launch_description(LaunchContext()).entities
    publisher, = (k for k, each in enumerate(entities) if isinstance(each, Node))
    cloth, = (k for k, each in enumerate(entities) if isinstance(each, IncludeLaunchDescription))
    assert publisher < cloth


def test_the_launch_files_need_nothing_but_launch():
    """They are installed away from the package, and a machine with rviz alone may read them."""
    for file in LAUNCH.glob('*.launch.py'):
        names = {node.module or '' for node in ast.walk(ast.parse(file.read_text()))
                 if isinstance(node, ast.ImportFrom)}
        assert not [name for name in names if name.startswith('xpbd_ros')], file


SHEET = 'grid: {size: [1, 1], resolution: [3, 3]}, density: 0.1'


def outputs(*cloths: str):
    """Return what a node publishes of a scene with these cloths."""
    pytest.importorskip(
        'rclpy', reason="rclpy is missing: source a ROS, or pip install '.[ros]'")
    from xpbd_ros.ros.outputs import Outputs
    from xpbd_ros.scene.compile import compile_scene
    from xpbd_ros.scene.load import scene_from_text
    scene = scene_from_text('cloths: {' + ', '.join(f'{name}: {{{SHEET}}}' for name in cloths)
                            + '}', where='here', name='here')
    return Outputs(compile_scene(scene), 'world', '')


def check_view(view: dict, published) -> None:
    """Each topic of a view is published, with its type; it colours by what is in the clouds."""
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import PointCloud2
    manager = view['Visualization Manager']
    shown = {entry['Topic']['Value']: entry for entry in manager['Displays'] if 'Topic' in entry}
    kinds = {f'/cloth/{topic}': output.kind.__name__ for topic, output in published.topics.items()}
    assert {topic: entry['Class'].split('/')[1] for topic, entry in shown.items()} == {
        topic: kind for topic, kind in kinds.items()
        if topic.endswith(('particles', 'markers'))}
    frame = published.simulation.frame()
    for topic, data in published.frame(frame, 0).items():
        fields = {field.name for field in deserialize_message(data, PointCloud2).fields}
        entry = shown[f'/cloth/{topic}']
        assert {entry.get('Axis', 'x').lower(), entry.get('Channel Name', 'x')} <= fields
        assert entry['Color Transformer'] in ('AxisColor', 'FlatColor') or 'Channel Name' in entry
    assert manager['Global Options']['Fixed Frame'] == 'world'


def test_rviz_shows_topics_and_channels_that_the_node_publishes():
    view = yaml.safe_load((share_folder() / 'views' / 'cloth.rviz').read_text())
    check_view(view, outputs('towel'))


@needs_launch
def test_rviz_shows_several_cloths(tmp_path):
    scene = tmp_path / 'two.yaml'
    scene.write_text(f'cloths:\n  shirt: {{{SHEET}}}\n  sock: {{{SHEET}}}\n')
    (rviz, _), context = started('cloth', scene=str(scene), rviz='true', namespace='left')
    words = command_line(rviz, context)
    view = yaml.safe_load(Path(words[words.index('-d') + 1]).read_text())
    check_view(view, outputs('shirt', 'sock'))
    for topic in ('cloth/sock/particles', 'markers', 'clicked_point', 'pin_handles/update',
                  'pin_handles/feedback', 'pin_handles/get_interactive_markers'):
        assert f'/cloth/{topic}:=/left/cloth/{topic}' in words


def test_the_parameter_file_holds_the_defaults_of_the_node():
    """Else ``ros2 run`` and ``ros2 launch`` would start two different nodes."""
    pytest.importorskip('rcl_interfaces', reason='needs ROS: the table of parameters')
    from xpbd_ros.ros.parameters import TABLE
    (parts,) = yaml.safe_load((share_folder() / 'cloth_node.yaml').read_text()).values()
    values = {}
    for name, value in parts['ros__parameters'].items():
        values |= ({f'{name}.{key}': below for key, below in value.items()}
                   if isinstance(value, dict) else {name: value})
    assert values == {row.name: row.default for row in TABLE} | {'use_sim_time': False}
    for row in TABLE:    # a node refuses 15 where it declared 15.0
        assert type(values[row.name]) is type(row.default), row.name
