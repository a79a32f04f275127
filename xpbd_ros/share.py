"""Where the shipped files are: scenes, launch files, views and the node's parameters."""

import os
from pathlib import Path
import sys

from xpbd_ros.errors import InputError

PACKAGE = 'xpbd_ros'
MARKER = 'cloth_node.yaml'    # lies in the folder that we look for, and in no other


def share_folder() -> Path:
    """
    Return the folder that holds ``scenes/``, ``launch/``, ``views/`` and ``cloth_node.yaml``.

    In a checkout it is ``config/``, beside the package. Installed it is ``share/xpbd_ros`` of the
    prefix that the package lies in, which a walk up from here meets whether pip put it there (in
    a virtual environment, with ``--user``, ``--prefix`` or ``--target``) or colcon did. The
    interpreter's prefix and those of a sourced workspace come last, for a layout that keeps code
    and data apart. Needs no ROS.
    """
    package = Path(__file__).resolve().parent
    for folder in candidates(package):
        if (folder / MARKER).is_file():
            return folder
    raise InputError(f'{PACKAGE}: the shipped files (scenes, launch files, parameters) are not '
                     f'installed: no share/{PACKAGE} above {package}, nor in {sys.prefix}; '
                     f'install the package with pip or colcon')


def candidates(package: Path) -> list[Path]:
    """Return the folders to try, best first, for a package that lies at this path."""
    sourced = [path for path in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if path]
    prefixes = [*package.parents, Path(sys.prefix), *map(Path, sourced)]
    return [package.parent / 'config', *(prefix / 'share' / PACKAGE for prefix in prefixes)]
