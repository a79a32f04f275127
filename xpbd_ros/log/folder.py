"""Default output folders, one per run, named by verb and time."""

from datetime import datetime
import itertools
import os
from pathlib import Path


def fresh_folder(verb: str) -> Path:
    """
    Return the path of a folder that does not exist yet, such as ``xpbd_ros_run_20261121_093000``.

    It is in the working directory, and is not created here.
    """
    stem = f'xpbd_ros_{verb}_{datetime.now():%Y%m%d_%H%M%S}'
    names = itertools.chain([stem], (f'{stem}_{number}' for number in itertools.count(2)))
    return next(path for path in map(Path.cwd().joinpath, names) if not os.path.lexists(path))
