"""
Scan an MCAP file once: check all checksums and index the intact messages.

Damage raises no error: readable records are indexed, and unreadable ones are described.
"""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
import re
import shlex
import struct
from typing import BinaryIO, NamedTuple, Protocol
import zlib

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Metadata, Schema
from mcap.stream_reader import CRCValidationError

from xpbd_ros.errors import counted, InputError
from xpbd_ros.log.records import HEAD, MAGIC, parse, pieces, read_summary, Summary
from xpbd_ros.log.resync import CHUNK_HEAD, decompressed, descriptions, UNCOMPRESSED
from xpbd_ros.log.walk import Record, walk

TOPIC, TYPE = re.compile(r'[~/\w]+'), re.compile(r'\w+/msg/\w+')
MESSAGE = struct.Struct('<HIQQ')    # channel, sequence, log time, publish time; then the data
ZSTD = b'\x28\xb5\x2f\xfd'    # magic bytes of a Zstandard frame
SURE_MAGIC = 4    # right bytes of the eight at its start by which a file is known
MOST_PLACES = 20    # damaged ranges that are listed one by one


class Described(Protocol):
    """Something with schemas and channels by number."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]


class Span(NamedTuple):
    """A range of the file with intact messages: a chunk, or a message outside of chunks."""

    opcode: int
    start: int
    """Offset of the body [bytes]."""
    length: int
    """Length of the body [bytes]."""
    channels: frozenset[int]
    """Numbers of the channels that have messages in it."""


class Scan:
    """
    The result of a scan.

    Parameters
    ----------
    file
        The file, open for reading.
    path
        Its path, for error messages.
    unchecked
        Whether to take the messages of uncompressed chunks with a wrong checksum too.

    Attributes
    ----------
    spans : list of Span
        Positions of the messages, in file order.
    counts : Counter
        Number of messages by channel.
    frames : set of int
        Sequence numbers of the messages, which are frames.
    start_ns, end_ns : int or None
        First and last log time [ns]; None without messages.
    schemas, channels : dict
        Schemas and channels by number.
    metadata : dict of dict
        Metadata records by name.
    attachments : dict of bytes
        Attachments by name.
    lossy : bool
        Whether completely written messages are lost; false if only the end of the file is missing.

    """

    def __init__(self, file: BinaryIO, path: object, *, unchecked: bool):
        self.spans: list[Span] = []
        self.counts: Counter[int] = Counter()
        self.frames: set[int] = set()
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.lossy = False
        self._unchecked = unchecked
        self._doubtful = Summary()    # schemas and channels in damaged chunks
        self._places: list[str] = []    # damaged ranges of the file
        self._lacks: list[str] = []     # damage of the log as a whole
        self._data_ended = False
        size = file.seek(0, 2)
        file.seek(0)
        magic = file.read(len(MAGIC))
        if size < len(MAGIC) and MAGIC.startswith(magic):
            raise InputError(f'{path}: is empty')
        if magic.startswith(ZSTD):
            raise compressed(Path(str(path)))
        if sum(map(int.__eq__, magic, MAGIC)) < SURE_MAGIC:
            raise InputError(f'{path}: is not an MCAP file')
        if magic != MAGIC:
            self._lacks.append('the magic bytes at its start are damaged')
        self._crc = zlib.crc32(MAGIC)
        summary = read_summary(file, size)
        end = self._read(file, size, summary)
        if end is None:
            self._lacks.append('it has no end: the writer was killed, or is still recording')
            loose = sum(span.opcode == Opcode.MESSAGE for span in self.spans)
            if loose and not unchecked:
                self._lacks.append(f'no checksum covers {counted(loose, "message")} of its last '
                                   'chunk, which is incomplete')
        else:
            summary = self._check_end(file, size, end) or summary
        self._compare(summary or Summary())

    @property
    def damage(self) -> list[str]:
        """Descriptions of all damage; empty if the log is whole."""
        more = len(self._places) - MOST_PLACES
        return [*self._places[:MOST_PLACES], *[f'{more} more ranges are damaged'] * (more > 0),
                *self._lacks]

    def _read(self, file: BinaryIO, size: int, summary: Summary | None) -> int | None:
        """Read all records; return the offset behind the footer [bytes], or None without one."""
        def lost(start: int, end: int) -> None:
            self._places.append(f'bytes {start} to {end} are unreadable: ' + (
                'no whole record' if end == size else 'a record is damaged'))
            self.lossy |= end != size

        starts = [start for start in (summary.starts if summary else ()) if start < size]
        for record in walk(file, [*starts, size], lost):
            if HEAD.unpack(record.head) != (record.opcode, len(record.body)):
                self._places.append(f'bytes {record.start} to {record.start + HEAD.size} are '
                                    'damaged: the head of a chunk that is whole')
            try:
                self._take(record)
            except Exception as error:    # a parser may raise anything on arbitrary bytes
                taken = self._take_damaged(record) if record.opcode == Opcode.CHUNK else 0
                self._places.append(
                    f'bytes {record.start} to {record.end} are unreadable: '
                    f'{title(record.opcode)} is damaged ({reason(error)})' +
                    f'; {counted(taken, "message")} in it taken unchecked' * bool(taken))
                self.lossy = True
            self._crc = zlib.crc32(record.body, zlib.crc32(record.head, self._crc))
            if record.opcode == Opcode.FOOTER:
                return record.end
        return None

    def _take(self, record: Record) -> None:
        """Index a record of the file's data section."""
        if self._data_ended:
            return    # a record of the summary section, which ``read_summary`` reads
        if record.opcode == Opcode.CHUNK:
            self._take_messages(record, pieces(decompressed(record.body)))
        elif record.opcode == Opcode.MESSAGE:
            self._take_messages(record, [(record.opcode, memoryview(record.body))])
        elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._take_description(record.opcode, record.body, self)
        elif record.opcode == Opcode.METADATA:
            metadata = parse(Metadata, record.body)
            self.metadata[metadata.name] = metadata.metadata
        elif record.opcode == Opcode.ATTACHMENT:
            attachment = parse(Attachment, record.body)
            crc = int.from_bytes(record.body[-4:], 'little')
            if crc and crc != zlib.crc32(record.body[:-4]):
                raise ValueError('its checksum is wrong')
            self.attachments[attachment.name] = attachment.data
        elif record.opcode == Opcode.DATA_END:
            self._data_ended = True
            crc = parse(DataEnd, record.body).data_section_crc
            if crc and crc != self._crc and not self._places:
                self._lacks.append('the checksum over the whole file is wrong')

    def _take_messages(self, record: Record, found: Iterable[tuple[int, memoryview]]) -> None:
        """Index the messages of a record, and the schemas and channels among them."""
        found = list(found)
        messages = [MESSAGE.unpack_from(body) for opcode, body in found
                    if opcode == Opcode.MESSAGE]
        for opcode, body in found:
            self._take_description(opcode, body, self)
        counts = Counter(channel for channel, _, _, _ in messages)
        self.counts.update(counts)
        self.spans.append(Span(record.opcode, record.start + len(record.head), len(record.body),
                               frozenset(counts)))
        self.frames.update(frame for _, frame, _, _ in messages)
        times = [time for _, _, time, _ in messages]
        if times:
            self.start_ns = min(times + [self.start_ns] * (self.start_ns is not None))
            self.end_ns = max(times + [self.end_ns] * (self.end_ns is not None))

    def _take_damaged(self, chunk: Record) -> int:
        """Take topics, and on request messages, of a damaged chunk; return their number."""
        count, at = 0, chunk.start + UNCOMPRESSED
        records = chunk.body[UNCOMPRESSED - HEAD.size:]
        try:
            if CHUNK_HEAD.unpack_from(chunk.body)[-1]:
                return 0    # compressed
            for opcode, body in descriptions(records):
                self._take_description(opcode, body, self._doubtful)
            for opcode, view in pieces(records) if self._unchecked else ():
                at += HEAD.size
                if opcode == Opcode.MESSAGE:
                    self._take_messages(Record(opcode, at, b'', bytes(view)), [(opcode, view)])
                    count += 1
                at += len(view)
        except Exception:    # a parser may raise anything on arbitrary bytes
            pass
        return count

    def _take_description(self, opcode: int, body: bytes | memoryview, to: Described) -> None:
        """Keep a schema or channel, if it is the first one of its number."""
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema, body)
            to.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = parse(Channel, body)
            to.channels.setdefault(channel.id, channel)

    def _check_end(self, file: BinaryIO, size: int, end: int) -> Summary | None:
        """Check the end of the file, from the footer's end at ``end`` on; return the summary."""
        file.seek(end)
        if file.read(len(MAGIC)) != MAGIC:
            self._lacks.append('the magic bytes at its end are missing or damaged')
            return None
        end += len(MAGIC)
        if file.read(len(MAGIC)) == MAGIC:
            self._lacks.append(f'another log follows from byte {end} on, which is ignored; split '
                               'the file there')
            self.lossy = True
        elif size > end:
            self._lacks.append(f'{counted(size - end, "byte")} after its end ignored')
        summary = read_summary(file, end)
        if summary is None:
            self._lacks.append('the summary before its end is damaged')
        return summary

    def _use_doubtful(self) -> list[str]:
        """Take lost descriptions from damaged chunks; return the topics."""
        found = []
        for number in self.counts.keys() - self.channels.keys():
            channel = self._doubtful.channels.get(number)
            schema = None if channel is None else self.schemas.get(
                channel.schema_id, self._doubtful.schemas.get(channel.schema_id))
            if channel and schema and is_plausible(channel, schema):
                self.channels[number], self.schemas[channel.schema_id] = channel, schema
                found.append(channel.topic)
        return sorted(found)

    def _compare(self, summary: Summary) -> None:
        """Compare the counts with the summary's; take lost schemas and channels from it."""
        self.schemas = {**summary.schemas, **self.schemas}
        self.channels = {**summary.channels, **self.channels}
        doubtful = self._use_doubtful()
        if doubtful:
            self._lacks.append(f'the description of {", ".join(doubtful)} is from a damaged chunk')
        nameless = sum(count for channel, count in self.counts.items()
                       if channel not in self.channels)
        if nameless:
            self._lacks.append(f'{counted(nameless, "message")} of topics whose description is '
                               'lost')
            self.lossy = True
        if summary.statistics:
            count = summary.statistics.message_count
            lost = count - self.counts.total()
            if lost:
                self._lacks.append(f'{lost} of {count} messages are lost')
                self.lossy = True


def is_plausible(channel: Channel, schema: Schema) -> bool:
    """Return whether a description from a damaged chunk has names of a topic and a type."""
    return bool(TOPIC.fullmatch(channel.topic) and TYPE.fullmatch(schema.name))


def compressed(path: Path) -> InputError:
    """Return the error of a file that rosbag2 or a user has compressed as a whole."""
    name = path.name.removesuffix('.zstd').removesuffix('.zst')
    plain = path.with_name(name if name != path.name else f'decompressed_{name}')
    return InputError(f'{path}: is compressed as a whole; decompress it first: zstd -d '
                      f'{shlex.quote(str(path))} -o {shlex.quote(str(plain))}')


def title(opcode: int) -> str:
    """Return the name of a kind of record, such as 'the chunk'."""
    return f'the {Opcode(opcode).name.lower().replace("_", " ")}'


def reason(error: Exception) -> str:
    """Return the text of an error, shortened for wrong checksums."""
    if isinstance(error, CRCValidationError):
        return 'its checksum is wrong'
    return str(error) or type(error).__name__
