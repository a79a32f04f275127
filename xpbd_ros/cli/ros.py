"""Functions for verbs that need ROS or the inputs of a log."""

import importlib.util
from pathlib import Path
import sys
import time

from xpbd_ros import __version__
from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader


def need_ros(verb: str) -> None:
    """Raise InputError with a remedy if rclpy or the message packages are not installed."""
    for package in ('rclpy', 'sensor_msgs', 'visualization_msgs'):
        if importlib.util.find_spec(package) is None:
            raise InputError(
                f"'{verb}' needs ROS 2, and {package} is not installed; source "
                "/opt/ros/jazzy/setup.bash, or pip install 'xpbd_ros[ros]'")


def new_log(folder: Path, scene, simulation, **settings: str):
    """Return the recorder of a run without DDS; the first frame is written."""
    from xpbd_ros.ros.outputs import Outputs
    from xpbd_ros.ros.recorder import Recorder
    from xpbd_ros.scene.files import as_attachments
    from xpbd_ros.scene.save import scene_text

    outputs = Outputs(simulation, scene.top.frame_id, scene_text(scene, simulation.solver))
    return Recorder(folder, outputs, epoch_ns=time.time_ns(),
                    settings={**settings, 'version': __version__},
                    files=as_attachments(scene))


def recording_of(verb: str, log: str | LogReader):
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
