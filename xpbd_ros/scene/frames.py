"""The pins and colliders of a scene that follow TF frames, or topics in place of one."""

from dataclasses import dataclass

from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import Pose

TIMEOUT = 1.0
"""``frame_timeout`` unless given [s]"""
PREFIX = 'topic:'
"""of a ``frame`` that stands for a topic; TF frames do not begin with it"""


def topic_frame(topic: str, joint: str | None) -> str:
    """Return the ``frame`` that stands for a topic, and for one joint of its messages."""
    return f'{PREFIX}{topic}' if joint is None else f'{PREFIX}{topic}:{joint}'


def topic_of_frame(frame: str) -> tuple[str, str | None] | None:
    """Return the topic, and the joint if one is named, that a ``frame`` stands for, or None."""
    if not frame.startswith(PREFIX):
        return None
    topic, colon, joint = frame.removeprefix(PREFIX).partition(':')
    return topic, joint if colon else None


@dataclass(frozen=True)
class Follower:
    """A pin or collider that follows a TF frame."""

    section: str
    """'pins' or 'colliders'"""
    name: str
    frame: str
    offset: Pose
    """pose in that frame"""
    timeout: float
    """``frame_timeout`` [s]"""
    radius: float = 0.0
    """of the grasp after a silence; of a pin only [m]"""

    @property
    def path(self) -> str:
        """Key of its frame, in the scene file."""
        topic = topic_of_frame(self.frame)
        return f'{self.section}.{self.name}.frame' if topic is None else f'inputs.{topic[0]}'


def followers(scene: Scene) -> list[Follower]:
    """Return the pins and colliders of a scene that follow TF frames or topics."""
    found = []
    for section in ('pins', 'colliders'):
        for name, entry in scene.sections.get(section, {}).items():
            if entry.frame is not None:
                pin = section == 'pins'
                found.append(Follower(
                    section, name, entry.frame, entry.offset,
                    TIMEOUT if entry.frame_timeout is None else entry.frame_timeout,
                    entry.radius if pin else 0.0))
    return found


def notes_without_tf(scene: Scene) -> list[str]:
    """Return notes for a run without a node on the parts that would follow TF or topics."""
    found = {section: [f'{each.name} ({each.frame})' for each in followers(scene)
                       if each.section == section] for section in ('pins', 'colliders')}
    texts = {'pins': 'stay where they hold', 'colliders': 'stay where they start'}
    return [f'{section}: no TF and no topics here, so {", ".join(names)} {texts[section]}, '
            'unless commands of a log move them' for section, names in found.items() if names]
