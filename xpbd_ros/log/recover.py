"""
Rewrite the readable part of a log as a whole log.

A log whose writer was killed has no summary at its end, and strict readers refuse it; readers of a
damaged log stop at the first damaged record. The new log has all readable messages in their order,
and lists the damage of the old one in its settings. The old log is not changed.
"""

from pathlib import Path
from shutil import rmtree

from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.writer import LogWriter, SCENE


def recover(log: LogReader, folder: Path) -> LogReader:
    """Rewrite a log to a new folder, which is removed if that fails; return the new log."""
    if not log.settings and log.scene is None:
        raise InputError(f'{log.path}: holds neither the scene nor the settings of an xpbd_ros '
                         "log; for bags of other programs use 'mcap recover'")
    settings = {**log.settings, **({'recovered': '; '.join(log.damage)} if log.damage else {})}
    topics = {name: topic for name, topic in log.topics.items() if topic.definition}
    others = {name: data for name, data in log.attachments.items() if name != SCENE}
    writer = LogWriter(folder, scene=log.scene, settings=settings, attachments=others)
    try:
        with writer as whole:
            for name, topic in topics.items():
                whole.add_channel(name, topic.type, topic.qos, definition=topic.definition,
                                  hashed=topic.type_hash)
            for message in log.messages(topics):
                whole.write(message.topic, message.data, time_ns=message.time_ns,
                            frame=message.frame)
    except BaseException:    # a part of the log would pass for all of it
        rmtree(folder)
        raise
    return LogReader(folder)
