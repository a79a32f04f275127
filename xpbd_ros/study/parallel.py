"""
Run independent tasks in this process, in processes beside it, or on Dask.

Dask (extra ``cluster``) restarts a worker that was killed and repeats its task; a process pool
ends with it. Results do not depend on where a task runs.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
import logging
import multiprocessing
import signal
from typing import Any

from xpbd_ros import __version__
from xpbd_ros.errors import brief, InputError

PATIENCE = '10s'
"""time to connect to a scheduler, and for it to have a worker"""
QUIET = {'distributed.worker.profile.enabled': False, 'distributed.admin.tick.interval': '1s',
         'distributed.admin.system-monitor.interval': '5s',
         'distributed.worker.memory.monitor-interval': '5s'}
"""settings of Dask so that a local worker's own tasks seldom interrupt the run that it computes"""


def run_tasks(function: Callable[..., Any], tasks: Sequence[tuple], *, processes: int, what: str,
              progress: Callable[[Iterable, str], Iterable], scheduler: str | None = None,
              dask: bool = False, lost: Callable[[int], Any] | None = None
              ) -> Iterator[tuple[int, Any]]:
    """
    Yield (number of a task, ``function(*task)``) as the tasks finish.

    If the caller stops early, tasks that have not begun are dropped and local processes end.

    Parameters
    ----------
    function : importable by its name in another process, or a ``functools.partial`` of one
    tasks : arguments of each task
    processes : number of local processes; 1 runs the tasks in this one
    what : unit of the progress bar
    progress : wraps a list of tasks to show progress
    scheduler : address of a Dask scheduler, whose workers run the tasks instead
    dask : whether local processes are Dask workers
    lost : gives the result of a task whose workers were killed; None raises

    Raises
    ------
    InputError : Dask, its scheduler or workers are missing; or a worker was killed

    """
    if processes == 1 and scheduler is None or not tasks:
        for k in progress(range(len(tasks)), what):
            yield k, function(*tasks[k])
        return
    pool = _dask if dask or scheduler is not None else _processes
    with pool(min(processes, len(tasks)), scheduler) as (submit, completed, killed):
        numbers = {submit(function, *task): k for k, task in enumerate(tasks)}
        done, suspects = completed(list(numbers)), []
        for _ in progress(range(len(tasks)), what):
            future = next(done)
            number = numbers.pop(future)
            try:
                yield number, future.result()
            except killed as error:
                if lost is None:
                    raise InputError(f'{what}: a worker process was killed; it may have run out '
                                     'of memory') from error
                suspects.append(number)
        for number in suspects:    # alone, as another task may have killed their workers
            try:
                yield number, submit(function, *tasks[number]).result()
            except killed:
                assert lost is not None
                yield number, lost(number)


@contextmanager
def _processes(count: int, _: str | None) -> Iterator[tuple]:
    """Yield how to submit tasks to local processes; these end if the caller stops early."""
    context = multiprocessing.get_context('spawn')
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(count, context, _ignore_interrupts)
    try:
        yield pool.submit, as_completed, BrokenProcessPool
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _ignore_interrupts() -> None:
    """Leave interrupts to the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _dask(count: int, scheduler: str | None) -> Iterator[tuple]:
    """Yield how to submit tasks to a Dask scheduler; None starts one with local workers."""
    try:
        import distributed
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        raise InputError(('--scheduler needs' if scheduler else 'several workers need')
                         + f" Dask ({error}); pip install 'xpbd_ros[cluster]'"
                         + ('' if scheduler else ', or take --workers 1')) from None
    with _quiet(), _client(distributed, count, scheduler) as client:
        def submit(function, *task):
            return client.submit(function, *task, pure=False)

        yield (submit, partial(distributed.as_completed, loop=client.loop), KilledWorker)


@contextmanager
def _client(distributed, count: int, scheduler: str | None) -> Iterator[Any]:
    if scheduler is not None:
        try:
            distributed.comm.get_address_host_port(scheduler)    # else a client hangs
            client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(f'--scheduler {scheduler}: no Dask scheduler answers there '
                             f'({brief(str(error)) or type(error).__name__})') from None
        with client:
            try:
                client.wait_for_workers(1, timeout=PATIENCE)    # they may be starting
            except TimeoutError:
                raise InputError(f'--scheduler {scheduler}: has no workers; start some with '
                                 f"'dask worker {scheduler}'") from None
            _check_versions(client, scheduler)
            yield client
        return
    import dask
    with (dask.config.set(QUIET),
          distributed.LocalCluster(n_workers=count, threads_per_worker=1, processes=True,
                                   host='127.0.0.1', dashboard_address='127.0.0.1:0',
                                   memory_limit=0, silence_logs=logging.CRITICAL,
                                   preload=[__name__]) as cluster,
          distributed.Client(cluster, set_as_default=False) as client):
        yield client


def _check_versions(client, scheduler: str) -> None:
    """Raise InputError if a worker has another version of the package, or none."""
    try:
        found = set(client.run(version).values())
    except Exception as error:    # of any kind, from the worker
        raise InputError(f'--scheduler {scheduler}: a worker cannot import xpbd_ros '
                         f'({type(error).__name__}: {brief(str(error))})') from None
    if found != {version()}:
        raise InputError(f'--scheduler {scheduler}: a worker has another version of xpbd_ros: '
                         f'{", ".join(sorted(found - {version()}))} instead of {version()}')


def version() -> str:
    """Return the version of the package."""
    return __version__


def dask_setup(worker) -> None:
    """Set up a local Dask worker, which imports this module at its start."""
    _ignore_interrupts()


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Dask's log, whose reports of lost workers are no news to the user."""
    logger = logging.getLogger('distributed')
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
