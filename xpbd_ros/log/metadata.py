"""The ``metadata.yaml`` of rosbag2, version 9 as Jazzy writes it, which makes a folder a bag."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import json
import os
from pathlib import Path
from textwrap import indent

from xpbd_ros.log.qos import Qos

FILE = 'metadata.yaml'
ITEM = '\n    - '
WIDTH = 20
"""width of a number, for 64 bits and a sign [characters]"""


@dataclass
class TopicRecord:
    """A topic of the log, and its number of messages so far."""

    name: str
    type: str
    qos: Qos
    type_hash: str
    count: int = 0


@dataclass
class FileRecord:
    """An MCAP file of the log."""

    name: str
    start_ns: int = 0
    """log time of its first message [ns]"""
    end_ns: int = 0
    """log time of its last message [ns]"""
    count: int = 0
    """number of messages"""


class MetadataFile:
    """
    The ``metadata.yaml`` of a folder of MCAP files, the last of which may still grow.

    All numbers have the same width, so the length of the text changes only when topics or files
    are added. Then the file is replaced atomically, which takes milliseconds on ext4. Otherwise it
    is overwritten in place, which takes microseconds and no disk space; if that is interrupted,
    each number is either the old or the new one.

    Parameters
    ----------
    folder : folder of the log
    custom_data : entries of ``custom_data``
    """

    def __init__(self, folder: Path, custom_data: Mapping[str, str]):
        self._folder = folder
        self._custom_data = custom_data
        self._descriptor: int | None = None
        self._length = 0

    def write(self, topics: Iterable[TopicRecord], files: Sequence[FileRecord]) -> None:
        """Write the topics and the files."""
        text = metadata_text(list(topics), files, self._custom_data)
        data = text.encode()
        if self._descriptor is not None and len(data) == self._length:
            os.pwrite(self._descriptor, data, 0)
            return
        self.close()
        beside = self._folder / f'.{FILE}'
        with open(beside, 'wb') as file:
            file.write(data)
            self._descriptor = os.dup(file.fileno())
        os.replace(beside, self._folder / FILE)
        self._length = len(data)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def metadata_text(topics: list[TopicRecord], files: Sequence[FileRecord],
                  custom_data: Mapping[str, str]) -> str:
    """
    Return the text of ``metadata.yaml``.

    It is formatted by hand because it is written between two frames, and PyYAML takes 26 ms for
    15 topics.
    """
    count = sum(topic.count for topic in topics)
    start_ns = min((file.start_ns for file in files if file.count), default=0)
    end_ns = max(file.end_ns for file in files)
    return f"""\
rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  duration:
    nanoseconds: {end_ns - start_ns:{WIDTH}}
  starting_time:
    nanoseconds_since_epoch: {start_ns:{WIDTH}}
  message_count: {count:{WIDTH}}
  topics_with_message_count:{''.join(map(topic_text, topics)) or ' []'}
  compression_format: ""
  compression_mode: ""
  relative_file_paths:{''.join(f'{ITEM}{quoted(file.name)}' for file in files)}
  files:{''.join(map(file_text, files))}
  custom_data:{''.join(map(custom_text, custom_data.items())) or ' ~'}
  ros_distro: jazzy
"""


def topic_text(topic: TopicRecord) -> str:
    """Return the YAML entry of a topic."""
    profiles = indent(topic.qos.offered_profiles(), 10 * ' ')
    return f"""
    - topic_metadata:
        name: {quoted(topic.name)}
        type: {quoted(topic.type)}
        serialization_format: cdr
        offered_qos_profiles:
{profiles}
        type_description_hash: {quoted(topic.type_hash)}
      message_count: {topic.count:{WIDTH}}"""


def file_text(file: FileRecord) -> str:
    """Return the YAML entry of a file."""
    return f"""
    - path: {quoted(file.name)}
      starting_time:
        nanoseconds_since_epoch: {file.start_ns:{WIDTH}}
      duration:
        nanoseconds: {file.end_ns - file.start_ns:{WIDTH}}
      message_count: {file.count:{WIDTH}}"""


def custom_text(entry: tuple[str, str]) -> str:
    """Return the YAML entry of one key and value of the custom data."""
    key, value = entry
    return f'\n    {quoted(key)}: {quoted(value)}'


def quoted(text: str) -> str:
    """Return a text as a quoted YAML string (JSON strings are YAML)."""
    return json.dumps(text, ensure_ascii=False)
