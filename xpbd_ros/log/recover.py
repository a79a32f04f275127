"""
Write what can be read of a log again, as a log that is whole.

A log whose writer was killed has no summary at its end, and strict readers refuse it; one that is
damaged has records that no reader gets past. The new log has all messages that can be read, in
their order, and says in its settings what was wrong with the old one, which stays as it is.
"""

from pathlib import Path

from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.writer import LogWriter


def recover(log: LogReader, folder: Path) -> LogReader:
    """Write a log again into a new folder; return the new one."""
    if not log.settings and log.scene is None:
        raise InputError(f'{log.path}: neither scene nor settings of a log of xpbd_ros can be '
                         "read in it; for bags of other programs there is 'mcap recover'")
    settings = {**log.settings, **({'recovered': '; '.join(log.damage)} if log.damage else {})}
    topics = {name: topic for name, topic in log.topics.items() if topic.definition}
    with LogWriter(folder, scene=None, settings=settings, attachments=log.attachments) as whole:
        for name, topic in topics.items():
            whole.add_channel(name, topic.type, topic.qos, definition=topic.definition,
                              hashed=topic.type_hash)
        for message in log.messages(topics):
            whole.write(message.topic, message.data, time_ns=message.time_ns, frame=message.frame)
    return LogReader(folder)
