"""Where compiled kernels are kept, and how they are compiled."""

import fcntl
from importlib import import_module
from pkgutil import iter_modules
from threading import Thread

from numba import config
from numba.core.dispatcher import Dispatcher
import pytest
from sim.small import hang

from xpbd_ros.sim import jit
from xpbd_ros.sim.packs import _fill as pack_kernel
from xpbd_ros.sim.state import begin, Substep


@pytest.fixture
def nowhere(tmp_path):
    """Return a path under which no folder can be made."""
    (tmp_path / 'file').write_text('')
    return str(tmp_path / 'file' / 'folder')


def test_the_cache_is_where_the_user_says_and_changes_with_the_sources(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'xdg'))
    monkeypatch.delenv('NUMBA_CACHE_DIR', raising=False)
    folder = jit._cache_folder()
    assert folder.parent == tmp_path / 'xdg' / 'xpbd_ros'
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'numba'))
    assert jit._cache_folder() == tmp_path / 'numba' / 'xpbd_ros' / folder.name
    assert jit._cache_folder().is_dir()
    monkeypatch.setattr(jit, '__file__', str(tmp_path / 'package' / 'sim' / 'jit.py'))
    other = jit._sources_hash()
    assert other != folder.name
    (tmp_path / 'package' / 'effects').mkdir(parents=True)
    (tmp_path / 'package' / 'effects' / 'new.py').write_text('x = 1')
    another = jit._sources_hash()
    assert another not in (other, folder.name)
    monkeypatch.setattr(jit, 'BITS', 2 * jit.BITS)    # the layout of all arrays depends on it
    assert jit._sources_hash() not in (another, other, folder.name)


def test_without_a_place_to_write_it_is_a_temporary_one(nowhere, monkeypatch, tmp_path):
    monkeypatch.setenv('NUMBA_CACHE_DIR', nowhere)
    monkeypatch.setattr(jit.tempfile, 'gettempdir', lambda: str(tmp_path))
    assert jit._cache_folder().parent == tmp_path / 'xpbd_ros'
    monkeypatch.setattr(jit.tempfile, 'gettempdir', lambda: nowhere)
    monkeypatch.setattr(jit.tempfile, 'mkdtemp', lambda prefix: str(tmp_path / prefix))
    assert jit._cache_folder() == tmp_path / 'xpbd_ros_'


def test_kernels_release_the_interpreter_and_leave_numbas_own_cache_alone():
    assert begin.targetoptions['nogil']
    assert not begin.targetoptions.get('fastmath')
    assert str(jit.CACHE_FOLDER) in begin.stats.cache_path
    assert str(jit.CACHE_FOLDER) != config.CACHE_DIR


def test_variants_are_written_by_one_process_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr(jit, 'CACHE_FOLDER', tmp_path)

    @jit.jit
    def half(x):
        return 0.5 * x
    with open(tmp_path / 'lock', 'ab') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        thread = Thread(target=half, args=(1.0,))
        thread.start()
        thread.join(1.0)
        assert thread.is_alive(), 'it waits'
        assert not list(tmp_path.rglob('*.nbi'))
    thread.join()
    assert list(tmp_path.rglob('*.nbi'))
    half(1)
    assert len(list(tmp_path.rglob('*.nbc'))) == 2


def test_no_kernel_allocates_but_what_runs_when_a_scene_is_compiled():
    """Without a runtime for it Numba refuses to compile an array that a kernel makes."""
    allocates = set()
    for name in ('xpbd_ros.effects', 'xpbd_ros.sim'):
        for info in iter_modules(import_module(name).__path__, f'{name}.'):
            for each in vars(import_module(info.name)).values():
                if isinstance(each, Dispatcher) and each.targetoptions['_nrt']:
                    allocates.add(each)
    assert allocates == {pack_kernel}


def test_a_part_of_a_step_refuses_calls_from_python():
    """And does not crash; also once compiled code has called it."""
    simulation = hang()
    for _ in range(2):
        with pytest.raises(TypeError, match='begin: only compiled code can call this'):
            begin(simulation.state, Substep(0.1, 0.0, 1.0))
        simulation.step()
