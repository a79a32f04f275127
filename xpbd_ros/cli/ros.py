"""For verbs that need ROS: say so in one line where it is missing."""

import importlib.util
import sys

from xpbd_ros.errors import InputError


def need_ros(verb: str) -> None:
    """Raise InputError with the way out if rclpy or the messages cannot be imported."""
    for package in ('rclpy', 'sensor_msgs', 'visualization_msgs'):
        if importlib.util.find_spec(package) is None:
            raise InputError(
                f"'{verb}' needs ROS 2, and {package} is not there; source "
                "/opt/ros/jazzy/setup.bash, or pip install 'xpbd_ros[ros]'")


def commands_of(verb: str, log: str) -> dict:
    """Return a log's inputs by frame; say what is damaged of it, since some may be lost."""
    need_ros(f'{verb} --commands')
    from xpbd_ros.ros.playback import commands_by_frame
    return commands_by_frame(log, lambda text: print(
        f'xpbd_ros {verb}: damaged log: {text}; inputs may be lost', file=sys.stderr))
