"""Functions for verbs that need ROS or the inputs of a log."""

import importlib.util
import sys

from xpbd_ros.errors import InputError


def need_ros(verb: str) -> None:
    """Raise InputError with a remedy if rclpy or the message packages are not installed."""
    for package in ('rclpy', 'sensor_msgs', 'visualization_msgs'):
        if importlib.util.find_spec(package) is None:
            raise InputError(
                f"'{verb}' needs ROS 2, and {package} is not installed; source "
                "/opt/ros/jazzy/setup.bash, or pip install 'xpbd_ros[ros]'")


def recording_of(verb: str, log: str):
    """Return a recorded run; print the damage of its log, since inputs may be lost."""
    need_ros(f'{verb} --commands')
    from xpbd_ros.ros.logged_commands import Recording
    return Recording(log, lambda text: print(
        f'xpbd_ros {verb}: damaged log: {text}; inputs may be lost', file=sys.stderr))


def commands_of(verb: str, log: str, scene, frames: int) -> dict:
    """
    Return a log's inputs by frame, for a study that varies the solver.

    Other differences from the recorded scene, which may be intended, are printed.
    """
    from xpbd_ros.scene.compare import difference_texts, differences
    recording = recording_of(verb, log).checked_repeatable()
    found = [one for one in differences(scene, recording.scene)
             if not one[0].startswith('solver.')]
    for text in [*difference_texts(found), *recording.inputs_after(frames)]:
        print(f'xpbd_ros {verb}: {recording.path}: {text}', file=sys.stderr)
    return recording.commands
