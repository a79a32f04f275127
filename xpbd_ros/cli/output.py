"""Output of the verbs: JSON, and checks of output files and folders."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, suppress
import json
import os
from pathlib import Path
import sys

from xpbd_ros.errors import InputError

STDOUT = '-'


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """Add ``--json FILE`` to a verb."""
    parser.add_argument(
        '--json', metavar='FILE',
        help='write the printed numbers as JSON to this new file; - writes them to stdout, and '
             'nothing else')


def refuse_existing(destination: str | Path | None) -> None:
    """
    Raise InputError if an output exists already; None and ``-`` are no outputs.

    To be called at the start of a long verb, so that its work is not lost at the end.
    """
    if destination is not None and not str(destination):
        raise InputError("an output needs a name (got '')")
    if destination is not None and str(destination) != STDOUT and os.path.lexists(destination):
        raise InputError(f'{destination}: exists already; name another, or move it away')


def check_output(destination: str | Path | None) -> None:
    """Raise InputError if an output file exists already, or if its folder does not."""
    refuse_existing(destination)
    if destination is not None and str(destination) != STDOUT:
        folder = Path(destination).absolute().parent
        if not folder.is_dir():
            raise InputError(f'{destination}: there is no folder {folder}; create it first')


def check_outputs(*files: str | Path | None, folder: str | Path | None = None,
                  picture: str | Path | None = None) -> None:
    """Check the output files of a verb, and that neither its folder nor two of them clash."""
    if picture and Path(picture).suffix.lower() != '.png':
        raise InputError(f'--picture {picture}: is written as PNG; end its name in .png')
    taken = [] if folder is None else [Path(os.path.abspath(folder))]
    for file in (*files, picture):
        check_output(file)
        if file is not None and str(file) != STDOUT:
            path = Path(os.path.abspath(file))
            if any(other.is_relative_to(path) for other in taken):
                raise InputError(f'{file}: is the name of two outputs; name another for one')
            taken.append(path)


@contextmanager
def new_folder(destination: str | Path | None) -> Iterator[Path | None]:
    """
    Create and yield an output folder; None yields None.

    It is created before the work, whose results would otherwise be lost if that fails. If the work
    raises, an empty folder is removed again.
    """
    if destination is None:
        yield None
        return
    refuse_existing(destination)
    folder = Path(destination)
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise InputError(f'{folder}: cannot be created ({error.strerror})') from error
    try:
        yield folder
    except BaseException:
        with suppress(OSError):
            folder.rmdir()
        raise


def write_json(destination: str | None, data: dict) -> None:
    """
    Write JSON to a new file, or to stdout for ``-``; None writes nothing.

    Non-finite numbers become null, as JSON cannot represent them.
    """
    if destination is None:
        return
    text = json.dumps(finite(data), indent=2, allow_nan=False, default=plain) + '\n'
    if destination == STDOUT:
        sys.stdout.write(text)
        return
    refuse_existing(destination)
    write_text(destination, text)


def write_text(file: str | Path, text: str) -> None:
    """Write a new file; raise InputError if that fails, such as on a full disk."""
    try:
        with open(file, 'x', encoding='utf-8') as stream:
            stream.write(text)
    except OSError as error:
        raise InputError(f'{file}: cannot be written: {error.strerror}') from error


def finite(value: object) -> object:
    """Return a copy of plain data with None for infinite floats and NaN."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if hasattr(value, 'tolist'):    # of NumPy: a scalar or an array
        return finite(value.tolist())
    if isinstance(value, float) and not -float('inf') < value < float('inf'):
        return None
    return value


def plain(value: object) -> str:
    """Return a path as absolute text; raise TypeError for other objects, as json asks."""
    if isinstance(value, Path):
        return str(value.absolute())
    raise TypeError(f'{type(value).__name__} cannot be written as JSON')
