"""What every verb writes: its numbers as JSON."""

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
        help='write the same numbers as JSON to this new file; - is stdout, and then nothing else '
             'goes there')


def refuse_existing(destination: str | Path | None) -> None:
    """
    Raise InputError if a named output exists already; None and ``-`` name none.

    For the start of a long verb, so that it does not end at a file that it may not write.
    """
    if destination is not None and str(destination) != STDOUT and os.path.lexists(destination):
        raise InputError(f'{destination}: exists already; name another, or move it away')


def check_output(destination: str | Path | None) -> None:
    """Raise InputError if a named file cannot be made: it is there, or its folder is not."""
    refuse_existing(destination)
    if destination is not None and str(destination) != STDOUT:
        folder = Path(destination).absolute().parent
        if not folder.is_dir():
            raise InputError(f'{destination}: there is no folder {folder}; make it first')


@contextmanager
def new_folder(destination: str | Path | None) -> Iterator[Path | None]:
    """
    Make a named folder for what a long verb will write; None names none.

    Before the work, so that it does not end at a folder that cannot be made; what is left empty by
    work that fails goes again.
    """
    if destination is None:
        yield None
        return
    refuse_existing(destination)
    folder = Path(destination)
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise InputError(f'{folder}: cannot be made ({error.strerror})') from error
    try:
        yield folder
    except BaseException:
        with suppress(OSError):
            folder.rmdir()
        raise


def write_json(destination: str | None, data: dict) -> None:
    """
    Write a verb's numbers to a new file, or to stdout for ``-``; None asks for nothing.

    Numbers that are not finite become null, which is all that JSON has for them.
    """
    if destination is None:
        return
    text = json.dumps(finite(data), indent=2, allow_nan=False, default=plain) + '\n'
    if destination == STDOUT:
        sys.stdout.write(text)
        return
    refuse_existing(destination)
    try:
        with open(destination, 'x', encoding='utf-8') as file:
            file.write(text)
    except OSError as error:
        raise InputError(f'{destination}: cannot be written: {error.strerror}') from error


def finite(value: object) -> object:
    """Return the same data with None where a float is infinite or not a number."""
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
    """Return what JSON has no word for as text; a path becomes an absolute one."""
    if isinstance(value, Path):
        return str(value.absolute())
    raise TypeError(f'{type(value).__name__} has no form in JSON')
