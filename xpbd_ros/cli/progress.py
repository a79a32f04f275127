"""Progress bars on terminals."""

from collections.abc import Iterable
import sys


def progress(items: Iterable, what: str) -> Iterable:
    """Return an iterable of the items, with a progress bar on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        return items
    from tqdm import tqdm
    return tqdm(items, unit=f' {what}', leave=False)
