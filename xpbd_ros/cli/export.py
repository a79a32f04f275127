"""
Write the states of a log for other programs.

Formats: npz (NumPy arrays), parquet (tables of particles and pins), obj and ply (a file for each
frame), usd (one file with time samples). Memory stays bounded however long the log is. A damaged
log is exported as far as it is readable.
"""

from functools import partial
from pathlib import Path
import sys

from xpbd_ros.cli.output import add_json_argument, check_outputs, new_folder, write_json
from xpbd_ros.cli.progress import progress
from xpbd_ros.cli.ros import need_ros
from xpbd_ros.errors import brief, counted, InputError
from xpbd_ros.log.folder import fresh_folder

EXAMPLE = 'xpbd_ros export towel_run --format parquet -o towel_tables'
FORMATS = ('npz', 'parquet', 'obj', 'ply', 'usd')


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('run', metavar='RUN', help='folder of the log, or the .mcap file in it')
    parser.add_argument('--format', required=True, choices=FORMATS, help='what to write')
    parser.add_argument('-o', '--output', metavar='DIR',
                        help='new folder for the files; default: one named by time')
    parser.add_argument('--every', type=int, default=1, metavar='N',
                        help='only frames whose index is a multiple of N (default: 1)')
    add_json_argument(parser)


def run(arguments) -> int:
    """Read the log, and write the files."""
    need_ros('export')
    from xpbd_ros.export.states import States

    check_outputs(arguments.json, folder=arguments.output)
    if arguments.every < 1:
        raise InputError(f'--every: must be at least 1 (got {arguments.every})')
    states = States(arguments.run, every=arguments.every, tell=lambda text: print(
        f'xpbd_ros export: damaged log: {text}', file=sys.stderr))
    with new_folder(arguments.output or fresh_folder('export')) as folder:
        assert folder is not None
        files = written(writer(arguments.format), folder.absolute(), states)
    particles = sum(states.particles.values())
    write_json(arguments.json, {'files': files, 'frames': len(states), 'particles': particles,
                                'cloths': states.particles, 'format': arguments.format})
    if arguments.json != '-':
        size = sum(file.stat().st_size for file in files)
        print(f'{states.path}: {counted(len(states), "frame")} of '
              f'{counted(particles, "particle")}')
        more = f' and {len(files) - 1} more' if len(files) > 1 else ''
        print(f'{files[0]}{more}, {1e-6 * size:.2f} MB')
    return 0


def written(write, folder: Path, states) -> list[Path]:
    """Return the files that a format's function wrote; if it fails, the folder is emptied."""
    try:
        return write(folder, states, lambda: progress(states, 'frames'))
    except BaseException as error:
        for file in folder.iterdir():
            file.unlink()
        if isinstance(error, OSError):
            raise InputError(f'{error.filename or folder}: cannot be written: '
                             f'{brief(error.strerror or str(error))}; free some space, or name '
                             'another folder by -o') from error
        raise


def writer(name: str):
    """Return the function that writes a format."""
    if name == 'npz':
        from xpbd_ros.export.npz import write
    elif name == 'parquet':
        from xpbd_ros.export.parquet import write
    elif name == 'usd':
        from xpbd_ros.export.usd import write
    else:
        from xpbd_ros.export import mesh_sequence
        return partial(mesh_sequence.write, suffix=name)
    return write
