"""Tuples of arrays as words, from which kernels read the tuples."""

import copy
from typing import NamedTuple
import weakref

import numpy as np
import pytest

from support.scenes import hang
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.packed_arguments import Packed, unpacked
from xpbd_ros.sim.commands import SetKey
from xpbd_ros.sim.stepping import step


class Part(NamedTuple):
    """One leaf of each type."""

    table: np.ndarray
    flags: np.ndarray
    every_other: np.ndarray
    scale: float
    single: np.float32
    count: int
    small: np.int8
    on: bool
    nothing: None


Part.__module__ = 'xpbd_ros.sim.test'    # so that it is passed as the package's own tuples are


@jit(cache_name=None)
def read(values, found):
    """Copy what a packed tuple holds to ``found``, and change one of its arrays."""
    parts = unpacked(values)
    first, last = parts[0], parts[1]
    found[0], found[1] = first.table[1, 2], first.table.shape[1]
    found[2], found[3] = first.every_other[1], len(first.every_other)
    found[4], found[5], found[6] = first.scale, first.single, first.count
    found[7], found[8] = first.small, 1.0 if first.on else 0.0
    found[9] = 1.0 if first.nothing is None else 0.0
    found[10], found[11] = last.scale, last.table.size
    first.flags[1] = True


def a_part(**changed) -> Part:
    """Return a part with small arrays."""
    return Part(np.arange(6.0).reshape(2, 3), np.zeros(2, np.bool_), np.arange(6.0)[::2], 0.5,
                np.float32(0.25), 1 << 40, np.int8(-7), True, None)._replace(**changed)


def test_each_leaf_comes_back():
    part, found = a_part(), np.zeros(12)
    read(Packed((part, a_part(scale=-2.0, table=np.zeros((4, 1))))), found)
    assert found.tolist() == [5.0, 3.0, 2.0, 3.0, 0.5, 0.25, 2.0**40, -7.0, 1.0, 1.0, -2.0, 4.0]
    assert part.flags.tolist() == [False, True]


def test_it_keeps_its_arrays_alive():
    part = a_part()
    table, values = weakref.ref(part.table), Packed((part, a_part()))
    del part
    assert table() is not None
    del values
    assert table() is None


@pytest.fixture
def counted(monkeypatch) -> list:
    """Return a list to which all that steps pack is added."""
    found = []

    class Counted(Packed):
        def __init__(self, values):
            found.append(values)
            super().__init__(values)
    monkeypatch.setattr(step, 'Packed', Counted)
    return found


@pytest.mark.parametrize('threads', [1, 3])
def test_a_step_packs_once(counted, threads):
    simulation = compile_scene(load_scene('swing', {'solver.threads': threads,
                                                    'solver.substeps': 4,
                                                    'solver.method': 'line'}))
    for _ in range(5):
        simulation.step()
    assert len(counted) == 2, 'effects, and the state'
    simulation.step([SetKey('gravity', (0.0, 0.0, -9.0))])    # rebuilds the effects
    simulation.step()
    assert len(counted) == 3
    other = copy.deepcopy(simulation)
    other.step()
    assert len(counted) == 5, 'its arrays are elsewhere'
    simulation.step()
    assert len(counted) == 5
    assert other.hash() == simulation.hash()


def test_an_error_estimate_leaves_nothing_packed(counted):
    simulation = hang()
    simulation.step(keep=True)
    before = len(counted)
    end = simulation.start.end(2)
    assert len(counted) == before + 2, 'copies of effects and state'
    counted.clear()
    x = weakref.ref(end.x)
    del end
    assert x() is None
    simulation.step()
    assert not counted, 'its own are still packed'


def test_what_a_step_keeps_is_bounded(counted):
    known, parts = {}, [(a_part(count=k),) for k in range(10)]
    for values in parts + parts[-1:]:
        found = step._packed(values, known)
        assert found is known[tuple(map(id, values))]
        assert len(known) <= step.KEPT
    assert len(counted) == 10
