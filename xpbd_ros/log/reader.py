"""
Read a log, also one that was cut short or damaged.

Opening a log reads it once and checks every checksum, so that its content and its damage are known
before use. Only the positions of the messages stay in memory.
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
    """Number of readable messages."""
    qos: Qos
    """Quality of service that a replay offers."""
    encoding: str
    """Encoding of the messages: cdr in any log of ROS 2."""
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
    A log, open for reading.

    Parameters
    ----------
    path
        Folder of a run with one .mcap file, or such a file.

    Attributes
    ----------
    path : Path
        The .mcap file.
    topics : dict of Topic
        Topics by name.
    settings : dict of str
        Metadata of the run: program, version, mode.
    attachments : dict of bytes
        Attachments by name.
    scene : str or None
        YAML text of the scene; None if the log has none.
    start_ns, end_ns : int or None
        Times of the first and the last message [ns]; None without messages.
    frames : int
        Number of different frames that have messages.
    damage : list of str
        Descriptions of all damage; empty if the log is whole.
    lossy : bool
        Whether completely written messages are lost; false if only the end of the log is missing.

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
        """True if the log is complete and all checksums match."""
        return not self.damage

    @property
    def scene(self) -> str | None:
        """YAML text of the scene; None if the log has none."""
        text = self.attachments.get(SCENE)
        return None if text is None else text.decode(errors='replace')

    @property
    def count(self) -> int:
        """Number of readable messages."""
        return sum(topic.count for topic in self.topics.values())

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Yield the messages of these topics (None: all), in file order."""
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
        """Yield the bodies of the messages in a span, which was intact when the log was opened."""
        file.seek(span.start)
        body = file.read(span.length)
        if span.opcode == Opcode.MESSAGE:
            yield memoryview(body)
            return
        try:
            records = decompressed(body)
        except Exception:
            raise InputError(f'{self.path}: the file changed while it was read') from None
        yield from (body for opcode, body in pieces(records) if opcode == Opcode.MESSAGE)

    def _add_topic(self, channel: Channel, count: int) -> None:
        """Add a channel to its topic; a topic may have several, one per publisher."""
        if channel.topic in self.topics:
            count += self.topics[channel.topic].count
        schema = self._types[channel.id]
        self.topics[channel.topic] = Topic(
            schema.name, count, recorded_qos(channel.metadata.get('offered_qos_profiles', '')),
            channel.message_encoding, schema.data.decode(errors='replace'),
            channel.metadata.get('topic_type_hash', ''))


def log_file(path: Path) -> Path:
    """Return the .mcap file at a path: the file itself, or the only one in a folder."""
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
