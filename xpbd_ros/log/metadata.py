"""The ``metadata.yaml`` of rosbag2, version 9 as Jazzy writes it, which makes a folder a bag."""

from collections.abc import Iterable
from dataclasses import dataclass
import os
from pathlib import Path

import yaml

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
                   start_ns: int, end_ns: int, custom_data: dict[str, str]) -> None:
    """Write ``metadata.yaml`` for a folder that holds one MCAP file, at once or not at all."""
    topics = list(topics)
    count = sum(topic.count for topic in topics)
    information = {
        'version': 9,
        'storage_identifier': 'mcap',
        'duration': {'nanoseconds': end_ns - start_ns},
        'starting_time': {'nanoseconds_since_epoch': start_ns},
        'message_count': count,
        'topics_with_message_count': [
            {'topic_metadata': {
                'name': topic.name,
                'type': topic.type,
                'serialization_format': 'cdr',
                'offered_qos_profiles': yaml.safe_load(topic.qos.offered_profiles()),
                'type_description_hash': topic.type_hash},
             'message_count': topic.count} for topic in topics],
        'compression_format': '',    # of whole files or messages; MCAP's own is in its chunks
        'compression_mode': '',
        'relative_file_paths': [file],
        'files': [{'path': file,
                   'starting_time': {'nanoseconds_since_epoch': start_ns},
                   'duration': {'nanoseconds': end_ns - start_ns},
                   'message_count': count}],
        'custom_data': custom_data,
        'ros_distro': 'jazzy',
    }
    text = yaml.safe_dump({'rosbag2_bagfile_information': information},
                          sort_keys=False, allow_unicode=True)
    beside = folder / f'.{FILE}'
    beside.write_text(text, encoding='utf-8')
    os.replace(beside, folder / FILE)
