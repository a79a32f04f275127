"""Calls that are written out where a stub is called."""

from typing import NamedTuple

from numba import njit
import numpy as np
import pytest

from xpbd_ros.sim.backend.emit import written_out
from xpbd_ros.sim.backend.jit import FLAGS, jit


class Pair(NamedTuple):
    """What is added, and whether."""

    numbers: tuple
    wanted: bool


@jit
def add(array, number):
    """Add a number to all."""
    for k in range(len(array)):
        array[k] += number


@jit
def negative(number):
    """Return the number with its sign turned."""
    return -number


def spread(array, pair):
    """Add what is wanted."""


@written_out(spread)
def _spread(writer, array, pair):
    writer.call(add, array, writer.number(0.5))
    with writer.only_if(writer.item(pair, 'wanted')):
        for k in range(len(writer.item(pair, 'numbers')[0])):
            writer.call(add, array, writer.call(
                negative, writer.item(writer.item(pair, 'numbers'), k)))


@njit(**FLAGS)
def _from_python(array, pair):
    spread(array, pair)


@pytest.mark.parametrize('numbers', [(), (1,), (1.0, 2.0), (1, 2.0)])
def test_the_calls_are_made_in_the_types_of_what_is_there(numbers):
    for wanted in (True, False):
        array = np.zeros(3)
        _from_python(array, Pair(numbers, wanted))
        assert (array == 0.5 - wanted * sum(numbers)).all()


def test_no_function_is_compiled_for_the_stub_itself():
    _from_python(np.zeros(3), Pair((1.0,), True))
    code = _from_python.inspect_llvm(_from_python.signatures[0])
    assert 'add' in code
    assert 'spread' not in code
