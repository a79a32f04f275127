"""Integers by PACK: comparison, copies of one number, and compression."""

import numpy as np
import pytest

from xpbd_ros.sim.backend import simd_integers
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_integers import compress, equal_bits, fill
from xpbd_ros.sim.backend.simd_records import PACK

NUMBERS = np.random.default_rng(0).integers(0, 5, 40).astype(np.int32)


def test_bits_tell_which_numbers_are_equal():
    @jit(cache_name=None)
    def found(numbers, begin, number):
        return equal_bits(numbers, begin, number)
    for begin in range(len(NUMBERS) - PACK + 1):
        for number in range(6):
            same = NUMBERS[begin:begin + PACK] == number
            assert found(NUMBERS, begin, np.int32(number)) == sum(
                1 << k for k in np.flatnonzero(same))


def test_a_number_fills_a_pack_and_no_more():
    @jit(cache_name=None)
    def write(numbers, begin, number):
        fill(numbers, begin, number)
    numbers = NUMBERS.copy()
    write(numbers, 3, np.int32(9))
    assert (numbers[3:3 + PACK] == 9).all()
    np.testing.assert_array_equal(np.delete(numbers, np.s_[3:3 + PACK]),
                                  np.delete(NUMBERS, np.s_[3:3 + PACK]))


@pytest.mark.parametrize('compresses', sorted({False, simd_integers.COMPRESSES}))
@pytest.mark.parametrize('permutes', sorted({False, simd_integers.PERMUTES}))
def test_chosen_numbers_stand_one_after_another(permutes, compresses, monkeypatch):
    monkeypatch.setattr(simd_integers, 'PERMUTES', permutes)
    monkeypatch.setattr(simd_integers, 'COMPRESSES', compresses)

    @jit(cache_name=None)
    def copy(source, begin, chosen, target, index):
        compress(source, begin, chosen, target, index)
    choices = [0, 1, 1 << PACK - 1, (1 << PACK) - 1,
               *np.random.default_rng(1).integers(0, 1 << PACK, 200)]
    for chosen in choices:
        target = np.full(30, -1, np.int32)
        copy(NUMBERS, 7, int(chosen), target, 5)
        wanted = NUMBERS[7:7 + PACK][[chosen >> k & 1 == 1 for k in range(PACK)]]
        np.testing.assert_array_equal(target[5:5 + len(wanted)], wanted)
        assert (target[:5] == -1).all()
        assert (target[5 + PACK:] == -1).all()
