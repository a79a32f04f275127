"""
Iterate over the records of an MCAP file, also of a damaged one.

A record is an opcode, a length and a body, so one wrong length hides all records behind it. If the
summary at the end of the file is intact, its indexes give the offsets of chunks, attachments and
metadata, and reading resumes at the next of them. Else it resumes at the next chunk or attachment
whose checksum is right. (The readers of the library mcap end at the first damaged record, or need
the summary, hence this one; it parses records by that library.)
"""

from collections.abc import Callable, Iterator
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode

from xpbd_ros.log.records import HEAD, is_opcode, MAGIC
from xpbd_ros.log.resync import chunk_content, chunk_end, next_start, read_at, UNCOMPRESSED


class Record(NamedTuple):
    """A record and its position in the file."""

    opcode: int
    start: int
    """Offset of its head [bytes]."""
    head: bytes
    body: bytes

    @property
    def end(self) -> int:
        """Offset behind it [bytes]."""
        return self.start + len(self.head) + len(self.body)


def walk(file: BinaryIO, starts: list[int], lost: Callable[[int, int], None]) -> Iterator[Record]:
    """
    Yield the records of a file, from behind its first magic bytes to its footer.

    A file without end may end within a chunk. Its whole records are yielded one by one then.

    Parameters
    ----------
    file
        The file, open for reading.
    starts
        Offsets at which records are known to begin, and the length of the file, ascending [bytes].
    lost
        Called with the offsets of the start and the end of each unreadable range [bytes].

    """
    at, known, size = len(MAGIC), 0, starts[-1]
    while at < size:
        while starts[known] <= at:
            known += 1
        end = starts[known]
        head = read_at(file, at, at + HEAD.size)
        opcode, length = HEAD.unpack(head.ljust(HEAD.size, b'\0'))
        stop = at + HEAD.size + length if is_opcode(opcode) else size + 1
        if opcode != Opcode.CHUNK or (chunk_content(file, at, end) or (0, stop))[1] != stop:
            found = chunk_end(file, at, end)
            if found is not None:    # a chunk whose opcode or length is wrong
                opcode, stop = Opcode.CHUNK, found
        if stop <= end:
            record = Record(opcode, at, head, read_at(file, at + HEAD.size, stop))
            yield record
            if opcode == Opcode.FOOTER:
                return
            at = record.end
            continue
        later = next_start(file, at + 1, end)
        inside = start_in_cut_chunk(file, at, stop, size) if later is None else None
        if inside is None:
            lost(at, later or end)
        at = inside or later or end


def start_in_cut_chunk(file: BinaryIO, at: int, stop: int, size: int) -> int | None:
    """Return where the records in an uncompressed chunk begin that the file's end cuts off."""
    if read_at(file, size - len(MAGIC), size) == MAGIC:
        return None
    start, end = chunk_content(file, at, size) or (0, 0)
    return start if end == stop > size and start == at + UNCOMPRESSED else None
