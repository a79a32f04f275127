"""
The one decorator: compile flags and the disk cache in a single place.

IEEE arithmetic throughout (no fast-math), so that a scene gives the same bits on every CPU. Numba
sees neither edits in other files nor that a type came from another scene, so the cache lives in a
folder named by a hash of the package's own kernels.
"""

from contextlib import suppress
import fcntl
import hashlib
from inspect import signature
import os
from pathlib import Path
import tempfile

from numba import config, njit
from numba.core.caching import FunctionCache

from xpbd_ros.sim.vector import BITS


class Cache(FunctionCache):
    """
    Numba's cache, for processes that compile at the same time.

    Numba numbers a kernel's variants in an index that it reads, changes and writes back; two
    processes at once would give two of them the same number, and one would run the other's code.
    """

    def save_overload(self, signature, data):
        """Write one variant, while nobody else does."""
        with open(CACHE_FOLDER / 'lock', 'ab') as lock:
            with suppress(OSError):    # a file system without locks
                fcntl.flock(lock, fcntl.LOCK_EX)
            super().save_overload(signature, data)


FLAGS = {'nogil': True, 'error_model': 'numpy', '_nrt': False}
INNER = {**FLAGS, 'no_cpython_wrapper': True, 'no_cfunc_wrapper': True}
"""for what only compiled code calls: wrappers that unpack a scene's tuples take long to compile"""


def _sources_hash() -> str:
    """Hash every source file that may hold a kernel, and the width they are compiled for."""
    digest = hashlib.blake2b(str(BITS).encode(), digest_size=8)
    package = Path(__file__).parents[1]
    for folder in ('effects', 'sim'):
        for file in sorted((package / folder).glob('*.py')):
            digest.update(file.name.encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _cache_folder() -> Path:
    """Return a folder of ours that can be written to."""
    base = os.environ.get('NUMBA_CACHE_DIR') or os.environ.get('XDG_CACHE_HOME')
    for root in (Path(base) if base else Path.home() / '.cache', Path(tempfile.gettempdir())):
        folder = root / 'xpbd_ros' / _sources_hash()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix='xpbd_ros_'))


CACHE_FOLDER = _cache_folder()


def _closed(kernel):
    """Have a kernel without a wrapper refuse calls from Python, which would crash."""
    def refuse(*arguments, **keywords):
        raise TypeError(f'{kernel.__name__}: only compiled code can call this')
    kernel._compile_for_args, kernel._insert = refuse, lambda *_, **__: None
    return kernel


def jit(function=None, *, inline: bool = False, allocates: bool = False,
        cache_name: str = 'kernels'):
    """
    Compile a module-level kernel, GIL released, cached on disk.

    Arrays that come from outside outlive the call, so that nobody counts references to them;
    only a kernel that ``allocates`` arrays must.

    ``inline`` writes the function out where it is called: Numba hands over a NamedTuple by copying
    all that it holds, which costs more than a small kernel for one particle.

    ``cache_name`` separates the caches of functions whose signatures hold other scenes' types:
    reading such a cache would import effects that this scene does not name.

    What takes a substep, or is written out and takes the state, is a part of a step, which only
    compiled code calls: without the wrapper for Python it compiles in two thirds of the time.
    """
    def compile_(function):
        takes = signature(function).parameters
        inner = 'substep' in takes or inline and 'state' in takes
        before = config.CACHE_DIR
        config.CACHE_DIR = str(CACHE_FOLDER / cache_name)
        try:
            kernel = njit(forceinline=inline, **{
                **(INNER if inner else FLAGS), '_nrt': allocates})(function)
            kernel._cache = Cache(function)
            return _closed(kernel) if inner else kernel
        finally:
            config.CACHE_DIR = before
    return compile_ if function is None else compile_(function)
