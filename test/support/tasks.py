"""Tasks that another process can import."""

import os
import signal


def power(base: int, exponent: int) -> int:
    """Return base^exponent."""
    return base**exponent


def die_at_one(number: int) -> int:
    """Return the number; with 1, kill the process."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number
