"""
Start the cloth node; it configures and activates itself.

::

    ros2 launch xpbd_ros cloth.launch.py scene:=swing
    ros2 launch xpbd_ros cloth.launch.py scene:=flag.yaml record:=/data/flag rviz:=true

An argument left empty means what the parameter file says.
"""

import copy
from pathlib import Path
import tempfile

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue
import yaml

SHARE = Path(__file__).resolve().parents[1]    # holds launch/, views/, scenes/, cloth_node.yaml
OTHER_TOPICS = ('markers', 'clicked_point', 'pin_handles/update', 'pin_handles/feedback',
                'pin_handles/get_interactive_markers')    # of RViz' view, besides the clouds

ARGUMENTS = [
    DeclareLaunchArgument(
        'scene', default_value='',
        description='Scene to simulate: a path, or the name of a shipped scene such as swing'),
    DeclareLaunchArgument(
        'params_file', default_value=str(SHARE / 'cloth_node.yaml'),
        description='Parameter file of the node'),
    DeclareLaunchArgument(
        'namespace', default_value='',
        description='Namespace of the node, so that several run side by side'),
    DeclareLaunchArgument(
        'use_sim_time', default_value='false', choices=['true', 'false'],
        description='Stamp messages with the time on /clock'),
    DeclareLaunchArgument(
        'record', default_value='',
        description='Folder to record the run to, from activation on; it must not exist yet'),
    DeclareLaunchArgument(
        'mode', default_value='', choices=['', 'realtime', 'lockstep', 'fast'],
        description='realtime: steps on a steady clock; lockstep: when ~/step is called; '
                    'fast: as fast as it can'),
    DeclareLaunchArgument(
        'log_level', default_value='info', choices=['debug', 'info', 'warn', 'error', 'fatal'],
        description='Least severe level that the node logs'),
    DeclareLaunchArgument(
        'rviz', default_value='false', choices=['true', 'false'],
        description='Show the cloth in RViz as well'),
]


def generate_launch_description():
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=nodes)])


def nodes(context):
    """Return the cloth node, and RViz on its topics where that is asked for."""
    given = {name: LaunchConfiguration(argument).perform(context)
             for name, argument in {'scene': 'scene', 'mode': 'mode',
                                    'record.path': 'record'}.items()}
    parameters = {name: ParameterValue(value, value_type=str)
                  for name, value in given.items() if value}
    parameters['use_sim_time'] = ParameterValue(
        LaunchConfiguration('use_sim_time'), value_type=bool)
    if LaunchConfiguration('rviz').perform(context) == 'true':
        parameters['interactive_markers'] = True
    file = LaunchConfiguration('params_file').perform(context)
    if not Path(file).is_file():    # launch would warn, and start the node without it
        raise ValueError(f'params_file: no such file: {file}')
    namespace = LaunchConfiguration('namespace').perform(context).strip('/')
    cloth = LifecycleNode(
        package='xpbd_ros', executable='cloth_node', name='cloth', namespace=namespace,
        parameters=[file, parameters],
        ros_arguments=['--log-level', LaunchConfiguration('log_level')],
        output='screen',
        sigterm_timeout='30')    # s after Ctrl-C: what the node needs to close its log, and more
    pushed = context.launch_configurations.get('ros_namespace', '')    # by PushRosNamespace
    full = f'{pushed}/{namespace}'.strip('/')
    cloths = cloths_of(given['scene'] or scene_in(file))
    rviz = Node(
        package='rviz2', executable='rviz2', namespace=namespace,
        arguments=['-d', str(view(cloths))],
        parameters=[{'use_sim_time': parameters['use_sim_time']}],
        remappings=[(f'/cloth/{topic}', f'/{full}/cloth/{topic}')
                    for topic in (*clouds(cloths), *OTHER_TOPICS) if full],
        condition=IfCondition(LaunchConfiguration('rviz')))
    return [rviz, cloth]    # rviz first: where it is missing, launch gives up with nothing started


def scene_in(file):
    """Return what a parameter file says of the scene."""
    for node in (yaml.safe_load(Path(file).read_text()) or {}).values():
        scene = (node or {}).get('ros__parameters', {}).get('scene')
        if scene:
            return str(scene)
    return ''


def cloths_of(scene):
    """Return the names of a scene's cloths; none where it cannot be read, which the node says."""
    file = Path(scene) if Path(scene).is_file() else SHARE / 'scenes' / f'{scene}.yaml'
    try:
        return list(yaml.safe_load(file.read_text())['cloths'])
    except (OSError, KeyError, TypeError, UnicodeDecodeError, yaml.YAMLError):
        return []


def clouds(cloths):
    """Return the topics of the particles, below the node's name."""
    return [f'cloth/{name}/particles' for name in cloths] if len(cloths) > 1 else ['particles']


def view(cloths):
    """Return the file for RViz: as it is installed, or with one display for each cloth."""
    file = SHARE / 'views' / 'cloth.rviz'
    if len(cloths) < 2:
        return file
    view = yaml.safe_load(file.read_text())
    displays = view['Visualization Manager']['Displays']
    (particles,) = (each for each in displays if each['Class'].endswith('PointCloud2'))
    at = displays.index(particles)
    displays[at:at + 1] = own = [copy.deepcopy(particles) for _ in cloths]
    for display, name, topic in zip(own, cloths, clouds(cloths)):
        display['Name'], display['Topic']['Value'] = f'Particles of {name}', f'/cloth/{topic}'
    with tempfile.NamedTemporaryFile('w', suffix='.rviz', delete=False) as made:
        yaml.safe_dump(view, made, sort_keys=False)
    return Path(made.name)
