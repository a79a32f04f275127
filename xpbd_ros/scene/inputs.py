"""
The section ``inputs``: topics of other programs that move pins and colliders.

A pin or collider that an input names follows the poses on that topic as others follow a TF frame,
so all that holds for TF frames holds for it: its key ``frame`` becomes ``topic:NAME``, with
``:JOINT`` behind it where the messages hold the poses of several joints. An input with ``frame``
is about a topic of TF, and is the same as that key of the pin or collider.
"""

from dataclasses import dataclass
from pathlib import PurePosixPath
import re

from xpbd_ros.errors import InputError
from xpbd_ros.scene.frames import topic_frame
from xpbd_ros.scene.read import mapping, read, unknown
from xpbd_ros.sim.parameters import quantity

TOPIC = re.compile(r'/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', re.ASCII)


@dataclass(frozen=True)
class Input:
    """One entry of ``inputs``, or of the list that stands there."""

    pin: str | None = quantity(None, doc='pin that the topic moves')
    collider: str | None = quantity(None, doc='or collider')
    joint: str | None = quantity(None, doc='name of its pose in a MultiDOF message')
    frame: str | None = quantity(None, doc='its TF frame, where the topic is one of TF')
    position: tuple[float, float, float] = quantity(
        (0.0, 0.0, 0.0), unit='m', doc='offset in the pose of the topic')
    orientation: tuple[float, float, float, float] = quantity(
        (0.0, 0.0, 0.0, 1.0), doc='offset, a quaternion x y z w')
    frame_timeout: float | None = quantity(None, unit='s', above=0.0, doc=(
        'silence after which a pin releases, and a collider is reported; 1 s unless given'))

    def __post_init__(self):
        """Require a pin or a collider, and at most one name of a pose."""
        if (self.pin is None) == (self.collider is None):
            raise InputError("needs either 'pin' or 'collider', and only one of them")
        if self.joint is not None and self.frame is not None:
            raise InputError("needs either 'joint' or 'frame', not both")

    @property
    def section(self) -> str:
        """Section of the scene with the moved part."""
        return 'pins' if self.collider is None else 'colliders'

    @property
    def name(self) -> str:
        """Name of the moved pin or collider."""
        return self.pin or self.collider or ''


def with_inputs(raw: dict) -> tuple[dict, dict[str, tuple[Input, ...]]]:
    """Return a scene's mapping with followers in place of its inputs, and the inputs by topic."""
    inputs: dict[str, tuple[Input, ...]] = {}
    for topic, value in mapping(raw['inputs'], 'inputs').items():
        path = f'inputs.{topic}'
        if not isinstance(topic, str) or not TOPIC.fullmatch(topic):
            raise InputError(f'{path}: is not the name of a topic, such as /tool_pose')
        entries = value if isinstance(value, list) else [value]
        found = tuple(read(Input, entry, f'{path}[{k}]' if value is entries else path)
                      for k, entry in enumerate(entries))
        inputs[str(PurePosixPath('/') / topic)] = found
    raw = {key: value for key, value in raw.items() if key != 'inputs'}
    for topic, entries in inputs.items():
        for entry in entries:
            parts = mapping(raw.get(entry.section), entry.section)
            raw = {**raw, entry.section: {**parts, entry.name: _following(topic, entry, parts)}}
    return raw, inputs


def _following(topic: str, entry: Input, parts: dict) -> dict:
    """Return the mapping of a pin or collider that follows a topic."""
    path, kind = f'inputs.{topic}', entry.section.removesuffix('s')
    if entry.name not in parts:
        raise InputError(f'{path}.{kind}: ' + (
            unknown(entry.name, parts, kind) if parts else f'the scene has no {entry.section}'))
    given = mapping(parts[entry.name], f'{entry.section}.{entry.name}')
    for key in ('frame', 'motion', 'target'):
        if key in given:
            raise InputError(f"{path}: {entry.section}.{entry.name} has '{key}' already, and "
                             'follows one thing only')
    found = {**given, 'frame': entry.frame or topic_frame(topic, entry.joint),
             'position': list(entry.position), 'orientation': list(entry.orientation)}
    if entry.frame_timeout is not None:
        found['frame_timeout'] = entry.frame_timeout
    if entry.collider is not None:
        start = {key: given[key] for key in ('position', 'orientation') if key in given}
        if start:
            found['start'] = start
    return found
