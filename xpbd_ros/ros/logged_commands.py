"""Read a recorded run: its scene, its inputs as commands, and the hashes of its states."""

from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from std_msgs.msg import UInt64

from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.writer import CHECKPOINT
from xpbd_ros.ros.clouds import positions_of
from xpbd_ros.ros.inputs import input_of, unpacked
from xpbd_ros.ros.recorder import type_name
from xpbd_ros.scene.files import written_out
from xpbd_ros.scene.load import parse_yaml, scene_from_text
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.checkpoint import restore
from xpbd_ros.sim.commands import Command, Pose
from xpbd_ros.sim.simulation import Simulation


class Recording:
    """
    A recorded run.

    Parameters
    ----------
    run : path of the log, or the log
    tell : is given a text for each damage of the log, which may then lack inputs

    Attributes
    ----------
    scene : Scene
        The scene as it ran, with ``auto`` resolved. Its files come from the log, where it holds
        them.
    settings : dict of str
        Versions and settings of the run.
    commands : dict of list
        Inputs by the frame that they acted on, in order.
    hashes : dict of int
        Hashes of the states, by frame.
    first, last : int
        First and last frame with a state hash.

    Raises
    ------
    InputError : if the file is not a log of xpbd_ros, or an input in it is invalid

    """

    def __init__(self, run: str | LogReader, tell: Callable[[str], None] = lambda text: None):
        self._reader = reader = run if isinstance(run, LogReader) else LogReader(run)
        self.path = reader.path
        if reader.scene is None:
            raise InputError(f'{self.path}: is not a log of xpbd_ros: it holds no scene')
        self.settings = reader.settings
        self._folder = TemporaryDirectory(prefix='xpbd_ros_')
        self.scene: Scene = self.scene_with({})
        for text in reader.damage:
            tell(text)
        self.commands = self._commands()
        self.hashes = {
            message.frame: unpacked(message.data, UInt64).data
            for message in reader.messages(self._topics('state_hash', UInt64))}
        if not self.hashes:
            raise InputError(f'{self.path}: holds no ~/state_hash, with which a repeated run '
                             'is compared; take the log as it was recorded')
        if len(self.hashes) < 2:
            raise InputError(f'{self.path}: holds no frame after its start, so there is nothing '
                             'to repeat; record a longer run')
        self.first, self.last = min(self.hashes), max(self.hashes)

    def scene_with(self, overrides: dict[str, Any]) -> Scene:
        """Return the scene as it ran, with some keys changed."""
        assert self._reader.scene is not None
        where = f'{self.path}: scene'
        files = written_out(parse_yaml(self._reader.scene, where), self._reader.attachments,
                            Path(self._folder.name))
        return scene_from_text(self._reader.scene, where=where, name=self.path.stem,
                               overrides={**files, **overrides})

    def begin(self, simulation: Simulation) -> None:
        """
        Bring a simulation of the scene to the first frame of the log.

        Raises
        ------
        InputError : the log begins in the middle of a run and holds no usable checkpoint of it

        """
        if self.first == 0:
            return
        data = self._reader.attachments.get(CHECKPOINT)
        if data is None:
            raise InputError(f'{self.path}: begins in the middle of a run, with frame '
                             f'{self.first}, and holds no checkpoint of it; record again')
        try:
            restore(simulation, data)
        except InputError as error:
            raise InputError(f'{self.path}: {error}') from None

    @property
    def not_repeatable(self) -> str:
        """Reason why its start cannot be compared with a scene; else empty."""
        if self.first == 0:
            return ''
        return (f'{self.path}: begins in the middle of a run, with frame {self.first}, so its '
                'inputs do not fit a run from the start; xpbd_ros resim repeats it from there')

    def checked_repeatable(self) -> 'Recording':
        """Return the recording itself; raise InputError if its start is not in the log."""
        if self.not_repeatable:
            raise InputError(self.not_repeatable)
        return self

    def inputs_after(self, frames: int) -> list[str]:
        """Return a note on inputs that act only after ``frames`` frames; empty without any."""
        left = sum(len(commands) for frame, commands in self.commands.items() if frame > frames)
        return [f'{left} inputs of the log act after frame {frames}, with which this run '
                'ends'] if left else []

    def clouds(self) -> Iterator[tuple[int, str, np.ndarray]]:
        """Yield frame, topic and recorded positions [m] (float32, shape (particles, 3))."""
        for message in self._reader.messages(self._topics('particles', PointCloud2)):
            yield message.frame, message.topic, positions_of(unpacked(message.data, PointCloud2))

    def collider_poses(self) -> Iterator[tuple[int, dict[str, Pose]]]:
        """Yield frame and poses of the colliders, by name."""
        for message in self._reader.messages(self._topics('collider_wrenches',
                                                          MultiDOFJointState)):
            states = unpacked(message.data, MultiDOFJointState)
            yield message.frame, {
                name: Pose((at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))
                for name, pose in zip(states.joint_names, states.transforms)
                for at, turn in [(pose.translation, pose.rotation)]}

    def _topics(self, name: str, kind: type) -> list[str]:
        return [topic for topic, about in self._reader.topics.items()
                if last_part(topic) == name and about.type == type_name(kind)]

    def _commands(self) -> dict[int, list[Command]]:
        inputs = {topic: found for topic, about in self._reader.topics.items()
                  if (found := input_of(topic)) and type_name(found.kind) == about.type}
        by_frame: dict[int, list[Command]] = {}
        for message in self._reader.messages(inputs):
            about = inputs[message.topic]
            try:
                commands = about.read(unpacked(message.data, about.kind),
                                      self.scene.top.frame_id)
            except InputError as error:
                raise InputError(f'{self.path}: {message.topic}, frame {message.frame}: '
                                 f'{error}') from error
            by_frame.setdefault(message.frame, []).extend(commands)
        return by_frame


def last_part(topic: str) -> str:
    """Return the last part of a topic's name."""
    return topic.rsplit('/', 1)[-1]


def is_input(topic: str, kind: str) -> bool:
    """Return whether a node takes messages on a topic of this name and type as inputs."""
    about = input_of(topic)
    if about is None:
        return last_part(topic) == 'set_state' and kind == 'sensor_msgs/msg/PointCloud2'
    return type_name(about.kind) == kind
