"""The hash of a state against its formula, and what it tells apart."""

import numpy as np
import pytest

from xpbd_ros.sim.particles.state_hash import hashed


def formula(arrays, slots) -> int:
    """Return Σ f(bits + n γ) modulo 2⁶⁴ in Python's integers."""
    total, n, mask = 0, 0, 2**64 - 1
    for array in arrays:
        for row in np.atleast_2d(array):
            for bits in row[slots].view(f'u{array.itemsize}').tolist():
                n += 1
                z = bits + n * 0x9e3779b97f4a7c15 & mask
                z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9 & mask
                z = (z ^ z >> 27) * 0x94d049bb133111eb & mask
                total += z ^ z >> 31
    return total & mask


@pytest.mark.parametrize('dtype', [np.float64, np.float32])
def test_the_hash_is_its_formula_whatever_the_layout(dtype):
    rng = np.random.default_rng(1)
    arrays = [rng.standard_normal((3, 40)).astype(dtype), rng.standard_normal(40).astype(dtype)]
    slots = rng.permutation(40)[:33]
    expected = formula(arrays, slots)
    assert hashed(arrays, slots) == expected
    moved = [array[..., slots].copy() for array in arrays]
    assert hashed(moved, np.arange(33)) == expected, 'the same numbers in other slots'
    padding = np.setdiff1d(np.arange(40), slots)
    for array in arrays:
        array[..., padding] = 7.0
    assert hashed(arrays, slots) == expected


def test_order_sign_and_place_count():
    values = np.array([[1.0, 2.0], [3.0, 0.0]])
    others = [values[:, ::-1].copy(), values[::-1].copy(), -values, values.astype(np.float32)]
    seen = {hashed([each], np.arange(2)) for each in (values, *others)}
    assert len(seen) == 5
