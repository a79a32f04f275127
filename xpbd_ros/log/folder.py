"""Folders of logs: as given, or one per run, named by verb and time."""

from datetime import datetime
import itertools
import os
from pathlib import Path

from xpbd_ros.errors import InputError


def fresh_folder(verb: str) -> Path:
    """
    Return the path of a folder that does not exist yet, such as ``xpbd_ros_run_20261121_093000``.

    It is in the working directory, and is not created here.
    """
    stem = f'xpbd_ros_{verb}_{datetime.now():%Y%m%d_%H%M%S}'
    names = itertools.chain([stem], (f'{stem}_{number}' for number in itertools.count(2)))
    return next(path for path in map(Path.cwd().joinpath, names) if not os.path.lexists(path))


def folder_of(path: str) -> Path | None:
    """Return a folder that a parameter names, with ~ as the home folder; None if it is empty."""
    return Path(os.path.expanduser(path)) if path else None


def check_absent(folder: Path) -> None:
    """Refuse a folder that exists."""
    if os.path.lexists(folder):
        raise occupied(folder)


def occupied(folder: Path) -> InputError:
    """Return the error of a folder that exists."""
    return InputError(f'{folder}: exists already; a log goes into a folder of its own')
