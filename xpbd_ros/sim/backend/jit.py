"""
The one decorator: compile flags and the disk cache in a single place.

IEEE arithmetic throughout (no fast-math), so that a scene gives the same bits on every CPU. Numba
sees neither edits in other files nor that a type came from another scene, so the cache lives in a
folder named by a hash of the package's own kernels. Numba keeps code with bounds checks
(NUMBA_BOUNDSCHECK=1) and code without under the same name, so the hash tells them apart.
"""

from contextlib import contextmanager, suppress
import fcntl
from functools import cache
import gc
import hashlib
import os
from pathlib import Path
import tempfile

from numba import config, njit
from numba.core.caching import FunctionCache
from numba.extending import overload

from xpbd_ros.sim.backend import linking
from xpbd_ros.sim.backend.simd import BITS


class Cache(FunctionCache):
    """
    Numba's cache, for processes that compile at the same time.

    Numba numbers a kernel's variants in an index that it reads, changes and writes back; two
    processes at once would give two of them the same number, and one would run the other's code.
    """

    def save_overload(self, signature, data):
        """Write one variant, under the cache's lock."""
        with open(CACHE_FOLDER / 'lock', 'ab') as lock:
            with suppress(OSError):    # a file system without locks
                fcntl.flock(lock, fcntl.LOCK_EX)
            super().save_overload(signature, data)


class PartCache(Cache):
    """The same for parts."""

    _impl_class = linking.CacheImpl


FLAGS = {'nogil': True, 'error_model': 'numpy', '_nrt': False, 'no_cfunc_wrapper': True}
INNER = {**FLAGS, 'no_cpython_wrapper': True, 'pipeline_class': linking.Compiler}
"""for what compiled code calls: wrappers that unpack a scene's tuples take long to compile"""


def _sources_hash() -> str:
    """Hash every source file that may hold a kernel, and the way they are compiled."""
    digest = hashlib.blake2b(f'{BITS} {config.BOUNDSCHECK}'.encode(), digest_size=8)
    package = Path(__file__).parents[2]
    for folder in ('effects', 'sim'):
        for file in sorted((package / folder).rglob('*.py')):
            digest.update(file.relative_to(package).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _cache_folder() -> Path:
    """Return a writable cache folder."""
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


@contextmanager
def _no_collection():
    """Have the garbage collector wait: else it goes through all that a compiler holds, often."""
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


def _dispatcher(function, cache: type, folder: Path | None, **flags):
    if folder is None:
        return njit(**flags)(function)
    before = config.CACHE_DIR
    config.CACHE_DIR = str(folder)
    try:
        dispatcher = njit(**flags)(function)
        dispatcher._cache = cache(function)
        return dispatcher
    finally:
        config.CACHE_DIR = before


def jit(function=None, *, inline: bool = False, allocates: bool = False,
        cache_name: str | None = 'kernels'):
    """
    Compile a module-level kernel, GIL released, cached on disk.

    Arrays that come from outside outlive the call, so references to them are not counted;
    only a kernel that ``allocates`` arrays must.

    ``inline`` writes the function out where it is called: Numba hands over a NamedTuple by copying
    all that it holds, which costs more than a small kernel for one particle.

    ``cache_name`` separates the caches of functions whose signatures hold other scenes' types:
    reading such a cache would import effects that this scene does not name. None: not kept.

    Python and compiled code call a kernel alike; what they call is compiled for each of them when
    it first does, for compiled code as a part of its caller (``parts``).
    """
    def compile_(function):
        flags = {'forceinline': inline, '_nrt': allocates}
        folder = CACHE_FOLDER / cache_name if cache_name else None
        kernel = _dispatcher(function, Cache, folder, **{**FLAGS, **flags})
        compile_for = kernel._compile_for_args
        part = cache(lambda: _dispatcher(function, PartCache, folder and folder / 'parts',
                                         **{**INNER, **flags}))    # if anyone calls it

        def compile_quietly(*arguments, **keywords):
            with _no_collection():
                return compile_for(*arguments, **keywords)
        kernel._compile_for_args = compile_quietly
        kernel.get_call_template = lambda *arguments: part().get_call_template(*arguments)
        kernel.get_overload = lambda signature: part().get_overload(signature)
        kernel.part = part
        linking.KERNELS.add(id(kernel))
        return kernel
    return compile_ if function is None else compile_(function)


def inline(stub):
    """Register what a stub compiles to, to be written out where it is called."""
    return overload(stub, jit_options={**INNER, 'forceinline': True})
