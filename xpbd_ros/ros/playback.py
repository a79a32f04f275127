"""The inputs of a log as commands again, by the frame that they acted on."""

from collections.abc import Callable

from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader
from xpbd_ros.ros.inputs import READERS, unpacked
from xpbd_ros.ros.recorder import type_name
from xpbd_ros.scene.load import parse_yaml
from xpbd_ros.sim.commands import Command


def commands_by_frame(run: str, tell: Callable[[str], None] = lambda text: None
                      ) -> dict[int, list[Command]]:
    """
    Return what a log's inputs asked for, in order.

    Parameters
    ----------
    run : the log
    tell : is given each damage of the log, whose inputs may then lack some

    Raises
    ------
    InputError : not a log, or a log whose inputs do not start with its scene

    """
    reader = LogReader(run)
    if reader.scene is None:
        raise InputError(f'{reader.path}: is not a log of xpbd_ros: it holds no scene')
    scene = parse_yaml(reader.scene, f'{reader.path}: scene')
    frame_id = scene.get('frame_id', 'world') if isinstance(scene, dict) else 'world'
    for text in reader.damage:
        tell(text)
    inputs = {}
    for topic, about in reader.topics.items():
        kind, read = READERS.get(topic.rsplit('/', 1)[-1], (None, None))
        if kind is not None and type_name(kind) == about.type:
            inputs[topic] = kind, read
    found: dict[int, list[Command]] = {}
    for message in reader.messages(inputs):
        kind, read = inputs[message.topic]
        try:
            commands = read(unpacked(message.data, kind), frame_id)
        except InputError as error:
            raise InputError(f'{run}: {message.topic}, frame {message.frame}: '
                             f'{error}') from error
        found.setdefault(message.frame, []).extend(commands)
    return found
