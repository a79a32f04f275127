"""
Read a log, also one that was cut short or damaged.

Opening it reads all of it once and checks every checksum, so that what it holds and whether it is
whole are known before anything is made of it; nothing stays in memory but where the messages lie.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from xpbd_ros.errors import InputError
from xpbd_ros.log.qos import Qos, recorded_qos
from xpbd_ros.log.records import pieces
from xpbd_ros.log.scan import decompressed, MESSAGE, Scan, Span
from xpbd_ros.log.writer import METADATA, SCENE

NO_SCHEMA = Schema(id=0, data=b'', encoding='', name='')


@dataclass(frozen=True)
class Topic:
    """A topic that a log holds."""

    type: str
    """package/msg/Type"""
    count: int
    """Messages that can be read."""
    qos: Qos
    """What a replay offers."""
    encoding: str
    """Of the data: cdr in any log of ROS 2."""
    definition: str
    """Text of the schema."""
    type_hash: str
    """RIHS01 hash of the type; empty if none was recorded."""


class Message(NamedTuple):
    """A message as it was recorded."""

    topic: str
    type: str
    time_ns: int
    frame: int
    data: bytes


class LogReader:
    """
    What a log holds.

    Parameters
    ----------
    path
        The folder of a run, which holds one .mcap file, or such a file.

    Attributes
    ----------
    path : Path
        The file.
    topics : dict of Topic
        By name.
    settings : dict of str
        What the run depended on, and the version that recorded it.
    attachments : dict of bytes
        By name.
    scene : str or None
        The scene's YAML text, if the log has one.
    start_ns, end_ns : int or None
        Times of the first and the last message (ns).
    frames : int
        How many frames the messages are of.
    damage : list of str
        What is missing or wrong, in words; empty if the log is whole.
    lossy : bool
        Whether something is lost that was written whole; a log whose end is missing is not lossy.

    """

    def __init__(self, path: Path | str):
        self.path = log_file(Path(path).absolute())
        try:
            with open(self.path, 'rb') as file:
                scan = Scan(file, self.path)
        except OSError as error:
            raise InputError(f'{self.path}: cannot be read: {error.strerror}') from None
        self._spans = scan.spans
        self._channels = scan.channels
        self._types = {number: scan.schemas.get(channel.schema_id, NO_SCHEMA)
                       for number, channel in scan.channels.items()}
        self.topics: dict[str, Topic] = {}
        for number in scan.channels:
            self._add_topic(scan.channels[number], scan.counts[number])
        self.settings = scan.metadata.get(METADATA, {})
        self.attachments = scan.attachments
        self.start_ns = scan.start_ns
        self.end_ns = scan.end_ns
        self.frames = len(scan.frames)
        self.damage = scan.damage
        self.lossy = scan.lossy

    @property
    def whole(self) -> bool:
        """Whether nothing is missing and every checksum is right."""
        return not self.damage

    @property
    def scene(self) -> str | None:
        """The scene's YAML text, if the log has one."""
        text = self.attachments.get(SCENE)
        return None if text is None else text.decode(errors='replace')

    @property
    def count(self) -> int:
        """How many messages can be read."""
        return sum(topic.count for topic in self.topics.values())

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Yield the messages of these topics, or of all, in the order of the file."""
        wanted = {number: (channel.topic, self._types[number].name)
                  for number, channel in self._channels.items()
                  if topics is None or channel.topic in topics}
        with open(self.path, 'rb') as file:
            for span in self._spans:
                if span.channels.isdisjoint(wanted):
                    continue
                for body in self._bodies(file, span):
                    number, frame, time_ns, _ = MESSAGE.unpack_from(body)
                    if number in wanted:
                        yield Message(*wanted[number], time_ns, frame, bytes(body[MESSAGE.size:]))

    def _bodies(self, file: BinaryIO, span: Span) -> Iterator[memoryview]:
        """Yield the bodies of the messages in a span, which was good when the log was opened."""
        file.seek(span.start)
        body = file.read(span.length)
        if span.opcode == Opcode.MESSAGE:
            yield memoryview(body)
            return
        try:
            records = decompressed(body)
        except Exception:
            raise InputError(f'{self.path}: was changed while it was read') from None
        yield from (body for opcode, body in pieces(records) if opcode == Opcode.MESSAGE)

    def _add_topic(self, channel: Channel, count: int) -> None:
        """Add a channel to its topic; a topic may have several, one for each publisher."""
        if channel.topic in self.topics:
            count += self.topics[channel.topic].count
        schema = self._types[channel.id]
        self.topics[channel.topic] = Topic(
            schema.name, count, recorded_qos(channel.metadata.get('offered_qos_profiles', '')),
            channel.message_encoding, schema.data.decode(errors='replace'),
            channel.metadata.get('topic_type_hash', ''))


def log_file(path: Path) -> Path:
    """Return the .mcap file that a path stands for."""
    if not path.exists():
        raise InputError(f'{path}: no such file or folder')
    if not path.is_dir():
        return path
    found = sorted(path.glob('*.mcap'))
    if not found:
        raise InputError(f'{path}: holds no .mcap file')
    if len(found) > 1:
        raise InputError(f'{path}: holds several .mcap files; name one of '
                         f'{", ".join(file.name for file in found)}')
    return found[0]
