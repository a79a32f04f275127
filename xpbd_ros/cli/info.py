"""
What a log holds, and whether it is whole.

The exit code is 1 for a log that is damaged or was cut short; it is listed as far as it can be
read, and ``xpbd_ros recover`` makes a whole one of that.
"""

from datetime import datetime, timezone
from pathlib import Path
import shlex

import yaml

from xpbd_ros.cli.output import add_json_argument, write_json
from xpbd_ros.log.reader import LogReader

EXAMPLE = 'xpbd_ros info drape_run'


def add_arguments(parser):
    """Declare what the verb takes."""
    parser.add_argument('run', metavar='RUN', help='folder of the log, or the .mcap in it')
    add_json_argument(parser)


def run(arguments) -> int:
    """Read the log and print what it holds."""
    log = LogReader(arguments.run)
    write_json(arguments.json, {
        'run': Path(arguments.run),
        'whole': log.whole,
        'damage': log.damage,
        **content(log),
        'bytes': log.path.stat().st_size,
        'settings': log.settings,
    })
    if arguments.json != '-':
        print('\n'.join(lines(log, arguments.run)))
    return 0 if log.whole else 1


def content(log: LogReader) -> dict:
    """Return the keys of ``--json`` that describe what a log holds."""
    return {'messages': log.count,
            'topics': {name: {'type': topic.type, 'count': topic.count}
                       for name, topic in log.topics.items()},
            'start_ns': log.start_ns,
            'end_ns': log.end_ns,
            'frames': log.frames,
            'scene': log.scene}


def lines(log: LogReader, run: str) -> list[str]:
    """Return what there is to say about a log, which the user named ``run``."""
    found = [f'{log.path}: {"whole" if log.whole else "damaged"}',
             *(f'  {text}' for text in log.damage)]
    if not log.whole:
        found.append(f"'xpbd_ros recover {shlex.quote(str(run))}' makes a whole log of what can "
                     'be read')
    rows = [('size', f'{log.path.stat().st_size * 1e-6:.3f} MB')]
    if log.start_ns is not None:
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


def table(rows: list[tuple[str, ...]]) -> list[str]:
    """Return rows of text with their columns in line."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    return ['  ' + '  '.join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip()
            for row in rows]


def scene_rows(text: str) -> list[tuple[str, str]]:
    """Return the keys of a scene, each with its value or with the names that it holds."""
    try:
        scene = yaml.safe_load(text)
    except yaml.YAMLError as error:
        return [('cannot be read', str(error).replace('\n', ' '))]
    if not isinstance(scene, dict):
        return [('cannot be read', 'not a mapping')]
    return [(str(key), brief(value)) for key, value in scene.items()]


def brief(value: object) -> str:
    """Return a value of a scene; of one that holds others their names, and what is simple."""
    if isinstance(value, dict):
        return ', '.join(str(name) if isinstance(item, dict | list) else f'{name} {item}'
                         for name, item in value.items())
    return ', '.join(map(str, value)) if isinstance(value, list) else str(value)
