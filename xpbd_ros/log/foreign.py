"""
Read logs of other programs: MCAP files, and rosbag2 folders of either storage.

MCAP files are read like our own logs, also damaged ones and those without metadata.yaml. Folders
with SQLite files are read by the library rosbags, which is imported for them.
"""

from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
import heapq
from pathlib import Path
from typing import Any, NamedTuple

from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader

SLACK_NS = 10**9
"""messages of a log are out of order by less than this [ns]"""
SQLITE = '*.db3*'
"""names of SQLite files; rosbag2 appends .zstd to compressed ones"""


class Record(NamedTuple):
    """A message in a log of another program."""

    time_ns: int
    """log time [ns]"""
    number: int
    """position in the log"""
    topic: str
    """absolute name"""
    data: bytes
    """CDR with encapsulation header"""


class ForeignLog:
    """
    A log of another program.

    Parameters
    ----------
    path : an .mcap file, or a folder of rosbag2

    Attributes
    ----------
    topics : dict of str
        Types by topic; without those that are not in CDR. Names are absolute: ``pose``, as logs
        converted from ROS 1 have it, is /pose.
    encodings : dict of str
        Encodings of the topics that are not in CDR.
    start_ns, end_ns : int
        Times of the first and the last message [ns].
    damage : list of str
        Descriptions of all damage.

    Raises
    ------
    InputError : it cannot be read, or holds neither a scene nor a message

    """

    def __init__(self, path: Path | str):
        self.path = Path(path).absolute()
        self._reader: LogReader | None = None
        self.damage: list[str] = []
        self.encodings: dict[str, str] = {}
        if is_sqlite(self.path):
            with self._bag() as bag:
                found = {each.topic: (each.msgtype, each.ext.serialization_format)
                         for each in bag.connections}
                begin, end = bag.start_time, bag.end_time - 1    # rosbags has it 1 ns later
                count = bag.message_count
        else:
            self._reader = reader = LogReader(self.path)
            self.damage = reader.damage
            found = {name: (about.type, about.encoding) for name, about in reader.topics.items()}
            begin, end, count = reader.start_ns, reader.end_ns, reader.count
        self._names = absolute_names(found)
        about = {self._names[name]: each for name, each in found.items()}
        self.topics = {name: type_name for name, (type_name, encoding) in about.items()
                       if encoding == 'cdr'}
        self.encodings = {name: encoding for name, (_, encoding) in about.items()
                          if encoding != 'cdr'}
        if self.scene is None and not count:
            raise InputError(f'{self.path}: is not a log of xpbd_ros: it holds no scene; and it '
                             'holds no readable message')
        self.start_ns, self.end_ns = begin or 0, end or 0

    @property
    def scene(self) -> str | None:
        """YAML text of the scene; None if this is no log of xpbd_ros."""
        return None if self._reader is None else self._reader.scene

    @contextmanager
    def _bag(self) -> Iterator[Any]:
        """Open a bag with SQLite files; raise InputError if that or its use fails."""
        try:
            from rosbags.rosbag2 import Reader
        except ImportError as error:
            raise InputError(f'{self.path}: rosbag2 with SQLite needs rosbags: pip install '
                             f"'xpbd_ros[bags]' ({error})") from None
        try:
            with Reader(_bag_path(self.path)) as bag:
                yield bag
        except InputError:
            raise
        except Exception as error:    # of rosbags, or of SQLite or YAML below it
            raise InputError(f"{self.path}: cannot be read: {' '.join(str(error).split())}"
                             ) from None

    def messages(self, topics: Collection[str]) -> Iterator[Record]:
        """Yield the messages of these topics in the order of their times."""
        return in_time_order(self._messages({name for name, absolute in self._names.items()
                                             if absolute in topics}))

    def _messages(self, topics: set[str]) -> Iterator[Record]:
        if self._reader is not None:
            for number, message in enumerate(self._reader.messages(topics)):
                yield Record(message.time_ns, number, self._names[message.topic], message.data)
            return
        with self._bag() as bag:
            wanted = [each for each in bag.connections if each.topic in topics]
            for number, found in enumerate(bag.messages(wanted) if wanted else ()):
                connection, time_ns, data = found
                yield Record(time_ns, number, self._names[connection.topic], bytes(data))


def absolute_names(names: Collection[str]) -> dict[str, str]:
    """Return absolute names by name; `name` stays where `/name` is a topic too."""
    absolute = {name: f'/{name.lstrip("/")}' for name in names}
    return {name: other if name == other or other not in names else name
            for name, other in absolute.items()}


def _bag_path(path: Path) -> Path:
    """Return a folder of rosbag2; its SQLite file if it lacks metadata.yaml, as after a crash."""
    files = sorted(path.glob('*.db3')) if path.is_dir() else []
    return files[0] if len(files) == 1 and not (path / 'metadata.yaml').is_file() else path


def is_sqlite(path: Path) -> bool:
    """Return whether a path is that of an SQLite file, or of a folder with one."""
    return path.match(SQLITE) if path.is_file() else any(path.glob(SQLITE))


def in_time_order(messages: Iterable[Record]) -> Iterator[Record]:
    """Yield messages that are out of order by less than SLACK_NS in the order of their times."""
    waiting: list[Record] = []
    latest_ns = 0
    for message in messages:
        heapq.heappush(waiting, message)
        latest_ns = max(latest_ns, message.time_ns)
        while waiting[0].time_ns <= latest_ns - SLACK_NS:
            yield heapq.heappop(waiting)
    while waiting:
        yield heapq.heappop(waiting)
