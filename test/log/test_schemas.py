"""Schemas hold the definition of everything that a message is made of."""

import importlib.util
import os
from pathlib import Path
import subprocess
import sys

from mcap_ros2._dynamic import generate_dynamic
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from xpbd_ros.errors import InputError
from xpbd_ros.log.schemas import message_definition, type_hash

TYPES = ['diagnostic_msgs/msg/DiagnosticArray', 'geometry_msgs/msg/PoseStamped',
         'geometry_msgs/msg/WrenchStamped', 'rosgraph_msgs/msg/Clock',
         'sensor_msgs/msg/MultiDOFJointState', 'sensor_msgs/msg/PointCloud2',
         'shape_msgs/msg/Mesh', 'std_msgs/msg/Float64MultiArray', 'std_msgs/msg/String',
         'std_msgs/msg/UInt64', 'visualization_msgs/msg/MarkerArray']


@pytest.fixture(scope='module')
def store():
    return get_typestore(Stores.ROS2_JAZZY)


def names(definition: str) -> set[str]:
    """Return the types that a definition has a part for."""
    return {line.removeprefix('MSG: ').replace('/msg/', '/') for line in definition.splitlines()
            if line.startswith('MSG: ')}


@pytest.mark.parametrize('type_name', TYPES)
def test_every_part_is_there_once(store, type_name):
    definition = message_definition(type_name)
    expected, _ = store.generate_msgdef(type_name, ros_version=2)
    assert names(definition) == names(expected)
    parts = [line for line in definition.splitlines() if line.startswith('MSG: ')]
    assert len(parts) == len(set(parts)) == definition.splitlines().count('=' * 80)


@pytest.mark.parametrize('type_name', TYPES)
def test_two_parsers_make_the_same_fields_of_it_as_ros(store, type_name):
    definition = message_definition(type_name)
    assert type_name in generate_dynamic(type_name, definition)
    parsed = get_types_from_msg(definition, type_name)
    assert parsed[type_name] == store.fielddefs[type_name]


@pytest.mark.parametrize('type_name', TYPES)
def test_the_hash_is_the_one_that_ros_computes(store, type_name):
    assert type_hash(type_name) == store.hash_rihs01(type_name)


def test_parts_are_set_off_as_rosbag2_does_it():
    lines = message_definition('std_msgs/msg/Header').splitlines()
    at = lines.index('MSG: builtin_interfaces/Time')
    assert lines[at - 1] == '=' * 80
    assert lines[at - 2] == ''
    assert 'builtin_interfaces/Time stamp' in lines[:at]
    assert 'int32 sec' in lines[at:]


def test_a_package_of_the_workspace_comes_first(tmp_path, monkeypatch):
    folder = tmp_path / 'share' / 'own_msgs' / 'msg'
    folder.mkdir(parents=True)
    (folder / 'Part.msg').write_text('float64 value\n')
    (folder / 'Whole.msg').write_text(
        '# not_a/Field here\nPart[<=3] parts\nown_msgs/Part[2] pair  # and more\n'
        'string<=10[] names\nuint8 KIND=1\nstd_msgs/Empty nothing\n')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    definition = message_definition('own_msgs/msg/Whole')
    assert names(definition) == {'own_msgs/Part', 'std_msgs/Empty'}
    assert type_hash('own_msgs/msg/Whole') == ''    # no .json: a type of unknown origin


@pytest.mark.parametrize(('type_name', 'said'), [
    ('std_msgs/msg/Strin', "std_msgs/msg/Strin: its definition is not installed; pip install "
                           "'xpbd_ros[ros]', or source"),
    ('no_msgs/msg/Thing', 'no_msgs/msg/Thing: its definition is not installed'),
    ('String', 'String: not the name of a message type'),
    ('../../etc/passwd', 'not the name of a message type')])
def test_what_is_not_there_is_named(type_name, said):
    with pytest.raises(InputError) as caught:
        message_definition(type_name)
    assert said in str(caught.value)
    assert '\n' not in str(caught.value)


def test_no_environment_is_needed_and_no_ros_imported():
    prefix = Path(importlib.util.find_spec('std_msgs').origin).parents[1]
    code = ('import sys; from xpbd_ros.log.schemas import message_definition;'
            'message_definition("sensor_msgs/msg/PointCloud2");'
            'print([name for name in sys.modules if name.startswith(("rclpy", "std_msgs"))])')
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True,
        env={'PATH': os.environ['PATH'],
             'PYTHONPATH': os.pathsep.join([*filter(None, sys.path), str(prefix)])})
    assert (done.returncode, done.stdout, done.stderr) == (0, '[]\n', '')
