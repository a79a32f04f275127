"""Progress bars on terminals, and where parallel work runs."""

import argparse
from collections.abc import Iterable
import sys


def progress(items: Iterable, what: str) -> Iterable:
    """Return an iterable of the items, with a progress bar on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        return items
    from tqdm import tqdm
    return tqdm(items, unit=f' {what}', leave=False)


def add_scheduler_argument(parser: argparse.ArgumentParser) -> None:
    """Add ``--scheduler ADDRESS`` to a verb."""
    parser.add_argument(
        '--scheduler', metavar='ADDRESS',
        help='let the workers of this Dask scheduler do the work, such as tcp://10.0.0.1:8786; '
             'they need the same version and the same folders; needs the extra cluster')
