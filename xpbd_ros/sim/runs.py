"""
Runs: constraints of one shape at neighbouring slots: a vector of them is projected at once.

A run holds, for each of its rows, ``count`` constraints; the k-th of a row touches the slots
start + row stride + k + offset, one offset per particle of the constraint. Within a row no two
constraints share a particle, so the order among them does not matter; rows and runs follow one
another as in any Gauss-Seidel sweep.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.layout import Block, STRIDE

STRIP = 16
"""rows that a sweep takes at a time, so that they stay in the cache"""


class Runs(NamedTuple):
    """Runs in the order in which a sweep takes them."""

    start: np.ndarray
    """slot of the first constraint's anchor, shape (runs,)"""
    count: np.ndarray
    """constraints in a row, shape (runs,)"""
    rows: np.ndarray
    """shape (runs,)"""
    stride: np.ndarray
    """slots from row to row, shape (runs,)"""
    offset: np.ndarray
    """of each particle from the anchor, shape (runs, particles of a constraint)"""
    base: np.ndarray
    """where the run's constraints keep their numbers: base + anchor; shape (runs,)"""
    shape: np.ndarray
    """number of its shape, shape (runs,)"""


class Shape(NamedTuple):
    """One shape of constraint on a grid, and the cells where it stands."""

    particles: tuple[tuple[int, int], ...]
    """(row, column) of each, from the anchor"""
    rows: range
    """of the anchor"""
    columns: range
    """of the anchor"""
    family: int
    """shapes with different anchors share one family of numbers"""


def grid_runs(block: Block, shapes: list[Shape], slots: int, *, families: int = 0,
              shapes_before: int = 0) -> Runs:
    """
    Return the runs of some shapes on one grid, strip after strip of rows.

    Parameters
    ----------
    block : where the grid lies
    shapes : in the order in which a strip takes them
    slots : of all grids; family f keeps its numbers at f * slots + anchor
    families : families of other grids that come before
    shapes_before : shapes of other grids that come before

    """
    table = []
    for top in range(0, block.rows, STRIP):
        for number, shape in enumerate(shapes):
            rows = [j for j in range(top, min(top + STRIP, block.rows)) if j in shape.rows]
            if not rows:
                continue
            for part in range(STRIDE):
                columns = [c for c in shape.columns if c % STRIDE == part]
                if not columns:
                    continue
                anchor = block.slot(rows[0], columns[0])
                offset = [block.slot(rows[0] + j, columns[0] + c) - anchor
                          for j, c in shape.particles]
                table.append((anchor, len(columns), len(rows),
                              shape.rows.step * block.row_stride, *offset,
                              (families + shape.family) * slots, shapes_before + number))
    width = len(shapes[0].particles) if shapes else 0
    table = np.array(table, np.int64).reshape(-1, 6 + width)
    return Runs(*(np.ascontiguousarray(table[:, k]) for k in range(4)),
                np.ascontiguousarray(table[:, 4:-2]), table[:, -2].copy(), table[:, -1].copy())


def join(runs: list[Runs]) -> Runs:
    """Return the runs of several grids, one after another."""
    return Runs(*(np.concatenate(column) for column in zip(*runs)))


def listed(runs: Runs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return all constraints of some runs, in sweep order.

    Returns
    -------
    particles : slots, shape (constraints, particles of a constraint)
    index : where each keeps its numbers, shape (constraints,)
    shape : number of its shape, shape (constraints,)

    """
    particles, index, shape = [], [], []
    for r in range(len(runs.start)):
        anchor = (runs.start[r] + np.arange(runs.rows[r])[:, None] * runs.stride[r]
                  + np.arange(runs.count[r])).ravel()
        particles.append(anchor[:, None] + runs.offset[r])
        index.append(anchor + runs.base[r])
        shape.append(np.full(len(anchor), runs.shape[r]))
    if not particles:
        return (np.zeros((0, runs.offset.shape[1]), np.int64), np.zeros(0, np.int64),
                np.zeros(0, np.int64))
    return np.concatenate(particles), np.concatenate(index), np.concatenate(shape)
