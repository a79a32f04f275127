"""
Start the two-finger robot and the cloth that it picks up, carries and lays down.

::

    ros2 launch xpbd_ros robot.launch.py
    ros2 launch xpbd_ros robot.launch.py tf:=true rviz:=true

With ``tf:=true`` robot_state_publisher turns the joint states into TF; the scene says which of the
two the cloth node follows.
"""

from pathlib import Path
import sys

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    RegisterEventHandler,
    Shutdown,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import Command, LaunchConfiguration, PythonExpression
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue

SHARE = Path(__file__).resolve().parents[1]    # holds launch/, robots/
ROBOTS = SHARE / 'robots'


def generate_launch_description():
    """Return the robot's motion, the cloth node, and robot_state_publisher where asked for."""
    return LaunchDescription([
        DeclareLaunchArgument(
            'scene', default_value=str(ROBOTS / 'robot.yaml'),
            description='Scene with the robot'),
        DeclareLaunchArgument(
            'description', default_value=str(ROBOTS / 'two_finger.urdf'),
            description='URDF file for robot_state_publisher'),
        DeclareLaunchArgument(
            'record', default_value='',
            description='Folder to record the run to; it must not exist yet'),
        DeclareLaunchArgument(
            'tf', default_value='false', choices=['true', 'false'],
            description='Start robot_state_publisher'),
        DeclareLaunchArgument(
            'rviz', default_value='false', choices=['true', 'false'],
            description='Show the cloth in RViz as well'),
        Node(    # first: where it is missing, launch gives up with nothing started
            package='robot_state_publisher', executable='robot_state_publisher',
            parameters=[{'robot_description': ParameterValue(
                Command(['cat ', LaunchConfiguration('description')]), value_type=str)}],
            condition=IfCondition(LaunchConfiguration('tf'))),
        RegisterEventHandler(OnProcessExit(    # else the motion would wait for the node for ever
            target_action=lambda action: (isinstance(action, LifecycleNode)
                                          and action.node_package == 'xpbd_ros'),
            on_exit=Shutdown(reason='the cloth node has ended'))),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(SHARE / 'launch' / 'cloth.launch.py')),
            launch_arguments={name: LaunchConfiguration(name)
                              for name in ('scene', 'record', 'rviz')}.items()),
        ExecuteProcess(    # it begins once the cloth node listens, too
            cmd=[sys.executable, str(ROBOTS / 'two_finger_motion.py'), '--ros-args', '-p',
                 ['subscribers:=', PythonExpression([
                     "2 if '", LaunchConfiguration('tf'), "' == 'true' else 1"])]],
            output='screen'),
    ])
