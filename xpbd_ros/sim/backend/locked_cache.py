"""Numba's disk cache, safe for processes that compile at the same time."""

from contextlib import suppress
import fcntl

from numba.core.caching import FunctionCache

from xpbd_ros.sim.backend.disk_cache import CACHE_FOLDER


class LockedCache(FunctionCache):
    """
    Numba's cache, whose index one process at a time may write.

    Numba numbers a kernel's variants in an index that it reads, changes and writes back. Two
    processes at once would give two variants the same number, and one would run the other's code.
    """

    def save_overload(self, signature, data):
        """Write one variant, under the cache's lock."""
        with open(CACHE_FOLDER / 'lock', 'ab') as lock:
            with suppress(OSError):    # a file system without locks
                fcntl.flock(lock, fcntl.LOCK_EX)
            super().save_overload(signature, data)
