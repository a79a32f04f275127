"""
The one decorator: compile flags and the disk cache in a single place.

IEEE arithmetic throughout (no fast-math), so that a scene gives the same bits on every CPU.

Kernels that others call are linked into their callers before optimisation (``linking``), which
saves most of the time to compile. That builds on Numba's internals. Where a Numba release lacks
them, is newer than those tested, or XPBD_ROS_PLAIN_NJIT=1 asks for it, the same kernels compile
through plain ``njit``, to the same bits. Without Numba's cache class nothing is kept on disk.
"""

from contextlib import contextmanager
from functools import cache
import gc
import os
from pathlib import Path

import numba
from numba import config, njit, types
from numba.extending import overload

from xpbd_ros.sim.backend.disk_cache import CACHE_FOLDER

NEWEST_TESTED = (0, 68)
"""of Numba's releases; 0.59 is the oldest"""


def _why_plain() -> str:
    """Return why kernels compile through plain ``njit``; empty if they are linked."""
    if os.environ.get('XPBD_ROS_PLAIN_NJIT', '0') != '0':
        return 'XPBD_ROS_PLAIN_NJIT is set'
    if tuple(map(int, numba.__version__.split('.')[:2])) > NEWEST_TESTED:
        return (f'Numba {numba.__version__} is newer than '
                f'{".".join(map(str, NEWEST_TESTED))}, the newest tested')
    try:
        from xpbd_ros.sim.backend import linking  # noqa: F401
    except (AttributeError, ImportError) as error:
        return f'Numba {numba.__version__} lacks internals: {error}'
    return ''


WHY_PLAIN = _why_plain()
FLAGS = {'nogil': True, 'error_model': 'numpy', '_nrt': False, 'no_cfunc_wrapper': True}
INNER = {**FLAGS, 'no_cpython_wrapper': True}
"""for what compiled code calls: wrappers that unpack a scene's tuples take long to compile"""
if not WHY_PLAIN:
    from xpbd_ros.sim.backend import linking, narrowing
    FLAGS['pipeline_class'] = linking.WholeCompiler
    INNER['pipeline_class'] = linking.Compiler
try:
    from xpbd_ros.sim.backend.locked_cache import LockedCache
except (AttributeError, ImportError):
    LockedCache = None  # type: ignore[assignment,misc]


@contextmanager
def _no_collection():
    """Suspend garbage collection, which would walk the compiler's many objects often."""
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


def _dispatcher(function, cache_class: type | None, folder: Path | None, **flags):
    dispatcher = njit(**flags)(function)
    if folder is not None and cache_class is not None:
        before = config.CACHE_DIR
        config.CACHE_DIR = str(folder)
        try:
            dispatcher._cache = cache_class(function)
        finally:
            config.CACHE_DIR = before
    return dispatcher


def jit(function=None, *, inline: bool = False, cache_name: str | None = 'kernels'):
    """
    Compile a module-level kernel, GIL released, cached on disk.

    A kernel makes no arrays: those that it gets outlive the call, so references are not counted.

    Python and compiled code call a kernel alike. For each of them it is compiled at its first
    call; for compiled code as a part of its caller, once for all constants of a type and whatever
    fields of named tuples it does not read (``narrowing``).

    Parameters
    ----------
    inline : expand the kernel where it is called. Numba passes a NamedTuple by copying all of its
        fields, which costs more than a small kernel for one particle
    cache_name : separates the caches of functions whose signatures hold other scenes' types, since
        reading such a cache would import effects that this scene does not name; None: not cached

    """
    def compile_(function):
        folder = None if cache_name is None else (
            CACHE_FOLDER / ('plain' if WHY_PLAIN else 'linked') / cache_name)
        flags = {'forceinline': inline}
        kernel = _dispatcher(function, LockedCache, folder, **{**FLAGS, **flags})
        if WHY_PLAIN:
            return kernel
        compile_for = kernel._compile_for_args
        part = cache(lambda: _dispatcher(function, linking.PartCache, folder and folder / 'parts',
                                         **{**INNER, **flags}))    # if compiled code calls it

        def compile_quietly(*arguments, **keywords):
            with _no_collection():
                return compile_for(*arguments, **keywords)
        kernel._compile_for_args = compile_quietly
        kernel.get_call_template = lambda kinds, named: part().get_call_template(
            narrowing.narrowed(function, [types.unliteral(kind) for kind in kinds]), named)
        kernel.get_overload = lambda signature: part().get_overload(signature)
        kernel.part = part
        linking.KERNELS.add(id(kernel))
        return kernel
    return compile_ if function is None else compile_(function)


def inline(stub):
    """Register the implementation of a stub, expanded where it is called."""
    return overload(stub, jit_options={**INNER, 'forceinline': True})
