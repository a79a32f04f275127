"""Being told to end: SIGINT and SIGTERM interrupt whatever runs, once."""

from collections.abc import Iterator
from contextlib import contextmanager
import os
import signal
import sys

_at_once = False


def interrupt_on_signals() -> None:
    """Raise KeyboardInterrupt on the first SIGINT or SIGTERM; the log has to be finished after."""
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, _leave)    # rclpy calls these after its own


def ignore_signals() -> None:
    """Let no further signal end a process that is done: Python, as it ends, gives them back."""
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)


@contextmanager
def nothing_to_finish() -> Iterator[None]:
    """
    Let a signal end the process at once, with 0: there is nothing to finish yet.

    While the compiler works, an exception may come up inside its callbacks, where Python drops it
    or leaves the compiler in pieces.
    """
    global _at_once
    _at_once = True
    try:
        yield
    finally:
        _at_once = False


def _leave(number, frame):
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda *_: None)
    if _at_once:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    raise KeyboardInterrupt
