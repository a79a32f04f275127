"""A recorded run: its scene, its inputs as commands again, and the states that came of them."""

from collections.abc import Callable, Iterator
import re

import numpy as np
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt64

from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader
from xpbd_ros.ros.inputs import INPUTS, unpacked
from xpbd_ros.ros.recorder import type_name
from xpbd_ros.scene.load import scene_from_text
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import Command

COLLIDER = re.compile(r'/collider/\w+/pose$')


class Recording:
    """
    What a log says of a run.

    Parameters
    ----------
    run : the log
    tell : is given each damage of the log, which may then lack inputs

    Attributes
    ----------
    scene : Scene
        As it ran.
    commands : dict of list
        The inputs by the frame that they acted on, in order.
    hashes : dict of int
        Of the states, by frame.
    first, last : int
        The first and the last frame whose state's hash is known.

    Raises
    ------
    InputError : not a log, or not of xpbd_ros, or with inputs that make no sense

    """

    def __init__(self, run: str, tell: Callable[[str], None] = lambda text: None):
        self._reader = reader = LogReader(run)
        self.path = reader.path
        if reader.scene is None:
            raise InputError(f'{self.path}: is not a log of xpbd_ros: it holds no scene')
        self.scene: Scene = scene_from_text(reader.scene, where=f'{self.path}: scene',
                                            name=self.path.stem)
        for text in reader.damage:
            tell(text)
        self.commands = self._commands()
        self.hashes = {
            message.frame: unpacked(message.data, UInt64).data
            for message in reader.messages(self._topics('state_hash', UInt64))}
        if len(self.hashes) < 2:
            raise InputError(f'{self.path}: holds no frame after its start, which is all that '
                             'could be repeated')
        self.first, self.last = min(self.hashes), max(self.hashes)

    @property
    def late(self) -> str:
        """Why it cannot be repeated, where it does not begin with the start of its scene."""
        if self.first == 0:
            return ''
        return (f'{self.path}: begins in the midst of a run, with frame {self.first}: what was '
                'grasped and moved before is not in it, so that it cannot be repeated; record '
                "from the start, with the node's parameter record.path")

    def from_its_start(self) -> 'Recording':
        """Return this, or raise InputError if it does not begin with the start of its scene."""
        if self.late:
            raise InputError(self.late)
        return self

    def beyond(self, frames: int) -> list[str]:
        """Say how many inputs act only after so many frames; nothing where none does."""
        left = sum(len(commands) for frame, commands in self.commands.items() if frame > frames)
        return [f'{left} inputs of the log act after frame {frames}, with which this run '
                'ends'] if left else []

    def clouds(self) -> Iterator[tuple[int, str, np.ndarray]]:
        """Yield frame, topic and positions (float32, shape (particles, 3)), as recorded."""
        for message in self._reader.messages(self._topics('particles', PointCloud2)):
            cloud = unpacked(message.data, PointCloud2)
            table = np.frombuffer(cloud.data, np.float32).reshape(-1, cloud.point_step // 4)
            yield message.frame, message.topic, table[:, :3]

    def _topics(self, name: str, kind: type) -> list[str]:
        return [topic for topic, about in self._reader.topics.items()
                if last_part(topic) == name and about.type == type_name(kind)]

    def _commands(self) -> dict[int, list[Command]]:
        inputs = {topic: INPUTS[last_part(topic)] for topic, about in self._reader.topics.items()
                  if is_recorded_input(topic, about.type)}
        found: dict[int, list[Command]] = {}
        for message in self._reader.messages(inputs):
            about = inputs[message.topic]
            try:
                commands = about.read(unpacked(message.data, about.kind),
                                      self.scene.top.frame_id)
            except InputError as error:
                raise InputError(f'{self.path}: {message.topic}, frame {message.frame}: '
                                 f'{error}') from error
            found.setdefault(message.frame, []).extend(commands)
        return found


def last_part(topic: str) -> str:
    """Return a topic without what it is below."""
    return topic.rsplit('/', 1)[-1]


def is_recorded_input(topic: str, kind: str) -> bool:
    """Return whether a topic of this type is one that a log has inputs on."""
    return last_part(topic) in INPUTS and type_name(INPUTS[last_part(topic)].kind) == kind


def is_input(topic: str, kind: str) -> bool:
    """Return whether a node that listens to a topic of this type would take it as an input."""
    return is_recorded_input(topic, kind) or (
        kind == 'geometry_msgs/msg/PoseStamped' and COLLIDER.search(topic) is not None)
