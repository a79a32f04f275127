"""
Memory layout of particles: grid rows split into interleaved parts, mesh particles by rank.

Split into four parts, a row of columns 0 1 2 3 4 5 … is stored as 0 4 8 … | 1 5 9 … | 2 6 10 … |
3 7 11 …. Constraints of the same shape, four columns apart, then occupy consecutive memory and
share no particle: a vector of them is loaded, projected and stored without a gather.

Parts have equal length and are padded to whole vectors, since a load that overlaps half of a
recent store has to wait for it. The number of parts is the one with the least padding. A row takes
an odd number of cache lines, so that a column spreads over the sets of the cache. A grid has at
least as many rows as a vector has lanes, since the line solver takes one row per lane. Mesh
particles are stored by rank (Cuthill-McKee order, see ``geometry.mesh``), padded to whole vectors
at the end. Padding has zero mass and mobility, so it never moves.

A load waits for a pending store to the same offset in another page (4K aliasing). Arrays allocated
one after another therefore begin at different page offsets, and so do x, y and z of one array.
"""

from dataclasses import dataclass
from itertools import count

import numpy as np

from xpbd_ros.sim.backend.simd import lane_count

PARTS = range(4, 13)
"""numbers of parts of a row; the widest constraint (a hinge across an edge) spans three columns"""
LINE = 64
"""bytes of a cache line, and of the widest vector"""
PAGE = 4096
"""bytes of a memory page"""
NEXT = 7 * LINE
"""bytes between the page offsets of successive arrays; nine of them have distinct offsets"""
APART = 4 * LINE
"""least distance of the page offsets of x, y and z of one array [bytes]"""
_MADE = count()


@dataclass(frozen=True, eq=False)
class Block:
    """Slots of one grid."""

    rows: int
    columns: int
    first: int
    """slot of row 0, column 0"""
    parts: int
    """number of parts of a row"""
    part: int
    """slots of one part of a row"""
    short: bool
    """True if a part fits into a cache line"""
    row_stride: int
    """slots from one row to the next"""
    rows_stored: int
    """number of rows, padding included"""

    @property
    def size(self) -> int:
        """Number of slots, padding included."""
        return self.rows_stored * self.row_stride

    def slot(self, row, column):
        """Return the slots of particles by row and column, integers or arrays."""
        return (self.first + row * self.row_stride + column % self.parts * self.part
                + column // self.parts)

    @property
    def slots(self) -> np.ndarray:
        """Slots of all particles, shape (rows, columns)."""
        return self.slot(np.arange(self.rows)[:, None], np.arange(self.columns))


@dataclass(frozen=True, eq=False)
class Span:
    """Slots of one mesh."""

    first: int
    """slot of the particle of rank 0"""
    rank: np.ndarray
    """position in memory of each particle in natural order, shape (particles,)"""
    size: int
    """slots, padding included"""

    @property
    def slots(self) -> np.ndarray:
        """Slots of all particles in natural order, shape (particles,)."""
        return self.first + self.rank


def blocks(shapes: list[tuple[int, ...] | np.ndarray], dtype) -> tuple[list[Block | Span], int]:
    """
    Lay out grids and meshes one after another.

    Parameters
    ----------
    shapes : (rows, columns) of a grid, or the ranks of a mesh's particles, shape (particles,)
    dtype : of the state's arrays

    Returns
    -------
    a block or span for each, and the total number of slots, which allows to load a vector past the
    last particle

    """
    lanes = lane_count(dtype)
    found: list[Block | Span] = []
    first = 0
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
    """Return the slot count, increased until rows x, y, z are APART from equal page offsets."""
    per_page = PAGE // np.dtype(dtype).itemsize
    apart = APART // np.dtype(dtype).itemsize
    over = (slots + apart) % per_page    # distance from the last offset that is too close
    return slots + max(2 * apart - over, 0)


def _parts(columns: int, dtype) -> int:
    """Return the smallest number of parts with the least padding, whatever the vector width."""
    return min(PARTS, key=lambda parts: parts * _round_up(-(-columns // parts), _per_line(dtype)))


def _odd(slots: int, dtype) -> int:
    """Return the slot count rounded up to an odd number of cache lines."""
    return (-(-slots // _per_line(dtype)) | 1) * _per_line(dtype)


def _per_line(dtype) -> int:
    return LINE // np.dtype(dtype).itemsize


def _round_up(number: int, unit: int) -> int:
    return -(-number // unit) * unit


def zeros(shape, dtype) -> np.ndarray:
    """
    Return zeros aligned to a cache line, so that no vector of a row straddles two.

    Arrays allocated one after another begin at different page offsets.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    room = np.zeros(size + PAGE, np.uint8)
    start = (NEXT * next(_MADE) - room.ctypes.data) % PAGE
    return room[start:start + size].view(dtype).reshape(shape)
