"""
Write a run as MCAP, in the form that rosbag2, Foxglove and the ``mcap`` tools read.

A log is a folder with ``RUN_0.mcap`` and ``metadata.yaml``, and with ``RUN_1.mcap`` and so on
where it is split. Messages are given as CDR bytes, so that published messages are logged
unchanged. Flushed data survives the end of the process: every chunk is handed to the operating
system when it is complete, and ``flush`` completes the present chunk and updates
``metadata.yaml``. (It survives a kill, not a power failure: there is no fsync.) The log of a
killed process has no summary, which strict readers need; ``recover`` adds it.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
import time
from typing import TypeVar

from xpbd_ros import __version__
from xpbd_ros.errors import InputError
from xpbd_ros.log.errors import LogError
from xpbd_ros.log.folder import occupied
from xpbd_ros.log.mcap_file import McapFile
from xpbd_ros.log.metadata import FileRecord, MetadataFile, TopicRecord
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.schemas import message_definition, type_hash

METADATA = 'xpbd_ros'
SCENE = 'scene.yaml'
CHECKPOINT = 'checkpoint'
"""name of the attachment with the state from which a log continues a run"""
VECTOR_BITS = 'vector_bits'
"""key of the width of vectors in the metadata"""

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
    split_size, split_duration
        Size [bytes] and duration in log time [ns] at which a new file begins, between two frames;
        0 for one file.
    name
        The files are ``<name>_0.mcap`` and so on; None takes the folder's name.

    Each file has the scene and the metadata; further attachments are in the first one. After a
    LogError the log is closed, and holds all that was written before.

    """

    def __init__(self, folder: Path, *, scene: str | None, settings: Mapping[str, str],
                 attachments: Mapping[str, bytes] | None = None, flush_period: float = 1.0,
                 split_size: int = 0, split_duration: int = 0, name: str | None = None):
        self.folder = Path(folder).absolute()
        self.flush_period = flush_period
        self.split_size = split_size
        self.split_duration = split_duration
        self._name = name or self.folder.name
        self._topics: dict[str, TopicRecord] = {}
        self._definitions: dict[str, str] = {}    # by type
        self._metadata = {METADATA: {'version': __version__, **settings}}
        self._scene = {} if scene is None else {SCENE: scene.encode()}
        if scene is not None:
            self._metadata[SCENE] = {'yaml': scene}
        self._ended: list[FileRecord] = []    # files before the present one
        self._before = 0    # their length [bytes]
        self._frame = -1    # of the last message
        self._described = -1    # ``_count`` when metadata.yaml was last written
        self._create()
        self._file = McapFile(self._path(0), self._metadata,
                              {**self._scene, **(attachments or {})})
        self._bag = MetadataFile(self.folder, self._metadata[METADATA])
        self.flush()

    def __enter__(self) -> 'LogWriter':
        """Return the log; the end of the block closes it."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the log."""
        self.close()

    @property
    def path(self) -> Path:
        """The file being written."""
        return self._file.path

    @property
    def bytes_written(self) -> int:
        """Length of all files so far [bytes], without the incomplete chunk in memory."""
        return self._before + self._file.whole

    @property
    def closed(self) -> bool:
        """True after ``close`` or a failed write."""
        return bool(self._file.ended)

    def add_channel(self, topic: str, type_name: str, qos: Qos, *,
                    definition: str | None = None, hashed: str | None = None) -> None:
        """Add a topic; without ``definition`` and ``hashed`` those of the installed type apply."""
        assert topic not in self._topics, topic
        record = TopicRecord(topic, type_name, qos,
                             type_hash(type_name) if hashed is None else hashed)
        if type_name not in self._definitions:
            self._definitions[type_name] = definition or message_definition(type_name)
        self._add_channel(record)
        self._topics[topic] = record

    def _add_channel(self, topic: TopicRecord) -> None:
        self._do(self._file.add_channel, topic, self._definitions[topic.type])

    def write(self, topic: str, data: bytes, *, time_ns: int, frame: int) -> None:
        """Write a message (CDR with encapsulation header) of a frame at log time ``time_ns``."""
        if frame > self._frame >= 0 and self._is_split_due(time_ns):
            self._split()
        self._frame = frame
        self._do(self._file.write, topic, data, time_ns, frame)
        self._topics[topic].count += 1
        self.flush_if_due()

    def _is_split_due(self, time_ns: int) -> bool:
        start_ns = self._file.record.start_ns
        return bool(self.split_size and self._file.whole >= self.split_size
                    or self.split_duration and time_ns - start_ns >= self.split_duration)

    def _split(self) -> None:
        """Finish the present file, and begin the next one with the same topics."""
        done = self._file
        self._do(done.finish)
        self._ended.append(done.record)
        self._before += done.whole
        self._file = self._do(McapFile, self._path(len(self._ended)), self._metadata, self._scene)
        for topic in self._topics.values():
            self._add_channel(topic)
        self._do(self._describe)

    def flush_if_due(self) -> None:
        """Flush if the flush period has passed; for times without new messages."""
        if self.flush_is_due:
            self.flush()

    @property
    def flush_is_due(self) -> bool:
        """True if the flush period has passed."""
        return not self.closed and time.monotonic() - self._flushed >= self.flush_period

    def flush(self) -> None:
        """Complete the present chunk, and hand all written data to the operating system."""
        self._do(self._file.flush)
        if self._described != self._count:
            self._do(self._describe)
        self._flushed = time.monotonic()

    def close(self) -> None:
        """Write the summary and ``metadata.yaml``; no effect on a log that is closed already."""
        if self.closed:
            return
        self._do(self._file.finish)
        self._do(self._describe)
        self._bag.close()

    def _path(self, number: int) -> Path:
        return self.folder / f'{self._name}_{number}.mcap'

    def _create(self) -> None:
        """Create the folder."""
        try:
            self.folder.mkdir(parents=True)
        except FileExistsError:
            raise occupied(self.folder) from None
        except OSError as error:
            raise InputError(f'{self.folder}: cannot be written: {error.strerror}') from None

    def _describe(self) -> None:
        """Write ``metadata.yaml`` for the present content."""
        self._bag.write(self._topics.values(), [*self._ended, self._file.record])
        self._described = self._count

    @property
    def _count(self) -> int:
        """Number of messages and topics so far, which only grows."""
        return len(self._topics) + sum(topic.count for topic in self._topics.values())

    def _do(self, act: Callable[..., Answer], *arguments: object) -> Answer:
        """Call ``act(*arguments)``; if it fails, the log is closed."""
        try:
            return act(*arguments)
        except BaseException as error:
            self._bag.close()
            self._file.end(error)
            if isinstance(error, OSError):
                raise LogError(self._file.ended) from None
            raise
