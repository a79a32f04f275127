"""
Walk through the records of an MCAP file, whole or not.

A record is an opcode, a length and a body, so one length that is wrong hides all that follows. An
intact summary at the end of the file helps: its indexes say where chunks, attachments and metadata
begin, and the walk goes on at the next of them. Without one (a log cut short has none) the walk
ends at the first record that is not whole.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
import struct
from typing import BinaryIO, NamedTuple, TypeVar
import zlib

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
)

MAGIC = b'\x89MCAP0\r\n'
HEAD = struct.Struct('<BQ')
FOOTER = struct.Struct('<BQQQI')    # with its head; summary start, summary offset start, checksum
FOOT = FOOTER.size + len(MAGIC)     # bytes at the end of a whole file

Parsed = TypeVar('Parsed', bound=McapRecord)


class Record(NamedTuple):
    """A record of the file, and where it lies."""

    opcode: int
    start: int
    """Offset of its head (bytes)."""
    head: bytes
    body: bytes

    @property
    def end(self) -> int:
        """Offset of what follows it (bytes)."""
        return self.start + len(self.head) + len(self.body)


@dataclass
class Summary:
    """What an intact summary says."""

    statistics: Statistics | None = None
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    starts: list[int] = field(default_factory=list)
    """Offsets at which a record begins, ascending (bytes)."""


def parse(record: type[Parsed], body: bytes | memoryview) -> Parsed:
    """Return the record that a body holds."""
    return record.read(ReadDataStream(BytesIO(body)))


def walk(file: BinaryIO, starts: list[int], lost: Callable[[int, int], None]) -> Iterator[Record]:
    """
    Yield the records of a file, from behind its first magic to its footer.

    Parameters
    ----------
    file
        Open for reading.
    starts
        Offsets at which a record is known to begin, and the file's length, ascending.
    lost
        Told from which byte up to which one nothing can be made out.

    """
    at, known = len(MAGIC), 0
    while at < starts[-1]:
        while starts[known] <= at:
            known += 1
        file.seek(at)
        head = file.read(HEAD.size)
        opcode, length = HEAD.unpack(head.ljust(HEAD.size, b'\0'))
        if not is_opcode(opcode) or at + HEAD.size + length > starts[known]:
            lost(at, starts[known])
            at = starts[known]
            continue
        record = Record(opcode, at, head, file.read(length))
        yield record
        if opcode == Opcode.FOOTER:
            return
        at = record.end


def is_opcode(number: int) -> bool:
    """Return whether a record may begin with this byte; the upper half is for private records."""
    return 0 < number <= max(Opcode) or number >= 0x80


def pieces(data: bytes) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and body of the records in a chunk or a summary; raise if the last is cut."""
    view, at = memoryview(data), 0
    while at < len(view):
        opcode, length = HEAD.unpack_from(view, at)
        at += HEAD.size
        if at + length > len(view):
            raise ValueError('a record in it is cut off')
        yield opcode, view[at:at + length]
        at += length


def read_summary(file: BinaryIO, size: int) -> Summary | None:
    """Return the summary that the first ``size`` bytes end with; None if it is not intact."""
    if size < FOOT:
        return None
    file.seek(size - FOOT)
    foot = file.read(FOOT)
    opcode, length, start, _, crc = FOOTER.unpack_from(foot)
    if (not foot.endswith(MAGIC) or opcode != Opcode.FOOTER
            or length != FOOTER.size - HEAD.size or start > size - FOOT):
        return None
    if start == 0:
        return Summary()
    file.seek(start)
    data = file.read(size - FOOT - start)
    if crc and zlib.crc32(foot[:FOOTER.size - 4], zlib.crc32(data)) != crc:
        return None
    summary = Summary(starts=[start])
    try:
        for opcode, body in pieces(data):
            note(summary, opcode, body)
    except Exception:    # whatever untrusted bytes do to a parser
        return None
    summary.starts.sort()
    return summary


def note(summary: Summary, opcode: int, body: memoryview) -> None:
    """Add what a record of the summary section says."""
    if opcode == Opcode.STATISTICS:
        summary.statistics = parse(Statistics, body)
    elif opcode == Opcode.SCHEMA:
        schema = parse(Schema, body)
        summary.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = parse(Channel, body)
        summary.channels[channel.id] = channel
    elif opcode == Opcode.CHUNK_INDEX:
        summary.starts.append(parse(ChunkIndex, body).chunk_start_offset)
    elif opcode == Opcode.ATTACHMENT_INDEX:
        summary.starts.append(parse(AttachmentIndex, body).offset)
    elif opcode == Opcode.METADATA_INDEX:
        summary.starts.append(parse(MetadataIndex, body).offset)
