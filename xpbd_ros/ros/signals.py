"""Being told to end: SIGINT and SIGTERM interrupt whatever runs, once."""

import signal
import sys

AGAIN = 0.01
"""until an interrupt that got lost is tried anew [s]"""


def interrupt_on_signals() -> None:
    """
    Raise KeyboardInterrupt on the first SIGINT or SIGTERM; the log has to be finished after it.

    Python drops an exception that comes up inside a callback from foreign code, of which the
    compiler has some, and goes on; the interrupt is then tried again a moment later.
    """
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, _leave)    # rclpy calls these after its own
    signal.signal(signal.SIGALRM, _interrupt)
    sys.unraisablehook = _try_again


def _leave(number, frame):
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda *_: None)
    _interrupt()


def _interrupt(*_):
    raise KeyboardInterrupt


def _try_again(lost):
    if lost.exc_type is KeyboardInterrupt:
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
    else:
        sys.__unraisablehook__(lost)
