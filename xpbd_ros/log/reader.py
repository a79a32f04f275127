"""
Read a log, also one that was cut short or damaged.

Opening a log reads it once and checks every checksum, so that its content and its damage are known
before use. Only the positions of the messages stay in memory.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
import re
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from xpbd_ros.errors import InputError
from xpbd_ros.log.qos import Qos, recorded_qos
from xpbd_ros.log.records import pieces
from xpbd_ros.log.resync import decompressed
from xpbd_ros.log.scan import compressed, MESSAGE, Scan, Span
from xpbd_ros.log.writer import METADATA, SCENE

SPLIT = re.compile(r'(.*)_(0|[1-9]\d*)')
"""name of a file of a split log: that of the log, and a number"""
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
        Folder of a run with its .mcap files, or one of these.
    unchecked
        Whether to read the messages of damaged chunks too, at least one of which is wrong.

    Attributes
    ----------
    path : Path
        The .mcap file; the folder of several.
    size : int
        Length of all files [bytes].
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

    def __init__(self, path: Path | str, *, unchecked: bool = False):
        files, missing = log_files(Path(path).absolute())
        self.path = files[0] if len(files) == 1 else files[0].parent
        self._parts = [(file, scanned(file, unchecked)) for file in files]
        scans = [scan for _, scan in self._parts]
        self.topics: dict[str, Topic] = {}
        for scan in scans:
            for number, channel in scan.channels.items():
                self._add_topic(channel, scan.schemas.get(channel.schema_id, NO_SCHEMA),
                                scan.counts[number])
        self.settings = scans[0].metadata.get(METADATA, {})
        self.attachments = {name: data for scan in reversed(scans)
                            for name, data in scan.attachments.items()}
        self.start_ns = min((scan.start_ns for scan in scans if scan.start_ns is not None),
                            default=None)
        self.end_ns = max((scan.end_ns for scan in scans if scan.end_ns is not None),
                          default=None)
        self.frames = len(set().union(*(scan.frames for scan in scans)))
        self.damage = [f'{name}: the file is missing' for name in missing] + [
            text if len(files) == 1 else f'{file.name}: {text}'
            for file, scan in self._parts for text in scan.damage]
        self.lossy = bool(missing) or any(scan.lossy for scan in scans)
        self.size = sum(file.stat().st_size for file in files)

    @property
    def whole(self) -> bool:
        """True if the log is complete and all checksums match."""
        return not self.damage

    @property
    def scene(self) -> str | None:
        """YAML text of the scene; None if the log has none."""
        if SCENE in self.attachments:
            return self.attachments[SCENE].decode(errors='replace')
        return self._parts[0][1].metadata.get(SCENE, {}).get('yaml')

    @property
    def count(self) -> int:
        """Number of readable messages."""
        return sum(topic.count for topic in self.topics.values())

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Yield the messages of these topics (None: all), in file order."""
        for path, scan in self._parts:
            wanted = {number: (channel.topic, self.topics[channel.topic].type)
                      for number, channel in scan.channels.items()
                      if topics is None or channel.topic in topics}
            with open(path, 'rb') as file:
                for span in scan.spans:
                    if span.channels.isdisjoint(wanted):
                        continue
                    for body in self._bodies(file, span):
                        number, frame, time_ns, _ = MESSAGE.unpack_from(body)
                        if number in wanted:
                            yield Message(*wanted[number], time_ns, frame,
                                          bytes(body[MESSAGE.size:]))

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
            raise InputError(f'{file.name}: the file changed while it was read') from None
        yield from (body for opcode, body in pieces(records) if opcode == Opcode.MESSAGE)

    def _add_topic(self, channel: Channel, schema: Schema, count: int) -> None:
        """Add a channel to its topic; a topic has one for each publisher and file."""
        if channel.topic in self.topics:
            count += self.topics[channel.topic].count
        self.topics[channel.topic] = Topic(
            schema.name, count, recorded_qos(channel.metadata.get('offered_qos_profiles', '')),
            channel.message_encoding, schema.data.decode(errors='replace'),
            channel.metadata.get('topic_type_hash', ''))


def scanned(path: Path, unchecked: bool) -> Scan:
    """Return the scan of a file; raise InputError if it cannot be read."""
    try:
        with open(path, 'rb') as file:
            return Scan(file, path, unchecked=unchecked)
    except OSError as error:
        raise InputError(f'{path}: cannot be read: {error.strerror}') from None


def log_files(path: Path) -> tuple[list[Path], list[str]]:
    """
    Return the .mcap files at a path, in order, and the names of files that are missing.

    The path is a file, or a folder with one file, or with the files NAME_0, NAME_1 … of a split
    log. Only those of a number below the highest can be known to be missing.
    """
    if not path.exists():
        raise InputError(f'{path}: no such file or folder')
    if path.is_file():
        return [path], []
    if not path.is_dir():    # opening a pipe would wait for a writer
        raise InputError(f'{path}: is neither a file nor a folder')
    found = sorted(path.glob('*.mcap'))
    if not found:
        for file in sorted(path.glob('*.mcap.zst*')):
            raise compressed(file)
        raise InputError(f'{path}: holds no .mcap file')
    if len(found) == 1:
        return found, []
    parts = {match[2]: match[1] for file in found if (match := SPLIT.fullmatch(file.stem))}
    if len(parts) != len(found) or len(set(parts.values())) > 1:
        raise InputError(f'{path}: holds several .mcap files; name one of '
                         f'{", ".join(file.name for file in found)}')
    name, numbers = next(iter(parts.values())), sorted(map(int, parts))
    return ([path / f'{name}_{number}.mcap' for number in numbers],
            [f'{name}_{number}.mcap' for number in range(numbers[-1]) if number not in numbers])
