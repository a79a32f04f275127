"""Numba's disk cache, safe for processes that compile at the same time."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import fcntl

from numba.core.caching import FunctionCache

from xpbd_ros.sim.backend.disk_cache import CACHE_FOLDER


class LockedCache(FunctionCache):
    """
    Numba's cache, whose index one process at a time may write.

    Numba numbers a kernel's variants in an index that it reads, changes and writes back. Two
    processes at once would give two variants the same number, and one would run the other's code.
    """

    def load_overload(self, signature, target):
        """Load a variant; return None, and empty the index, if it cannot be read."""
        try:
            return super().load_overload(signature, target)
        except Exception:    # damaged, or with a type whose module cannot be imported here
            with locked():
                self.flush()
            return None

    def save_overload(self, signature, data):
        """Write one variant, under the cache's lock; an unreadable index is emptied before."""
        with locked():
            try:
                super().save_overload(signature, data)
            except Exception:    # as for ``load_overload``: another process may have written it
                self.flush()
                super().save_overload(signature, data)


@contextmanager
def locked() -> Iterator[None]:
    """Hold the cache's lock."""
    with open(CACHE_FOLDER / 'lock', 'ab') as lock:
        with suppress(OSError):    # a file system without locks
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
