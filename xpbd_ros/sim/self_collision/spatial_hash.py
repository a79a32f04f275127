"""
Spatial hash: search for the points in a box, over the cells of an unbounded cubic grid.

The three integer coordinates of a cell are hashed into a table, and a counting sort lists the
points by table entry (M. Teschner et al., "Optimized spatial hashing for collision detection of
deformable objects", 2003). Points are found cell by cell; ``in_order`` sorts those that the caller
keeps, so that the order is independent of the cells.
"""

from math import floor
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit

FAR = 2**52
"""cell coordinate of all points that are further away, or not finite"""


class Cells(NamedTuple):
    """The hash table."""

    start: np.ndarray
    """index of each entry's first point in ``point``, shape (2^k + 1,)"""
    point: np.ndarray
    """indices of the points by entry, rising within each, shape (points,)"""
    cell: np.ndarray
    """cell coordinates of each point, shape (points, 3)"""
    found: np.ndarray
    """result of ``look_up``, shape (points,)"""


def new_cells(points: int) -> Cells:
    """Return a table for that many points, with at least two entries for each."""
    places = 1 << max(4, (2 * points - 1).bit_length())
    return Cells(np.zeros(places + 1, np.int64), np.zeros(points, np.int64),
                 np.zeros((points, 3), np.int64), np.zeros(points, np.int64))


@jit
def table_entry(a, b, c, places):
    """Return the table entry of the cell (a, b, c)."""
    return ((a * 73856093) ^ (b * 19349663) ^ (c * 83492791)) & (places - 1)


@jit(inline=True)
def cell_coordinate(x):
    """Return ⌊x⌋ as an integer; FAR if |x| ≥ FAR or x is nan."""
    return floor(x) if abs(x) < FAR else FAR


@jit
def fill(cells, points, size):
    """Sort points [m], the first columns of an array, into cells of this size [m]."""
    start, cell, places = cells.start, cells.cell, len(cells.start) - 1
    start[:] = 0
    for i in range(len(cell)):
        for k in range(3):
            cell[i, k] = cell_coordinate(points[i, k] / size)
        start[table_entry(cell[i, 0], cell[i, 1], cell[i, 2], places)] += 1
    total = 0
    for p in range(places + 1):
        total += start[p]
        start[p] = total
    for i in range(len(cell) - 1, -1, -1):
        p = table_entry(cell[i, 0], cell[i, 1], cell[i, 2], places)
        start[p] -= 1
        cells.point[start[p]] = i


@jit
def look_up(cells, points, size, low, high, least):
    """
    Write the indices of points in a box to ``cells.found``, unordered; return their number.

    A box of more cells than the table has entries, or with a corner at infinity, is compared with
    every point instead.

    Parameters
    ----------
    points, size : as in ``fill``
    low, high : corners of the box [m]
    least : points of a lower index are left out

    """
    places, cell, found, count = len(cells.start) - 1, cells.cell, cells.found, 0
    first = (cell_coordinate(low[0] / size), cell_coordinate(low[1] / size),
             cell_coordinate(low[2] / size))
    last = (cell_coordinate(high[0] / size), cell_coordinate(high[1] / size),
            cell_coordinate(high[2] / size))
    spans = last[0] - first[0] + 1, last[1] - first[1] + 1, last[2] - first[2] + 1
    if min(spans) <= 0 or float(spans[0]) * float(spans[1]) * float(spans[2]) > places:
        for i in range(least, len(cell)):
            if is_in_box(points, i, low, high):
                found[count] = i
                count += 1
        return count
    for a in range(first[0], last[0] + 1):
        for b in range(first[1], last[1] + 1):
            for c in range(first[2], last[2] + 1):
                p = table_entry(a, b, c, places)
                for n in range(cells.start[p], cells.start[p + 1]):
                    i = cells.point[n]
                    if (i < least or cell[i, 0] != a or cell[i, 1] != b or cell[i, 2] != c
                            or not is_in_box(points, i, low, high)):
                        continue
                    found[count] = i
                    count += 1
    return count


@jit(inline=True)
def is_in_box(points, i, low, high):
    """Tell whether a point is in a box; a point with a NaN is in none."""
    return (low[0] <= points[i, 0] <= high[0] and low[1] <= points[i, 1] <= high[1]
            and low[2] <= points[i, 2] <= high[2])


@jit
def in_order(numbers, count):
    """Sort numbers[:count] in place (D. Shell, 1959): usually few, many if all points coincide."""
    gap = 1
    while 3 * gap + 1 < count:
        gap = 3 * gap + 1
    while gap > 0:
        for k in range(gap, count):
            n, at = numbers[k], k
            while at >= gap and numbers[at - gap] > n:
                numbers[at] = numbers[at - gap]
                at -= gap
            numbers[at] = n
        gap //= 3
