"""Find the installed files: scenes, launch files, views and the node's parameters."""

import os
from pathlib import Path
import sys

from xpbd_ros.errors import InputError

PACKAGE = 'xpbd_ros'
MARKER = 'cloth_node.yaml'    # identifies the folder


def share_folder() -> Path:
    """
    Return the folder that holds ``scenes/``, ``launch/``, ``views/`` and ``cloth_node.yaml``.

    In a checkout it is ``config/`` beside the package. Once installed it is ``share/xpbd_ros`` in
    the prefix of the package, which is one of the parent folders of this file, both with pip (in
    a virtual environment, with ``--user``, ``--prefix`` or ``--target``) and with colcon. The
    prefixes of the interpreter and of a sourced workspace are tried last, for installations that
    keep code and data apart. No ROS is needed.
    """
    package = Path(__file__).resolve().parent
    for folder in candidates(package):
        if (folder / MARKER).is_file():
            return folder
    raise InputError(f'{PACKAGE}: the shipped files (scenes, launch files, parameters) are not '
                     f'installed: no share/{PACKAGE} above {package}, nor in {sys.prefix}; '
                     f'install the package with pip or colcon')


def shipped_scenes() -> dict[str, Path]:
    """Return the files of the shipped scenes, by name."""
    return {file.stem: file for file in sorted((share_folder() / 'scenes').glob('*.yaml'))}


def package_share(package: str) -> Path:
    """Return the share folder of a ROS package; raise InputError unless it is installed."""
    try:
        from ament_index_python.packages import get_package_share_directory, PackageNotFoundError
    except ImportError:
        raise InputError('package:// paths need ROS: source /opt/ros/jazzy/setup.bash, or write '
                         'the path of the file') from None
    try:
        return Path(get_package_share_directory(package))
    except (PackageNotFoundError, ValueError, OSError):    # OSError: nothing is sourced
        raise InputError(f"ROS has no package '{package}': install it, or source its "
                         'workspace') from None


def candidates(package: Path) -> list[Path]:
    """Return the folders to try for a package at this path, in order of preference."""
    sourced = [path for path in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if path]
    prefixes = [*package.parents, Path(sys.prefix), *map(Path, sourced)]
    return [package.parent / 'config', *(prefix / 'share' / PACKAGE for prefix in prefixes)]
