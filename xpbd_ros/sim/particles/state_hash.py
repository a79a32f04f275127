"""
A 64-bit hash of numbers, at the speed of memory.

Σ over all numbers of f(bits + n γ), modulo 2⁶⁴: n counts the numbers, γ is odd, and f is the
finaliser of SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators",
OOPSLA 2014). f and the addition are one-to-one, so a change of any one number changes the hash for
certain; changes of several cancel with the probability 2⁻⁶⁴ of any 64-bit hash. It compares runs;
it is no protection against forgery.
"""

from collections.abc import Iterable

import numpy as np

from xpbd_ros.sim.backend.jit import jit

GAMMA = np.uint64(0x9e3779b97f4a7c15)
"""γ: 2⁶⁴ over the golden ratio"""
FIRST, SECOND = np.uint64(0xbf58476d1ce4e5b9), np.uint64(0x94d049bb133111eb)
"""factors of f"""
A, B, C = np.uint64(30), np.uint64(27), np.uint64(31)
"""shifts of f"""
BITS = {4: np.uint32, 8: np.uint64}
"""by the size of a number [bytes]"""


def hashed(arrays: Iterable[np.ndarray], slots: np.ndarray) -> int:
    """
    Return the hash of some slots of arrays.

    Parameters
    ----------
    arrays : float32 or float64, each of shape (slots,) or (rows, slots), with contiguous rows
    slots : slots in the order in which they count, shape (n,)

    """
    total, count = 0, 0
    for array in arrays:
        rows = np.atleast_2d(array)
        total += int(mixed(rows.view(BITS[array.itemsize]), slots, np.uint64(count)))
        count += len(rows) * len(slots)
    return total % 2**64


@jit
def mixed(bits, slots, count):
    """Return Σ f(bits + n γ) over some slots of all rows, for n from ``count`` + 1 on."""
    total = np.uint64(0)
    for row in range(len(bits)):
        for i in range(len(slots)):
            count += np.uint64(1)
            z = bits[row, np.uint64(slots[i])] + count * GAMMA
            z = (z ^ (z >> A)) * FIRST
            z = (z ^ (z >> B)) * SECOND
            total += z ^ (z >> C)
    return total
