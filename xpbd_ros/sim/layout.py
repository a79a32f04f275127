"""
Where particles lie in memory: rows of a grid, each split by column modulo STRIDE.

A row of columns 0 1 2 3 4 5 … is stored as 0 4 8 … | 1 5 9 … | 2 6 10 … | 3 7 11 …, each part
padded to whole vectors. Constraints of the same shape, four columns apart, then touch neighbouring
places in memory and no particle twice: a vector of them is loaded, projected and stored without a
gather.
The rows too are padded to whole vectors, for the lines that run along them. Padding has neither
mass nor mobility, so nothing moves it.
"""

from dataclasses import dataclass

import numpy as np

from xpbd_ros.sim.vector import lane_count

STRIDE = 4
"""columns apart; the widest constraint (a hinge across an edge) spans three columns"""


LINE = 64
"""bytes of a cache line, and of the widest vector"""


@dataclass(frozen=True, eq=False)
class Block:
    """Where one grid lies among all slots."""

    rows: int
    columns: int
    first: int
    """slot of row 0, column 0"""
    part: int
    """slots of one part of a row, padding included"""
    padded_rows: int
    """rows, padding included"""

    @property
    def row_stride(self) -> int:
        """Slots from one row to the next."""
        return STRIDE * self.part

    @property
    def size(self) -> int:
        """Slots of the whole grid."""
        return self.padded_rows * self.row_stride

    def slot(self, row, column):
        """Return the slot of a particle, or of arrays of them."""
        return (self.first + row * self.row_stride + column % STRIDE * self.part
                + column // STRIDE)

    @property
    def slots(self) -> np.ndarray:
        """All slots, shape (rows, columns)."""
        return self.slot(np.arange(self.rows)[:, None], np.arange(self.columns))


def blocks(shapes: list[tuple[int, int]], dtype) -> tuple[list[Block], int]:
    """
    Lay out grids one after another.

    Returns
    -------
    a block per grid, and the slots of all, with room to load a vector past the end

    """
    lanes = lane_count(dtype)
    found, first = [], 0
    for rows, columns in shapes:
        part = _round_up(_round_up(columns, STRIDE) // STRIDE, lanes)
        found.append(Block(rows, columns, first, part, _round_up(rows, lanes)))
        first += found[-1].size
    return found, first + lanes


def _round_up(number: int, unit: int) -> int:
    return -(-number // unit) * unit


def zeros(shape, dtype) -> np.ndarray:
    """Return zeros that begin on a cache line, so that no vector of a row straddles two."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    room = np.zeros(size + LINE, np.uint8)
    start = -room.ctypes.data % LINE
    return room[start:start + size].view(dtype).reshape(shape)
