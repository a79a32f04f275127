"""Handle SIGINT and SIGTERM: exit at once, shut down, collect, or ignore them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
import signal
import sys
from threading import Thread

SIGNALS = signal.SIGINT, signal.SIGTERM
_at_once = True
_shut_down: Callable[[], object] | None = None


def handle_signals() -> None:
    """
    Handle signals in a thread of its own, as the main thread may be in a function of C.

    They end the process with exit code 0 until ``shut_down_on_signals`` is called.
    """
    if signal.getsignal(SIGNALS[0]) is _exit_if_at_once:
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    for each in SIGNALS:
        signal.signal(each, _exit_if_at_once)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    Thread(target=_handle, args=(reading,), name='signals', daemon=True).start()


def shut_down_on_signals(shut_down: Callable[[], object]) -> None:
    """
    From here on call ``shut_down()``, in the thread of ``handle_signals``, on the first signal.

    Nothing is interrupted: an exception would cut a callback short, and some functions of rclpy
    turn it into another one.
    """
    global _at_once, _shut_down
    _shut_down = shut_down
    _at_once = False


def ignore_signals() -> None:
    """Ignore further signals at exit, where Python restores the handlers that end the process."""
    for each in SIGNALS:
        signal.signal(each, signal.SIG_IGN)


@contextmanager
def collected_signals() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM in a list, so that they interrupt nothing."""
    received: list[int] = []
    before = {number: signal.signal(number, lambda number, _: received.append(number))
              for number in SIGNALS}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def exit_at_once_on_signals() -> Iterator[None]:
    """Let a signal end the process at once, with exit code 0: for long work with no log open."""
    global _at_once
    before, _at_once = _at_once, True
    try:
        yield
    finally:
        _at_once = before


def _handle(reading: int) -> None:
    """Handle each signal, of which there is a byte to read."""
    called = False
    while os.read(reading, 1):
        _exit_if_at_once()
        if _shut_down is not None and not called:
            called = True
            _shut_down()


def _exit_if_at_once(*_) -> None:
    if _at_once:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
