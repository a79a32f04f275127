"""
Find intact records of an MCAP file where the head of a record is damaged.

A chunk repeats the length of its content and has a checksum over it, so it is found by its own
fields, also where opcode or length before them are wrong. An attachment has a checksum too. Other
records have none, so a search cannot tell them from arbitrary bytes.
"""

from collections.abc import Iterator
import re
import struct
from typing import BinaryIO
import zlib

from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream

from xpbd_ros.log.records import HEAD, parse

CHUNK_HEAD = struct.Struct('<QQQII')
"""first and last log time, length of the content, checksum, length of the compression's name"""
LONGEST_NAME = 4
COMPRESSIONS = (b'', b'lz4', b'zstd')
LONG = struct.Struct('<Q')
UNCOMPRESSED = HEAD.size + CHUNK_HEAD.size + LONG.size
"""offset of the records in a chunk that is not compressed [bytes]"""
ATTACHMENT_TIMES = 16
"""length of the two times at the start of an attachment [bytes]"""
CHECKED = re.compile(rb'(?=[\x06\x09].{5}\x00\x00\x00)', re.DOTALL)
"""opcode and length of a chunk or an attachment of less than 2^40 bytes"""
DESCRIPTION = re.compile(rb'(?=[\x03\x04].{4}\x00\x00\x00\x00)', re.DOTALL)
"""opcode and length of a schema or a channel"""
WINDOW = 2**20
"""bytes that are searched at a time"""


def decompressed(chunk: bytes) -> bytes:
    """Return the records in a chunk, decompressed; raise if it is damaged or unreadable."""
    found = parse(Chunk, chunk)
    if found.compression.encode() not in COMPRESSIONS:    # the library takes it as uncompressed
        raise ValueError(f'its compression {found.compression!r} is unknown (known: lz4, zstd)')
    stream, length = get_chunk_data_stream(found, validate_crc=True)
    return stream.read(length)


def read_at(file: BinaryIO, start: int, end: int) -> bytes:
    """Return the bytes of a file from ``start`` to ``end``."""
    file.seek(start)
    return file.read(max(0, end - start))


def chunk_content(file: BinaryIO, at: int, end: int) -> tuple[int, int] | None:
    """
    Return where the records in a chunk lie by its own fields, whether it is whole or not.

    Parameters
    ----------
    file
        The file, open for reading.
    at
        Offset of the chunk [bytes].
    end
        Offset before which these records must begin [bytes].

    Returns
    -------
    start, stop
        Offsets of the records in it [bytes]; None if it is none, or has no checksum.

    """
    body = at + HEAD.size
    data = read_at(file, body, min(end, body + CHUNK_HEAD.size + LONGEST_NAME + LONG.size))
    if len(data) < CHUNK_HEAD.size + LONG.size:
        return None
    first, last, size, crc, name_length = CHUNK_HEAD.unpack_from(data)
    name = data[CHUNK_HEAD.size:CHUNK_HEAD.size + min(name_length, LONGEST_NAME)]
    start = CHUNK_HEAD.size + name_length + LONG.size
    if not crc or first > last or name not in COMPRESSIONS or start > len(data):
        return None
    length, = LONG.unpack_from(data, start - LONG.size)
    if not length or not name and length != size:
        return None
    return body + start, body + start + length


def chunk_end(file: BinaryIO, at: int, end: int) -> int | None:
    """Return the end of the chunk at ``at`` if its checksum is right, and None if not [bytes]."""
    found = chunk_content(file, at, end)
    if found is None or found[1] > end:
        return None
    try:
        decompressed(read_at(file, at + HEAD.size, found[1]))
    except Exception:    # a decompressor may raise anything on arbitrary bytes
        return None
    return found[1]


def attachment_end(file: BinaryIO, at: int, end: int) -> int | None:
    """Return the end of the attachment at ``at`` if its checksum is right, and None if not."""
    body = at + HEAD.size
    stop = body + ATTACHMENT_TIMES
    for count in (4, 4, 8):    # bytes of the lengths of name, media type and data
        stop += count + int.from_bytes(read_at(file, stop, stop + count), 'little')
        if stop + 4 > end:
            return None
    data = read_at(file, body, stop + 4)
    return stop + 4 if int.from_bytes(data[-4:], 'little') == zlib.crc32(data[:-4]) else None


def next_start(file: BinaryIO, at: int, end: int) -> int | None:
    """Return the offset of the first whole chunk or attachment from ``at`` on; None if none."""
    while at + HEAD.size <= end:
        data = read_at(file, at, min(end, at + WINDOW))
        for found in CHECKED.finditer(data):
            start = at + found.start()
            opcode, length = HEAD.unpack_from(data, found.start())
            if start + HEAD.size + length <= end:
                stop = (chunk_end if opcode == Opcode.CHUNK else attachment_end)(file, start, end)
                if stop == start + HEAD.size + length:
                    return start
        at += len(data) - HEAD.size + 1
    return None


def descriptions(records: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and body of the schemas and channels in a damaged chunk's records."""
    for found in DESCRIPTION.finditer(records):
        opcode, length = HEAD.unpack_from(records, found.start())
        body = records[found.end() + HEAD.size:found.end() + HEAD.size + length]
        at = 2 if opcode == Opcode.SCHEMA else 4    # behind the numbers
        for _ in range(3):    # name, encoding, text; or topic, encoding, metadata
            at += 4 + int.from_bytes(body[at:at + 4], 'little')
        if at == length == len(body):
            yield opcode, body
