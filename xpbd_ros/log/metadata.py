"""The ``metadata.yaml`` of rosbag2, version 9 as Jazzy writes it, which makes a folder a bag."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import json
import os
from pathlib import Path
from textwrap import indent

from xpbd_ros.log.qos import Qos

FILE = 'metadata.yaml'


@dataclass
class TopicRecord:
    """A topic of the log, and how many messages it holds so far."""

    name: str
    type: str
    qos: Qos
    type_hash: str
    count: int = 0


def write_metadata(folder: Path, file: str, topics: Iterable[TopicRecord], *,
                   start_ns: int, end_ns: int, custom_data: Mapping[str, str]) -> None:
    """Write ``metadata.yaml`` for a folder that holds one MCAP file, at once or not at all."""
    beside = folder / f'.{FILE}'
    beside.write_text(metadata_text(file, list(topics), start_ns, end_ns, custom_data),
                      encoding='utf-8')
    os.replace(beside, folder / FILE)


def metadata_text(file: str, topics: list[TopicRecord], start_ns: int, end_ns: int,
                  custom_data: Mapping[str, str]) -> str:
    """
    Return the text of ``metadata.yaml``.

    It is written between two frames, so it is put together by hand: PyYAML takes 26 ms for 15
    topics. The compression is that of whole files or messages, of which there is none; MCAP's
    own is in its chunks.
    """
    count = sum(topic.count for topic in topics)
    return f"""\
rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  duration:
    nanoseconds: {end_ns - start_ns}
  starting_time:
    nanoseconds_since_epoch: {start_ns}
  message_count: {count}
  topics_with_message_count:{''.join(map(topic_text, topics)) or ' []'}
  compression_format: ""
  compression_mode: ""
  relative_file_paths:
    - {quoted(file)}
  files:
    - path: {quoted(file)}
      starting_time:
        nanoseconds_since_epoch: {start_ns}
      duration:
        nanoseconds: {end_ns - start_ns}
      message_count: {count}
  custom_data:{''.join(map(custom_text, custom_data.items())) or ' ~'}
  ros_distro: jazzy
"""


def topic_text(topic: TopicRecord) -> str:
    """Return the entry of a topic."""
    profiles = indent(topic.qos.offered_profiles(), 10 * ' ')
    return f"""
    - topic_metadata:
        name: {quoted(topic.name)}
        type: {quoted(topic.type)}
        serialization_format: cdr
        offered_qos_profiles:
{profiles}
        type_description_hash: {quoted(topic.type_hash)}
      message_count: {topic.count}"""


def custom_text(entry: tuple[str, str]) -> str:
    """Return an entry of the custom data."""
    key, value = entry
    return f'\n    {quoted(key)}: {quoted(value)}'


def quoted(text: str) -> str:
    """Return a YAML string: JSON's are among them."""
    return json.dumps(text, ensure_ascii=False)
