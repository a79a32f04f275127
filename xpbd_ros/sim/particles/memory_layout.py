"""
Where particles lie in memory: rows of a grid, each split by its columns; or any order.

Split into four, a row of columns 0 1 2 3 4 5 … is stored as 0 4 8 … | 1 5 9 … | 2 6 10 … | 3 7 11
…: parts of the same length, one after another. Constraints of the same shape, four columns apart,
then touch neighbouring places in memory and no particle twice: a vector of them is loaded,
projected and stored without a gather. Parts are padded to whole vectors, since a load that
overlaps half of a recent store has to wait for it, and a row is split into as many parts as leaves
the least padding; it takes an odd number of cache lines, so that columns do not crowd into a few
sets of the cache; and a grid has at least as many rows as a vector has lanes, for the lines that
run along them. The particles of a mesh lie in the order of their ranks, padded to
whole vectors at the end. Padding has neither mass nor mobility, so nothing moves it.

A load waits for a store that is under way to the same place of another page. So arrays made one
after another begin at different places in their pages, and so do x, y and z of one array.
"""

from dataclasses import dataclass
from itertools import count

import numpy as np

from xpbd_ros.sim.backend.simd import lane_count

PARTS = range(4, 13)
"""of a row; the widest constraint (a hinge across an edge) spans three columns"""
LINE = 64
"""bytes of a cache line, and of the widest vector"""
PAGE = 4096
"""bytes of a page of memory"""
NEXT = 7 * LINE
"""bytes from where one array begins in its page to where the next does: nine share no place"""
APART = 4 * LINE
"""bytes, at least, from a place in a page that x takes to the next one that y takes"""
_MADE = count()


@dataclass(frozen=True, eq=False)
class Block:
    """Where one grid lies among all slots."""

    rows: int
    columns: int
    first: int
    """slot of row 0, column 0"""
    parts: int
    """into how many a row is split"""
    part: int
    """slots of one part of a row"""
    short: bool
    """whether a part is no more than a cache line"""
    row_stride: int
    """slots from one row to the next"""
    rows_stored: int
    """rows, padding included"""

    @property
    def size(self) -> int:
        """Slots of the whole grid."""
        return self.rows_stored * self.row_stride

    def slot(self, row, column):
        """Return the slot of a particle, or of arrays of them."""
        return (self.first + row * self.row_stride + column % self.parts * self.part
                + column // self.parts)

    @property
    def slots(self) -> np.ndarray:
        """All slots, shape (rows, columns)."""
        return self.slot(np.arange(self.rows)[:, None], np.arange(self.columns))


@dataclass(frozen=True, eq=False)
class Span:
    """Where one mesh lies among all slots."""

    first: int
    """slot of the particle of rank 0"""
    rank: np.ndarray
    """place of each particle in memory, in natural order; shape (particles,)"""
    size: int
    """slots, padding included"""

    @property
    def slots(self) -> np.ndarray:
        """All slots in natural order, shape (particles,)."""
        return self.first + self.rank


def blocks(shapes: list[tuple[int, int] | np.ndarray], dtype) -> tuple[list[Block | Span], int]:
    """
    Lay out grids and meshes one after another.

    Parameters
    ----------
    shapes : rows and columns of a grid, or the ranks of a mesh's particles
    dtype : of all numbers

    Returns
    -------
    a block or span for each, and the slots of all, with room to load a vector past the end

    """
    lanes = lane_count(dtype)
    found, first = [], 0
    for shape in shapes:
        if isinstance(shape, np.ndarray):
            found.append(Span(first, shape, _round_up(len(shape), lanes)))
        else:
            rows, columns = shape
            parts = _parts(columns, dtype)
            longest = -(-columns // parts)
            part = _round_up(longest, lanes)
            found.append(Block(rows, columns, first, parts, part, longest <= _per_line(dtype),
                               _odd(parts * part, dtype), max(rows, lanes)))
        first += found[-1].size
    return found, _off_page(first + lanes, dtype)


def _off_page(slots: int, dtype) -> int:
    """Return at least so many slots, not close to whole pages."""
    per_page = PAGE // np.dtype(dtype).itemsize
    apart = APART // np.dtype(dtype).itemsize
    over = (slots + apart) % per_page    # from the last place that is too close
    return slots + max(2 * apart - over, 0)


def _parts(columns: int, dtype) -> int:
    """Return the fewest parts of whole cache lines with the least padding, whatever the lanes."""
    return min(PARTS, key=lambda parts: parts * _round_up(-(-columns // parts), _per_line(dtype)))


def _odd(slots: int, dtype) -> int:
    """Return at least so many slots, an odd number of cache lines."""
    return (-(-slots // _per_line(dtype)) | 1) * _per_line(dtype)


def _per_line(dtype) -> int:
    return LINE // np.dtype(dtype).itemsize


def _round_up(number: int, unit: int) -> int:
    return -(-number // unit) * unit


def zeros(shape, dtype) -> np.ndarray:
    """
    Return zeros that begin on a cache line, so that no vector of a row straddles two.

    Arrays made one after another begin at different places in their pages.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    room = np.zeros(size + PAGE, np.uint8)
    start = (NEXT * next(_MADE) - room.ctypes.data) % PAGE
    return room[start:start + size].view(dtype).reshape(shape)
