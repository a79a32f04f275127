"""
Write the readable part of a damaged or incomplete log to a new log.

The new log has the index and the metadata.yaml that strict readers need. The old one is not
changed. Checksums cover chunks (256 KiB, or a frame if that is larger): without --unchecked, a
damaged byte costs the messages of its chunk.

Exit code: 0 if nothing or only the end of the log was missing, as after a kill; 1 if other
messages are lost.
"""

from pathlib import Path

from xpbd_ros.cli.info import content
from xpbd_ros.cli.output import add_json_argument, check_outputs, refuse_existing, write_json
from xpbd_ros.errors import counted
from xpbd_ros.log.folder import fresh_folder
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.recover import recover

EXAMPLE = 'xpbd_ros recover drape_run -o drape_whole'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('run', metavar='RUN', help='folder of the log, or the .mcap file in it')
    parser.add_argument('-o', '--output', metavar='RUN',
                        help='new folder for the new log; default: one named by time')
    parser.add_argument('--unchecked', action='store_true',
                        help='keep the messages of chunks with a wrong checksum too, at least '
                             'one of which is damaged')
    add_json_argument(parser)


def run(arguments) -> int:
    """Read the log, write the new one, and print the damage and the new content."""
    check_outputs(arguments.json, folder=arguments.output)
    refuse_existing(arguments.output)
    log = LogReader(arguments.run, unchecked=arguments.unchecked)
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
        print(f'{folder.absolute()}: {"whole" if whole.whole else "damaged"}, '
              f'{counted(whole.count, "message")}, {counted(whole.frames, "frame")}')
    return 1 if log.lossy else 0
