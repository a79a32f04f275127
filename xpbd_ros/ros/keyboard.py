"""Keys of a terminal, read without waiting, as the controls of a replay."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
import select
import sys

try:
    import termios
    import tty
except ImportError:    # not on Windows
    termios = tty = None    # type: ignore[assignment]

KEYS = {b' ': 'space', b'\x1b[A': 'up', b'\x1b[B': 'down', b'\x1b[C': 'right'}
"""names of keys by the bytes that terminals send"""


@contextmanager
def pressed_keys(wanted: bool) -> Iterator[Callable[[], list[str]] | None]:
    """Yield a function that returns the keys pressed since its last call; None without one."""
    if not wanted or termios is None or not sys.stdin or not sys.stdin.isatty():
        yield None
        return
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal, termios.TCSADRAIN)
    try:
        yield lambda: _read(terminal)
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _read(terminal: int) -> list[str]:
    if not select.select([terminal], [], [], 0.0)[0]:
        return []
    data, found = os.read(terminal, 64), []
    while data:
        sequence = next((each for each in KEYS if data.startswith(each)), data[:1])
        found.append(KEYS.get(sequence, ''))
        data = data[len(sequence):]
    return [key for key in found if key]
