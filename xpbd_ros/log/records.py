"""Records of an MCAP file: opcode, length and body; and the summary at its end."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
import struct
from typing import BinaryIO, TypeVar
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
FOOTER = struct.Struct('<BQQQI')    # opcode, length, summary start, offset section start, checksum
FOOT = FOOTER.size + len(MAGIC)     # length of the end of a whole file [bytes]

Parsed = TypeVar('Parsed', bound=McapRecord)


@dataclass
class Summary:
    """Content of an intact summary section."""

    statistics: Statistics | None = None
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    starts: list[int] = field(default_factory=list)
    """Offsets at which indexed records begin, ascending [bytes]."""


def parse(record: type[Parsed], body: bytes | memoryview) -> Parsed:
    """Parse the body of a record of a given type."""
    return record.read(ReadDataStream(BytesIO(body)))  # type: ignore[attr-defined]


def is_opcode(number: int) -> bool:
    """Return whether this byte is a valid opcode; those from 0x80 on are private records."""
    return 0 < number <= max(Opcode) or number >= 0x80


def pieces(data: bytes) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and body of the records in a chunk or summary; raise if one is incomplete."""
    view, at = memoryview(data), 0
    while at < len(view):
        opcode, length = HEAD.unpack_from(view, at)
        at += HEAD.size
        if at + length > len(view):
            raise ValueError('a record in it is incomplete')
        yield opcode, view[at:at + length]
        at += length


def read_summary(file: BinaryIO, size: int) -> Summary | None:
    """Return the summary at the end of the first ``size`` bytes; None if it is not intact."""
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
    except Exception:    # a parser may raise anything on arbitrary bytes
        return None
    summary.starts.sort()
    return summary


def note(summary: Summary, opcode: int, body: memoryview) -> None:
    """Add a record of the summary section to a summary."""
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
