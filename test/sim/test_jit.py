"""Where compiled kernels are kept, and how they are compiled."""

import fcntl
import gc
from importlib import import_module
import os
from pkgutil import walk_packages
import subprocess
import sys
from threading import Thread
from types import ModuleType

from numba import config, njit, types, TypingError
from numba.core import codegen
from numba.core.dispatcher import Dispatcher
import numpy as np
import pytest

from support.scenes import hang
from xpbd_ros.sim.backend import disk_cache, jit, linking, locked_cache
from xpbd_ros.sim.particles.integration import begin
from xpbd_ros.sim.particles.state import Substep


@pytest.fixture
def nowhere(tmp_path):
    """Return a path under which no folder can be made."""
    (tmp_path / 'file').write_text('')
    return str(tmp_path / 'file' / 'folder')


def test_the_cache_folder_follows_the_user_and_the_sources(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'xdg'))
    monkeypatch.delenv('NUMBA_CACHE_DIR', raising=False)
    folder = disk_cache.cache_folder()
    assert folder.parent == tmp_path / 'xdg' / 'xpbd_ros'
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'numba'))
    assert disk_cache.cache_folder() == tmp_path / 'numba' / 'xpbd_ros' / folder.name
    assert disk_cache.cache_folder().is_dir()
    monkeypatch.setattr(disk_cache, '__file__',
                        str(tmp_path / 'package' / 'sim' / 'backend' / 'disk_cache.py'))
    other = disk_cache.sources_hash()
    assert other != folder.name
    (tmp_path / 'package' / 'effects').mkdir(parents=True)
    (tmp_path / 'package' / 'effects' / 'new.py').write_text('x = 1')
    another = disk_cache.sources_hash()
    assert another not in (other, folder.name)
    monkeypatch.setattr(disk_cache, 'BITS', 2 * disk_cache.BITS)    # arrays are laid out by it
    wider = disk_cache.sources_hash()
    assert wider not in (another, other, folder.name)
    monkeypatch.setattr(config, 'BOUNDSCHECK', 1)    # Numba keeps both under one name
    assert disk_cache.sources_hash() not in (wider, another, other, folder.name)


def test_without_a_place_to_write_it_is_a_temporary_one(nowhere, monkeypatch, tmp_path):
    monkeypatch.setenv('NUMBA_CACHE_DIR', nowhere)
    monkeypatch.setattr(disk_cache.tempfile, 'gettempdir', lambda: str(tmp_path))
    assert disk_cache.cache_folder().parent == tmp_path / 'xpbd_ros'
    monkeypatch.setattr(disk_cache.tempfile, 'gettempdir', lambda: nowhere)
    monkeypatch.setattr(disk_cache.tempfile, 'mkdtemp', lambda prefix: str(tmp_path / prefix))
    assert disk_cache.cache_folder() == tmp_path / 'xpbd_ros_'


def test_kernels_release_the_gil_and_leave_numbas_cache_alone():
    assert begin.targetoptions['nogil']
    assert not begin.targetoptions.get('fastmath')
    assert str(jit.CACHE_FOLDER) in begin.stats.cache_path
    assert str(jit.CACHE_FOLDER) != config.CACHE_DIR


def test_variants_are_written_by_one_process_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr(jit, 'CACHE_FOLDER', tmp_path)
    monkeypatch.setattr(locked_cache, 'CACHE_FOLDER', tmp_path)

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


def test_an_index_that_cannot_be_read_is_discarded(tmp_path, monkeypatch):
    """It names a type whose module cannot be imported here, or a file is truncated."""
    monkeypatch.setattr(jit, 'CACHE_FOLDER', tmp_path)
    monkeypatch.setattr(locked_cache, 'CACHE_FOLDER', tmp_path)

    def first(pair):
        return pair[0]
    module = ModuleType('of_another_process')
    exec('from typing import NamedTuple\nclass Pair(NamedTuple):\n    x: float\n    y: float',
         module.__dict__)

    def write_of_another_process():
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, module.__name__, module)
            assert jit.jit(first)(module.Pair(2.0, 3.0)) == 2.0
    write_of_another_process()
    with monkeypatch.context() as patch:    # as if it were written after the index was read
        patch.setattr(locked_cache.LockedCache, 'load_overload', lambda *_: None)
        assert jit.jit(first)((3.0, 5.0)) == 3.0
    write_of_another_process()
    assert jit.jit(first)((4.0, 5.0)) == 4.0
    kernel = jit.jit(first)
    assert kernel((6.0, 7.0)) == 6.0 and kernel.stats.cache_hits
    for kind in ('*.nbc', '*.nbi'):
        for file in tmp_path.rglob(kind):
            file.write_bytes(file.read_bytes()[:-30])
        assert jit.jit(first)((8.0, 9.0)) == 8.0


def test_no_kernel_allocates():
    """Without a runtime for it Numba refuses to compile an array that a kernel makes."""
    kernels = set()
    for name in ('xpbd_ros.effects', 'xpbd_ros.sim'):
        for info in walk_packages(import_module(name).__path__, f'{name}.'):
            kernels |= {each for each in vars(import_module(info.name)).values()
                        if isinstance(each, Dispatcher)}
    assert kernels
    assert not [kernel for kernel in kernels if kernel.targetoptions['_nrt']]


@jit.jit
def third(x):
    """Return a third."""
    return x / 3.0


@jit.jit
def thirds(x, count):
    """Take a third so many times."""
    for _ in range(count):
        x = third(x)
    return x


@jit.jit
def thirds_of(xs, count):
    """Do so with all."""
    for k in range(len(xs)):
        xs[k] = thirds(xs[k], count)


def test_callees_become_machine_code_only_within_their_kernel(monkeypatch):
    """Numba makes it of each function by itself as well, and of all that this one calls."""
    made = []
    finalize = codegen.JITCodeLibrary._finalize_specific
    monkeypatch.setattr(codegen.JITCodeLibrary, '_finalize_specific',
                        lambda self: made.append(self.name) or finalize(self))
    xs = np.array([2.0, 5.0])
    thirds_of(xs, 3)
    assert (xs == [2.0 / 3.0 / 3.0 / 3.0, 5.0 / 3.0 / 3.0 / 3.0]).all()
    assert made in (['thirds_of'], []), 'or it was in the cache'
    assert not thirds.overloads and not third.overloads
    assert thirds(2.0, 2) == 2.0 / 3.0 / 3.0
    assert thirds.overloads, 'Python has one of its own'


def test_parts_belong_to_their_kernel_under_names_of_its_own(monkeypatch):
    """
    So arguments that they do not read are dropped.

    Under the old name the JIT would bind calls of the whole part, from other libraries, to it.
    """
    kinds = {}
    optimise = codegen.CPUCodeLibrary._optimize_final_module
    monkeypatch.setattr(codegen.CPUCodeLibrary, '_optimize_final_module', lambda self: (
        kinds.update((each.name, each.linkage.name) for each in self._final_module.functions
                     if not each.is_declaration) or optimise(self)))
    xs = np.array([2.0])
    whole = njit(**jit.FLAGS)(thirds_of.py_func)
    whole(xs, 1)
    own = {name for name, linkage in kinds.items() if linkage == 'internal'}
    assert {name.split('_ZN')[0] for name in own} == {'own.'}
    assert any('thirds' in name for name in own)
    njit(lambda x: thirds(x, 2))(2.0)    # Numba's own compiler links the part as it stands
    assert {linkage for name, linkage in kinds.items()
            if name.startswith('_ZN') and 'thirds' in name} == {'external', 'linkonce_odr'}


def picked(values, places):
    """Return the value at the first of some places, and the last one."""
    return values[places[0]], values[-1]


def test_kernels_alone_do_not_ask_whether_an_index_is_negative(monkeypatch):
    """They count from the end by constants only."""
    written = []
    optimise = codegen.CPUCodeLibrary._optimize_final_module
    monkeypatch.setattr(codegen.CPUCodeLibrary, '_optimize_final_module', lambda self: (
        written.append(str(self._final_module)) or optimise(self)))
    values = np.arange(3.0)
    assert njit(**jit.FLAGS)(picked)(values, np.array([1])) == (1.0, 2.0)
    assert not any('icmp slt' in code for code in written)
    assert njit(picked)(values, np.array([-3])) == (0.0, 2.0)
    assert any('icmp slt' in code for code in written)


def test_parts_are_kept_for_other_kernels(tmp_path, monkeypatch, recwarn):
    monkeypatch.setattr(jit, 'CACHE_FOLDER', tmp_path)
    counts = []
    for _ in range(2):
        monkeypatch.setattr(linking, 'KERNELS', set())
        for name in ('third', 'thirds'):    # as another process would have them
            monkeypatch.setitem(globals(), name, jit.jit(globals()[name].py_func))
        thirds.part().compile((types.float64, types.int64))
        counts.append([len(each.part().stats.cache_hits) for each in (third, thirds)])
    assert counts == [[0, 0], [0, 1]], 'what it calls is in it'
    whole = jit.jit(thirds_of.py_func)
    whole.part().compile((types.float64[::1], types.int64))
    xs = np.array([2.0])
    whole(xs, 2)
    assert xs == 2.0 / 3.0 / 3.0
    assert not recwarn.list


def test_the_garbage_collector_waits_while_a_kernel_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setattr(jit, 'CACHE_FOLDER', tmp_path)
    monkeypatch.setitem(globals(), 'third', jit.jit(third.py_func))
    collected = []
    gc.callbacks.append(lambda phase, info: collected.append(phase))
    try:
        third(1.0)
        assert len(collected) <= 2, 'once at the end'
        assert gc.isenabled()
    finally:
        gc.callbacks.pop()
    with pytest.raises(TypingError):
        third('one')
    assert gc.isenabled()


def test_a_part_of_a_step_can_be_called_from_python():
    """Also once compiled code has called it."""
    simulation = hang()
    for _ in range(2):
        state = simulation.state
        v = state.v.copy()
        begin(state, Substep(0.125, 0.0, 1.0))
        change = np.where(state.inv_mass > 0.0, 0.125 * state.gravity[:, None], 0.0)
        assert np.allclose(state.v - v, change, atol=1e-12)
        simulation.step()


HASH = """
from support.scenes import hang, run
from xpbd_ros.sim.backend.jit import WHY_PLAIN
simulation = hang(method='line', integrator='bdf2')
run(simulation, 20)
print(f'{simulation.hash():016x}', WHY_PLAIN)
"""


def python(code: str, **environment) -> str:
    """Return what code prints in a process of its own."""
    done = subprocess.run(
        [sys.executable, '-c', code], text=True, capture_output=True, check=False,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path)), **environment})
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_plain_njit_gives_the_same_bits(tmp_path):
    linked, plain = python(HASH), python(HASH, XPBD_ROS_PLAIN_NJIT='1')
    assert plain == f'{linked} XPBD_ROS_PLAIN_NJIT is set'


@pytest.mark.parametrize(('change', 'reason'), [
    ('import numba.core.codegen as c; del c.JITCodeLibrary', 'lacks internals'),
    ('import numba; numba.__version__ = "0.99.0"', 'is newer than 0.68, the newest tested')])
def test_another_numba_compiles_through_plain_njit(change, reason):
    assert reason in python(f"""
{change}
from xpbd_ros.sim.backend.jit import WHY_PLAIN
from xpbd_ros.sim.geometry.quaternion import rotate
assert rotate(0.0, 0.0, 1.0, 0.0, 1.0, 2.0, 3.0) == (-1.0, -2.0, 3.0)
print(WHY_PLAIN)
""")


def test_a_numba_without_its_templates_of_arrays_tries_those_of_vectors_last():
    assert python("""
import numba.core.typing.arraydecl as declared
del declared.GetItemBuffer
from xpbd_ros.sim.backend import operators
from xpbd_ros.sim.backend.simd import Vector
import operator
from numba import types
from numba.core.registry import cpu_target
cpu_target.typing_context.refresh()
vector = Vector(types.float64, 4)
for kinds in ((vector, types.float64), (types.float64[:, ::1], types.int64)):
    known = cpu_target.typing_context.resolve_function_type(
        operator.mul if vector in kinds else operator.getitem, kinds, {})
    print(operators.FIRST, known.return_type)
""").splitlines() == ['False Vector(float64 x 4)', 'False array(float64, 1d, C)']
