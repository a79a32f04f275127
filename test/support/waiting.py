"""Wait for another thread or process."""

from collections.abc import Callable
import time

PATIENCE = 60.0
"""[s]; only a failure takes that long"""


def until(true: Callable) -> None:
    """Wait until something is so."""
    deadline = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)
