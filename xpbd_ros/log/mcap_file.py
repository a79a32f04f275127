"""
One MCAP file being written; a log has several where it is split.

If a write fails, the file is truncated to its whole records and closed, so that a full disk or an
interrupt leaves a readable file.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
import os
from pathlib import Path
from typing import BinaryIO, TypeVar

from mcap.writer import CompressionType, Writer

from xpbd_ros import __version__
from xpbd_ros.errors import InputError
from xpbd_ros.log.errors import LogError
from xpbd_ros.log.metadata import FileRecord, TopicRecord

CHUNK_SIZE = 256 * 1024
"""A damaged byte costs a whole chunk (mcap's default is 1 MiB). Chunks are not compressed, nor are
rosbag2's by default: zstd makes moving float32 positions only 10 to 25 % smaller, and takes more
time than all else that is done for a log."""
MEDIA_TYPES = {'.json': 'application/json', '.obj': 'model/obj', '.yaml': 'application/yaml'}

Answer = TypeVar('Answer')


class McapFile:
    """
    An MCAP file in the profile of ROS 2.

    Parameters
    ----------
    path
        New file.
    metadata
        Metadata records by name.
    attachments
        Files by name.

    """

    def __init__(self, path: Path, metadata: Mapping[str, Mapping[str, str]],
                 attachments: Mapping[str, bytes]):
        self.path = path
        self.record = FileRecord(path.name)
        self.whole = 0
        """length up to the last whole record [bytes]"""
        self.ended = ''
        """reason why nothing more can be written; empty while it can"""
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._waiting: list[tuple[TopicRecord, str]] = []
        """topics before the first message, with the definitions of their types"""
        self._file = self._create()
        self._mcap = Writer(self._file, chunk_size=CHUNK_SIZE, compression=CompressionType.NONE,
                            enable_data_crcs=True)
        self._put(self._begin, metadata, attachments)

    def _create(self) -> BinaryIO:
        try:
            return open(self.path, 'xb')
        except OSError as error:
            raise InputError(f'{self.path}: cannot be written: {error.strerror}') from None

    def _begin(self, metadata: Mapping, attachments: Mapping) -> None:
        """Write the header, the metadata and the attachments."""
        self._mcap.start('ros2', f'xpbd_ros {__version__}')
        for name, entries in metadata.items():
            self._mcap.add_metadata(name, entries)
        for name, data in attachments.items():
            media_type = MEDIA_TYPES.get(Path(name).suffix, 'application/octet-stream')
            self._mcap.add_attachment(0, 0, name, media_type, data)

    def add_channel(self, topic: TopicRecord, definition: str) -> None:
        """
        Add a topic with the definition of its type.

        Before the first message it is kept for later: mcap writes no chunk without messages, but
        lists its channels in the summary, and strict readers refuse a channel that is only there.
        """
        if self.record.count:
            self._register(topic, definition)
        else:
            self._waiting.append((topic, definition))

    def _register(self, topic: TopicRecord, definition: str) -> None:
        """Write a channel, and the schema of its type if it is new."""
        if topic.type not in self._schemas:
            self._schemas[topic.type] = self._put(
                self._mcap.register_schema, topic.type, 'ros2msg', definition.encode())
        self._channels[topic.name] = self._put(
            self._mcap.register_channel, topic.name, 'cdr', self._schemas[topic.type],
            {'offered_qos_profiles': topic.qos.offered_profiles(),
             'topic_type_hash': topic.type_hash})

    def write(self, topic: str, data: bytes, time_ns: int, frame: int) -> None:
        """Write a message (CDR with encapsulation header)."""
        while self._waiting:
            self._register(*self._waiting.pop(0))
        self._put(self._mcap.add_message, self._channels[topic], time_ns, data, time_ns, frame)
        record = self.record
        record.start_ns = time_ns if not record.count else min(record.start_ns, time_ns)
        record.end_ns = max(record.end_ns, time_ns)
        record.count += 1

    def flush(self) -> None:
        """Complete the present chunk, and hand all written data to the operating system."""
        self._put(self._mcap.flush)

    def finish(self) -> None:
        """Write the summary, and close the file."""
        self._put(self._mcap.finish)
        self._file.close()
        self.ended = f'{self.path}: is closed'

    def end(self, error: BaseException) -> None:
        """Truncate the file to whole records and close it, because of an error."""
        if self.ended:
            return
        reason = error.strerror if isinstance(error, OSError) else repr(error)
        self.ended = f'{self.path}: cannot be written any further: {reason}'
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            os.truncate(self.path, self.whole)

    def _put(self, write: Callable[..., Answer], *arguments: object) -> Answer:
        """
        Call ``write(*arguments)``; if it fails, truncate the file to whole records and close it.

        KeyboardInterrupt counts as a failure too, as it may leave a record incomplete.
        """
        if self.ended:
            raise LogError(self.ended)
        try:
            answer = write(*arguments)
            end = self._file.tell()
            if end > self.whole:
                self._file.flush()
                self.whole = end
            return answer
        except BaseException as error:
            self.end(error)
            if isinstance(error, OSError):
                raise LogError(self.ended) from None
            raise
