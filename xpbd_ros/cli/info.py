"""
List the content of a log, and check that it is complete and undamaged.

A log that is damaged or was cut short is listed as far as it is readable; 'xpbd_ros recover'
writes its readable part to a new log.

Exit code: 0, or 1 for a log that is damaged or was cut short.
"""

from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
import shlex

import yaml

from xpbd_ros.cli.output import add_json_argument, write_json
from xpbd_ros.log.reader import LogReader

EXAMPLE = 'xpbd_ros info drape_run'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('run', metavar='RUN', help='folder of the log, or the .mcap file in it')
    add_json_argument(parser)


def run(arguments) -> int:
    """Read the log and print its content."""
    log = LogReader(arguments.run)
    write_json(arguments.json, {
        'run': Path(arguments.run),
        'whole': log.whole,
        'damage': log.damage,
        **content(log),
        'bytes': log.size,
        'settings': log.settings,
    })
    if arguments.json != '-':
        print('\n'.join(lines(log, arguments.run)))
    return 0 if log.whole else 1


def content(log: LogReader) -> dict:
    """Return the JSON keys about the content of a log."""
    return {'messages': log.count,
            'topics': {name: {'type': topic.type, 'count': topic.count}
                       for name, topic in log.topics.items()},
            'start_ns': log.start_ns,
            'end_ns': log.end_ns,
            'frames': log.frames,
            'scene': log.scene}


def lines(log: LogReader, run: str) -> list[str]:
    """Return the printed description of a log, which the user gave as ``run``."""
    found = [f'{log.path}: {"whole" if log.whole else "damaged"}',
             *(f'  {text}' for text in log.damage)]
    if not log.whole:
        found.append(f"'xpbd_ros recover {shlex.quote(str(run))}' writes a whole log of the "
                     'readable part')
    rows = [('size', f'{log.size * 1e-6:.3f} MB')]
    if log.start_ns is not None and log.end_ns is not None:
        start = datetime.fromtimestamp(log.start_ns * 1e-9, timezone.utc)
        rows += [('start', f'{start:%Y-%m-%d %H:%M:%S.%f} UTC ({log.start_ns} ns)'),
                 ('duration', f'{(log.end_ns - log.start_ns) * 1e-9:.3f} s')]
    rows += [('frames', str(log.frames)), ('messages', str(log.count)), *log.settings.items()]
    found += table(rows)
    found += ['', 'topics',
              *table([(name, topic.type, str(topic.count)) for name, topic in log.topics.items()])]
    if log.scene is not None:
        found += ['', 'scene', *table(scene_rows(log.scene))]
    return found


def table(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Return rows of text with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    return ['  ' + '  '.join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip()
            for row in rows]


def scene_rows(text: str) -> list[tuple[str, str]]:
    """Return the top-level keys of a scene, each with its value or the names in it."""
    try:
        scene = yaml.safe_load(text)
    except yaml.YAMLError as error:
        return [('cannot be read', str(error).replace('\n', ' '))]
    if not isinstance(scene, dict):
        return [('cannot be read', 'not a mapping')]
    return [(str(key), outline(value)) for key, value in scene.items()]


def outline(value: object) -> str:
    """Return a value of a scene as text; of nested mappings only the names."""
    if isinstance(value, dict | list) and not value:
        return 'none'
    if isinstance(value, dict):
        return ', '.join(str(name) if isinstance(item, dict | list) else f'{name} {item}'
                         for name, item in value.items())
    return ', '.join(map(str, value)) if isinstance(value, list) else str(value)
