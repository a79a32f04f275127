"""
Arrays on a card: one piece of memory for all, what the host changed goes up, what it reads down.

Views of one array stay views of it. The host's copy of an array that kernels write is older than
the card's. So a change by the host is what differs from the host's array as it was last in step
with the card, element by element. Arrays that are in step after every frame go up as they are.
"""

from collections.abc import Iterable
from typing import Any
import weakref

import numpy as np

ALIGNED = 256
"""bytes"""
LARGE = 2**16
"""bytes of an array whose pages are worth locking"""


def base_of(array: np.ndarray) -> np.ndarray:
    """Return the array that owns the memory of a view."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def words_of(array: np.ndarray) -> np.ndarray:
    """Return the elements of a contiguous array as whole numbers of the same bits, a view."""
    return array.reshape(-1).view(f'u{array.itemsize}')


class DeviceMemory:
    """
    The arrays of a simulation on a card.

    Parameters
    ----------
    card : ``cuda.Card``, or one that is emulated
    arrays : all that kernels get

    """

    def __init__(self, card: Any, arrays: Iterable[np.ndarray]):
        self._card = card
        self._bases: dict[int, np.ndarray] = {}
        for array in arrays:
            if array.nbytes:
                base = base_of(array)
                self._bases[id(base)] = base
        self._places, size = {}, ALIGNED
        for key, base in self._bases.items():
            self._places[key] = size
            size += ALIGNED * (1 + -(-base.nbytes // ALIGNED))
        self.size = size
        """bytes"""
        self._start = card.allocate(size)
        self._locked: list[np.ndarray] = []
        self._release = weakref.finalize(self, release, card, self._start, self._locked)
        self._known: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for array in self._bases.values():
            card.put(self.address(array), array)

    def address(self, array: np.ndarray) -> int:
        """Return where an array is on the card; anywhere on it for an empty one."""
        if not array.nbytes:
            return self._start
        base = base_of(array)
        return self._start + self._places[id(base)] + array.ctypes.data - base.ctypes.data

    def remember(self, arrays: Iterable[np.ndarray]) -> None:
        """Take the host's arrays, as they are, for what the card knows of the host."""
        for array in arrays:
            known = self._known.get(id(array))
            if known is None:
                self._known[id(array)] = array, array.copy()
            else:
                known[1][...] = array

    def upload(self, arrays: Iterable[np.ndarray]) -> None:
        """Bring the host's changes since ``remember`` to the card."""
        for array in arrays:
            _, before = self._known[id(array)]
            now, old = words_of(array), words_of(before)
            if not np.array_equal(now, old):
                changed = now != old
                merged = np.empty_like(now)
                self._card.get(self.address(array), merged)
                merged[changed] = now[changed]
                self._card.put(self.address(array), merged)
                before[...] = array

    def put(self, arrays: Iterable[np.ndarray]) -> None:
        """Bring arrays, or contiguous parts of them, to the card as they are."""
        for array in arrays:
            self._card.put(self.address(array), array)

    def get(self, arrays: Iterable[np.ndarray]) -> None:
        """Bring arrays, or contiguous parts of them, to the host."""
        for array in arrays:
            if array.nbytes:
                self._card.get(self.address(array), words_of(array))

    def lock(self, arrays: Iterable[np.ndarray]) -> None:
        """Lock pages of the host's memory, where the system allows it, for faster copies."""
        for array in arrays:
            if array.nbytes >= LARGE and self._card.lock(array):
                self._locked.append(array)

    def free(self) -> None:
        """Give the card's memory back; that happens too when nothing refers to this any more."""
        self._release()


def release(card: Any, start: int, locked: list[np.ndarray]) -> None:
    """Give memory back, and unlock arrays before their own memory can be another's."""
    for array in locked:
        card.unlock(array)
    card.free(start)
