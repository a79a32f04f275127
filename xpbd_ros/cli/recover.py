"""
Make a log whole again that was cut short or damaged.

All that can be read goes into a new log, with the index and the metadata.yaml that strict readers
want; the old one stays as it is. The exit code is 1 where something that had been written whole is
lost, and 0 where only the end is missing, as it is after a kill.
"""

from pathlib import Path

from xpbd_ros.cli.info import content
from xpbd_ros.cli.output import add_json_argument, check_output, refuse_existing, write_json
from xpbd_ros.log.folder import fresh_folder
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.recover import recover

EXAMPLE = 'xpbd_ros recover drape_run -o drape_whole'


def add_arguments(parser):
    """Declare what the verb takes."""
    parser.add_argument('run', metavar='RUN', help='folder of the log, or the .mcap in it')
    parser.add_argument('-o', '--output', metavar='RUN',
                        help='folder of the new log; must not exist')
    add_json_argument(parser)


def run(arguments) -> int:
    """Read the log, write it again, and print what came of it."""
    check_output(arguments.json)
    refuse_existing(arguments.output)
    log = LogReader(arguments.run)
    folder = Path(arguments.output) if arguments.output else fresh_folder('recover')
    whole = recover(log, folder)
    write_json(arguments.json, {
        'run': folder,
        'from': Path(arguments.run),
        'whole': whole.whole,
        'damage': log.damage,
        'lossy': log.lossy,
        **content(whole),
    })
    if arguments.json != '-':
        print(f'{log.path}: {"damaged" if log.damage else "whole"}')
        for text in log.damage:
            print(f'  {text}')
        print(f'{folder.absolute()}: {"whole" if whole.whole else "damaged"}, {whole.count} '
              f'messages, {whole.frames} frames')
    return 1 if log.lossy else 0
