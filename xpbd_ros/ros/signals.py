"""Handle SIGINT and SIGTERM: raise KeyboardInterrupt once, collect them, or ignore them."""

from collections.abc import Iterator
from contextlib import contextmanager
import os
import signal
import sys

_at_once = False


def interrupt_on_signals() -> None:
    """Raise KeyboardInterrupt on the first SIGINT or SIGTERM only, so that the log is closed."""
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, _leave)    # rclpy calls these after its own


def ignore_signals() -> None:
    """Ignore further signals at exit, where Python restores the handlers that end the process."""
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)


@contextmanager
def collected_signals() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM in a list, so that they interrupt nothing."""
    received: list[int] = []
    before = {number: signal.signal(number, lambda number, _: received.append(number))
              for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def exit_at_once_on_signals() -> Iterator[None]:
    """
    Let a signal end the process at once, with exit code 0, where no log is open yet.

    For compilation: an exception raised inside the compiler's callbacks is dropped by Python, or
    leaves the compiler in an inconsistent state.
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
