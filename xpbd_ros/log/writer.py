"""
Write a run as MCAP, in the form that rosbag2, Foxglove and the ``mcap`` tools read.

A log is a folder with ``RUN_0.mcap`` and ``metadata.yaml``. Messages are given as CDR bytes, so
that published messages are logged unchanged. Flushed data survives the end of the process: every
chunk is handed to the operating system when it is complete, and ``flush`` completes the present
chunk and updates ``metadata.yaml``. (It survives a kill, not a power failure: there is no fsync.)
The log of a killed process has no summary, which strict readers need; ``recover`` adds it.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
import os
from pathlib import Path
import time
from typing import BinaryIO, TypeVar

from mcap.writer import CompressionType, Writer

from xpbd_ros import __version__
from xpbd_ros.errors import InputError
from xpbd_ros.log.errors import LogError
from xpbd_ros.log.metadata import MetadataFile, TopicRecord
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.schemas import message_definition, type_hash

# The frame that completes a chunk waits for its compression: 0.6 ms for 256 KiB of float32
# positions (3 ms for mcap's default of 1 MiB), at the same ratio.
CHUNK_SIZE = 256 * 1024
METADATA = 'xpbd_ros'
SCENE = 'scene.yaml'
MEDIA_TYPES = {'.json': 'application/json', '.obj': 'model/obj', '.yaml': 'application/yaml'}

Answer = TypeVar('Answer')


class LogWriter:
    """
    A log being written; not thread-safe.

    Parameters
    ----------
    folder
        New folder of the log; refused if it exists.
    scene
        YAML text of the scene as it runs; None if it is among the attachments or unknown.
    settings
        Further metadata of the run; the version is added.
    attachments
        Further files by name.
    flush_period
        Wall time between flushes [s]; a kill loses no more than that.
    name
        The file is ``<name>_0.mcap``; None takes the folder's name.

    After a LogError the log is closed, and holds all that was written before.

    """

    def __init__(self, folder: Path, *, scene: str | None, settings: Mapping[str, str],
                 attachments: Mapping[str, bytes] | None = None, flush_period: float = 1.0,
                 name: str | None = None):
        self.folder = Path(folder).absolute()
        self.path = self.folder / f'{name or self.folder.name}_0.mcap'
        self.flush_period = flush_period
        self._topics: dict[str, TopicRecord] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._settings = {'version': __version__, **settings}
        self._start_ns: int | None = None
        self._end_ns = 0
        self._whole = 0    # length of the file up to its last whole record [bytes]
        self._described = -1    # ``_size`` when metadata.yaml was last written
        self._ended = ''    # reason why nothing more can be written
        self._metadata = MetadataFile(self.folder, self.path.name, self._settings)
        self._file = self._create()
        self._mcap = Writer(self._file, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD,
                            enable_data_crcs=True)
        self._put(self._begin, {**({} if scene is None else {SCENE: scene.encode()}),
                                **(attachments or {})})
        self.flush()

    def __enter__(self) -> 'LogWriter':
        """Return the log; the end of the block closes it."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the log."""
        self.close()

    @property
    def bytes_written(self) -> int:
        """Length of the file so far [bytes], without the incomplete chunk in memory."""
        return self._whole

    @property
    def closed(self) -> bool:
        """True after ``close`` or a failed write."""
        return bool(self._ended)

    def add_channel(self, topic: str, type_name: str, qos: Qos, *,
                    definition: str | None = None, hashed: str | None = None) -> None:
        """Add a topic; without ``definition`` and ``hashed`` those of the installed type apply."""
        assert topic not in self._channels, topic
        hashed = type_hash(type_name) if hashed is None else hashed
        record = TopicRecord(topic, type_name, qos, hashed)
        if type_name not in self._schemas:
            self._schemas[type_name] = self._put(
                self._mcap.register_schema, type_name, 'ros2msg',
                (definition or message_definition(type_name)).encode())
        self._channels[topic] = self._put(
            self._mcap.register_channel, topic, 'cdr', self._schemas[type_name],
            {'offered_qos_profiles': qos.offered_profiles(), 'topic_type_hash': record.type_hash})
        self._topics[topic] = record

    def write(self, topic: str, data: bytes, *, time_ns: int, frame: int) -> None:
        """Write a message (CDR with encapsulation header) of a frame at log time ``time_ns``."""
        self._put(self._mcap.add_message, self._channels[topic], time_ns, data, time_ns, frame)
        self._topics[topic].count += 1
        self._start_ns = time_ns if self._start_ns is None else min(self._start_ns, time_ns)
        self._end_ns = max(self._end_ns, time_ns)
        self.flush_if_due()

    def flush_if_due(self) -> None:
        """Flush if the flush period has passed; for times without new messages."""
        if not self.closed and time.monotonic() - self._flushed >= self.flush_period:
            self.flush()

    def flush(self) -> None:
        """Complete the present chunk, and hand all written data to the operating system."""
        self._put(self._mcap.flush)
        if self._described != self._size:
            self._put(self._describe)
        self._flushed = time.monotonic()

    def close(self) -> None:
        """Write the summary and ``metadata.yaml``; no effect on a log that is closed already."""
        if self.closed:
            return
        self._put(self._mcap.finish)
        self._put(self._describe)
        self._metadata.close()
        self._file.close()
        self._ended = f'{self.path}: is closed'

    def _create(self) -> BinaryIO:
        """Create the folder and the file in it."""
        try:
            self.folder.mkdir(parents=True)
            return open(self.path, 'xb')
        except FileExistsError:
            raise InputError(f'{self.folder}: exists already; a log goes into a folder of its '
                             f'own') from None
        except OSError as error:
            raise InputError(f'{self.folder}: cannot be written: {error.strerror}') from None

    def _begin(self, attachments: dict[str, bytes]) -> None:
        """Write the header, the settings and the attachments."""
        self._mcap.start('ros2', f'xpbd_ros {__version__}')
        self._mcap.add_metadata(METADATA, self._settings)
        for name, data in attachments.items():
            media_type = MEDIA_TYPES.get(Path(name).suffix, 'application/octet-stream')
            self._mcap.add_attachment(0, 0, name, media_type, data)

    def _describe(self) -> None:
        """Write ``metadata.yaml`` for the present content."""
        self._metadata.write(self._topics.values(), start_ns=self._start_ns or 0,
                             end_ns=self._end_ns)
        self._described = self._size

    @property
    def _size(self) -> int:
        """Number of messages and topics so far, which only grows."""
        return len(self._topics) + sum(topic.count for topic in self._topics.values())

    def _put(self, write: Callable[..., Answer], *arguments: object) -> Answer:
        """
        Call ``write(*arguments)``; if it fails, truncate the file to whole records and close it.

        KeyboardInterrupt counts as a failure too, as it may leave a record incomplete.
        """
        if self._ended:
            raise LogError(self._ended)
        try:
            answer = write(*arguments)
            end = self._file.tell()
            if end > self._whole:
                self._file.flush()
                self._whole = end
            return answer
        except BaseException as error:
            reason = error.strerror if isinstance(error, OSError) else repr(error)
            self._ended = f'{self.path}: cannot be written any further: {reason}'
            self._metadata.close()
            with suppress(OSError):
                self._file.close()
            with suppress(OSError):
                os.truncate(self.path, self._whole)
            if isinstance(error, OSError):
                raise LogError(self._ended) from None
            raise
