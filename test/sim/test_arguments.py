"""How named tuples are passed to kernels."""

import os
import subprocess
import sys
from typing import NamedTuple

from numba import njit, typeof
from numba.core.datamodel import default_manager
import numpy as np
import pytest

from xpbd_ros.sim.backend import jit as backend_jit
from xpbd_ros.sim.backend.jit import jit, WHY_PLAIN
from xpbd_ros.sim.backend.narrowing import fields_read

pytestmark = pytest.mark.skipif(bool(WHY_PLAIN), reason=WHY_PLAIN)


class Inner(NamedTuple):
    """One array, as the package's own kinds."""

    flags: np.ndarray
    scale: float


class Outer(NamedTuple):
    """Arrays of each layout, nested."""

    line: np.ndarray
    table: np.ndarray
    block: np.ndarray
    every_other: np.ndarray
    inner: Inner
    nothing: None


class Foreign(NamedTuple):
    """A named tuple of another package."""

    line: np.ndarray


class Pair(NamedTuple):
    """Two of a kind, which Numba has as an array."""

    first: float
    second: float


for _kind in (Inner, Outer):
    _kind.__module__ = 'xpbd_ros.sim.test'


@jit
def _write(outer):
    for i in range(outer.table.shape[0]):
        for j in range(outer.table.shape[1]):
            outer.table[i, j] += 10.0 * i + j
    outer.block[1, 2, 3] = 7.0
    for k in range(4):
        outer.block[0][1][k] += outer.table[1, k]
    for k in range(len(outer.every_other)):
        outer.every_other[k] = outer.line[k] * outer.inner.scale
    outer.inner.flags[1] = True


@jit
def change(outer, sizes):
    """Write to all arrays, in a kernel that this one calls, and tell their sizes and strides."""
    _write(outer)
    sizes[0] = outer.line.size
    sizes[1], sizes[2] = outer.table.size, outer.block.size
    for k in range(3):
        sizes[3 + k] = outer.block.strides[k]
    sizes[6], sizes[7] = outer.table.itemsize, outer.every_other.strides[0]
    sizes[8] = outer.inner.flags.size


def an_outer() -> Outer:
    """Return a tuple of small arrays."""
    return Outer(np.arange(3.0), np.zeros((2, 4), np.float32), np.zeros((2, 3, 4)),
                 np.zeros(6)[::2], Inner(np.zeros(2, np.bool_), 0.5), None)


def test_kernels_read_and_write_arrays_of_tuples():
    outer, expected, sizes = an_outer(), an_outer(), np.zeros(9, np.int64)
    change(outer, sizes)
    _write.py_func(expected)
    for found, right in zip((*outer[:4], outer.inner.flags),
                            (*expected[:4], expected.inner.flags)):
        assert np.any(right)
        assert np.array_equal(found, right)
    assert sizes.tolist() == [3, 8, 24, 96, 32, 8, 4, 16, 2]


@jit
def _swapped(outer, flags):
    return Outer(outer.line, outer.table, outer.block, outer.every_other,
                 Inner(flags, 3.0), outer.nothing)


@jit
def change_swapped(outer, flags):
    """Write to a tuple that another kernel makes."""
    other = _swapped(outer, flags)
    other.inner.flags[0] = True
    other.table[1, 2] = other.inner.scale
    other.every_other[1] = other.table.size


@jit
def _twice(inner, outer, scale):
    if outer.nothing is None:
        inner.flags[0] = inner.scale > scale
    _write(outer)
    return inner.flags if inner is not None else outer.inner.flags


@jit
def _whole(outer, inner, other):
    inner = outer.inner
    return _twice(inner, outer, 1.0), [other]


@jit
def _again(outer, inner):
    if inner.scale > 1.0:
        _again(inner, outer)


def test_what_a_kernel_reads_includes_what_others_read_for_it():
    of_write = {'line', 'table', 'block', 'every_other', 'inner'}
    assert fields_read(_write.py_func) == [of_write]
    assert fields_read(change.py_func) == [of_write, None], 'an array is used as a whole'
    assert fields_read(_twice.py_func) == [{'flags', 'scale'}, of_write | {'nothing'}, None]
    assert fields_read(_whole.py_func) == [of_write | {'nothing'}, None, None], 'a name is bound'
    assert fields_read(_again.py_func) == [None, None], 'it calls itself'
    assert fields_read(eval('lambda outer: outer.line')) == [None], 'it has no source file'


def test_sources_are_read_whatever_the_encoding_of_the_locale():
    text = ('from xpbd_ros.sim.backend.narrowing import fields_read\n'
            'from xpbd_ros.sim.particles.integration import begin\n'
            "assert 'x_prev' in fields_read(begin.py_func)[0]")
    subprocess.run([sys.executable, '-c', text], check=True, env={
        **os.environ, 'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'})


def test_a_part_is_compiled_once_whatever_it_does_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(backend_jit, 'CACHE_FOLDER', tmp_path)
    write = jit(_write.py_func)
    monkeypatch.setitem(globals(), '_write', write)
    caller, found = jit(change.py_func), []
    for nothing in (None, 1.0, np.zeros(2)):
        outer, sizes = an_outer()._replace(nothing=nothing), np.zeros(9, np.int64)
        caller(outer, sizes)
        found.append(outer.table.tolist())
    assert found == 3 * [[[0.0, 1.0, 2.0, 3.0], [10.0, 11.0, 12.0, 13.0]]]
    assert len(caller.overloads) == 3
    assert len(write.part().overloads) == 1


def test_kernels_make_tuples_and_return_them_to_each_other():
    outer, flags = an_outer(), np.zeros(2, np.bool_)
    change_swapped(outer, flags)
    assert flags.tolist() == [True, False] and not outer.inner.flags.any()
    assert outer.table[1, 2] == 3.0 and outer.every_other[1] == 8.0


def test_numba_without_our_flags_reads_the_tuples_and_keeps_no_array():
    read = njit(lambda outer: outer.block[1, 2, 3] + outer.every_other[1] + outer.inner.scale)
    outer = an_outer()
    outer.block[1, 2, 3], outer.every_other[1] = 4.0, 2.0
    held = [sys.getrefcount(each) for each in (*outer[:4], outer.inner.flags)]
    for _ in range(3):
        assert read(outer) == 6.5
    assert [sys.getrefcount(each) for each in (*outer[:4], outer.inner.flags)] == held
    assert njit(lambda foreign: foreign.line[1])(Foreign(outer.line)) == 1.0
    assert njit(lambda x: Pair(x, 2.0 * x))(0.5) == Pair(0.5, 1.0)


def test_a_contiguous_array_is_an_address_and_a_shape():
    def count(arguments) -> int:
        return (sum(map(count, arguments)) if isinstance(arguments, tuple) else 1)

    def arguments_of(value) -> int:
        return count(default_manager.lookup(typeof(value)).get_argument_type())
    line = np.zeros(3)
    assert arguments_of(line) == arguments_of(Foreign(line)) == 7, "Numba's own"
    assert arguments_of(Inner(line > 0.0, 1.0)) == 2 + 1
    assert arguments_of(an_outer()) == 2 + 3 + 4 + 7 + 3 + arguments_of(None)
