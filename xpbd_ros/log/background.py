"""
Write a log in a thread of its own, so that frames do not wait for checksums and the disk.

Both release the GIL, and the thread has a lower priority than frames. The work of one frame is one
task, and tasks run in order. When MOST_WAITING of them wait, the caller waits too, so memory stays
bounded and a crash loses no more than these frames beyond the flush period. The first error is
raised by one of the next calls.
"""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
import os
import sys

MOST_WAITING = 4
"""tasks that wait for the thread, at most"""
NICE = 5
"""increment of its nice value"""


class Background:
    """A thread that runs tasks in order."""

    def __init__(self):
        self._thread = ThreadPoolExecutor(1, thread_name_prefix='log',
                                          initializer=lower_priority, initargs=(NICE,))
        self._tasks: deque[Future[None]] = deque()
        self._failed = False

    def run(self, parts: Sequence[Callable[[], object]]) -> None:
        """Run functions, in order, after all earlier ones; raise the error of an earlier one."""
        self.check()
        while len(self._tasks) >= MOST_WAITING:
            self._look(self._tasks.popleft())
        self._tasks.append(self._thread.submit(_run, tuple(parts)))

    def check(self) -> None:
        """Raise the error of an earlier task."""
        while self._tasks and self._tasks[0].done():
            self._look(self._tasks.popleft())

    def _look(self, task: Future[None]) -> None:
        """Wait for a task; raise its error if it is the first."""
        error = task.exception()
        if error is not None and not self._failed:
            self._failed = True
            raise error

    @property
    def idle(self) -> bool:
        """True if nothing waits and nothing runs."""
        return all(task.done() for task in self._tasks)

    def close(self) -> None:
        """Run all that waits, and end the thread; raise the first error, unless it was raised."""
        self._thread.shutdown()
        while self._tasks:
            self._look(self._tasks.popleft())


def lower_priority(nice: int) -> None:
    """Let the frames go before this thread, where each thread has a nice value of its own."""
    if sys.platform == 'linux':
        os.nice(nice)


def _run(parts: tuple[Callable[[], object], ...]) -> None:
    for part in parts:
        part()
