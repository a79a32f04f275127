"""The ``metadata.yaml`` of rosbag2, version 9 as Jazzy writes it, which makes a folder a bag."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import json
import os
from pathlib import Path
from textwrap import indent

from xpbd_ros.log.qos import Qos

FILE = 'metadata.yaml'
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


class MetadataFile:
    """
    The ``metadata.yaml`` of a folder with one MCAP file, which may still grow.

    All numbers have the same width, so the length of the text changes only when topics are added.
    Then the file is replaced atomically, which takes milliseconds on ext4. Otherwise it is
    overwritten in place, which takes microseconds and no disk space; if that is interrupted, each
    number is either the old or the new one.

    Parameters
    ----------
    folder : folder of the log
    file : name of the MCAP file in it
    custom_data : entries of ``custom_data``
    """

    def __init__(self, folder: Path, file: str, custom_data: Mapping[str, str]):
        self._folder = folder
        self._name = file
        self._custom_data = custom_data
        self._descriptor: int | None = None
        self._length = 0

    def write(self, topics: Iterable[TopicRecord], *, start_ns: int, end_ns: int) -> None:
        """Write the topics and the times of the first and the last message [ns]."""
        text = metadata_text(self._name, list(topics), start_ns, end_ns, self._custom_data)
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


def metadata_text(file: str, topics: list[TopicRecord], start_ns: int, end_ns: int,
                  custom_data: Mapping[str, str]) -> str:
    """
    Return the text of ``metadata.yaml``.

    It is formatted by hand because it is written between two frames, and PyYAML takes 26 ms for
    15 topics. ``compression_format`` is that of whole files or messages, of which there is none;
    MCAP compresses its chunks itself.
    """
    count = sum(topic.count for topic in topics)
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
  relative_file_paths:
    - {quoted(file)}
  files:
    - path: {quoted(file)}
      starting_time:
        nanoseconds_since_epoch: {start_ns:{WIDTH}}
      duration:
        nanoseconds: {end_ns - start_ns:{WIDTH}}
      message_count: {count:{WIDTH}}
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


def custom_text(entry: tuple[str, str]) -> str:
    """Return the YAML entry of one key and value of the custom data."""
    key, value = entry
    return f'\n    {quoted(key)}: {quoted(value)}'


def quoted(text: str) -> str:
    """Return a text as a quoted YAML string (JSON strings are YAML)."""
    return json.dumps(text, ensure_ascii=False)
