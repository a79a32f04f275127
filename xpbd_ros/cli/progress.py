"""A progress bar for long work, on a terminal."""

from collections.abc import Iterable
import sys


def progress(items: Iterable, what: str) -> Iterable:
    """Pass items on, with a bar on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        return items
    from tqdm import tqdm
    return tqdm(items, unit=f' {what}', leave=False)
