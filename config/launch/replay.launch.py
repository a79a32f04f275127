"""
Publish a recorded run again, with the flags of ``ros2 bag play``.

::

    ros2 launch xpbd_ros replay.launch.py run:=/data/flag rate:=0.5 rviz:=true

It is ``xpbd_ros replay RUN`` beside RViz; an argument left empty is a flag not given.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage

SHARE = Path(__file__).resolve().parents[1]    # holds launch/, views/, scenes/, cloth_node.yaml

ARGUMENTS = [
    DeclareLaunchArgument(
        'run', description='Recorded run: its folder, or the .mcap in it'),
    DeclareLaunchArgument(
        'rate', default_value='1.0', description='Times faster than it was recorded'),
    DeclareLaunchArgument(
        'start_offset', default_value='0.0', description='Seconds to skip at the start'),
    DeclareLaunchArgument(
        'clock', default_value='', description='Hz to publish /clock at; empty is not at all'),
    DeclareLaunchArgument(
        'topics', default_value='', description='Topics to publish, with spaces between; '
                                                'empty is all'),
    DeclareLaunchArgument(
        'remap', default_value='', description='Remappings old:=new, with spaces between'),
    DeclareLaunchArgument(
        'loop', default_value='false', choices=['true', 'false'],
        description='Start again at the end'),
    DeclareLaunchArgument(
        'start_paused', default_value='false', choices=['true', 'false'],
        description='Wait for ~/resume or ~/play_next'),
    DeclareLaunchArgument(
        'rviz', default_value='false', choices=['true', 'false'],
        description='Show the run in RViz as well'),
]


def generate_launch_description():
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=processes)])


def processes(context):
    """Return the replay, and RViz where that is asked for."""
    run = LaunchConfiguration('run').perform(context)
    replay = ExecuteProcess(
        cmd=[ExecutableInPackage(package='xpbd_ros', executable='xpbd_ros'), 'replay', run,
             *flags(context)],
        output='screen', name='replay')
    rviz = Node(
        package='rviz2', executable='rviz2',
        arguments=['-d', str(SHARE / 'views' / 'cloth.rviz')],
        condition=IfCondition(LaunchConfiguration('rviz')))
    return [rviz, replay]    # rviz first: where it is missing, nothing has been started yet


def flags(context):
    """Return the flags that the launch arguments stand for."""
    words = []
    for argument in ('rate', 'start_offset', 'clock', 'topics', 'remap'):
        value = LaunchConfiguration(argument).perform(context)
        if value:
            words += [f'--{argument}'.replace('_', '-'), *value.split()]
    for argument in ('loop', 'start_paused'):
        if LaunchConfiguration(argument).perform(context) == 'true':
            words.append(f'--{argument}'.replace('_', '-'))
    return words
