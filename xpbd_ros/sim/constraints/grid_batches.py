"""
Runs: constraints of one shape at neighbouring slots: a vector of them is projected at once.

A run holds, for each of its rows, ``count`` constraints; the k-th of a row touches the slots
start + row stride + k + offset, one offset per particle of the constraint. Of so many neighbours
as a vector has lanes no two share a particle, so the order among them does not matter; vectors,
rows and runs follow one another as in any Gauss-Seidel sweep.

A sweep takes a grid strip by strip: first every other strip, which no constraint joins to another
one of them, then those in between. So several threads can share each of these two phases.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import share
from xpbd_ros.sim.particles.memory_layout import Block

STRIP = 8
"""rows that a sweep takes at a time, so that they stay in the cache; a constraint spans fewer"""
PHASES = 2
COLUMNS = 8
"""arrays that tell of each run"""


class Runs(NamedTuple):
    """Runs in the order in which a sweep takes them."""

    start: np.ndarray
    """slot of the first constraint's anchor, shape (runs,)"""
    count: np.ndarray
    """constraints in a row, holes included, shape (runs,)"""
    rows: np.ndarray
    """shape (runs,)"""
    stride: np.ndarray
    """slots from row to row, shape (runs,)"""
    offset: np.ndarray
    """of each particle from the anchor, shape (runs, particles of a constraint)"""
    base: np.ndarray
    """where the run's multipliers are: base + anchor; shape (runs,)"""
    shape: np.ndarray
    """number of its shape, shape (runs,)"""
    place: np.ndarray
    """of the first anchor in its row of the grid: slots from the row's start, shape (runs,)"""
    strip: np.ndarray
    """number of each strip's first run, and how many there are; shape (strips + 1,)"""
    phase: np.ndarray
    """number of each phase's first strip, and how many there are; shape (phases + 1,)"""
    present: np.ndarray
    """whether a shape has a constraint at a place of a row, shape (shapes, places)"""


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
    slots : of all grids; family f keeps its multipliers at f * slots + anchor
    families : families of other grids that come before
    shapes_before : shapes of other grids that come before

    """
    table, strip, phase = [], [0], [0]
    present = np.zeros((len(shapes), block.row_stride), bool)
    for number, shape in enumerate(shapes):
        present[number, [_place(block, c) for c in shape.columns]] = True
    for first in range(PHASES):
        for top in range(first * STRIP, block.rows, PHASES * STRIP):
            for number, shape in enumerate(shapes):
                rows = [j for j in range(top, min(top + STRIP, block.rows)) if j in shape.rows]
                if not rows:
                    continue
                start = block.first + rows[0] * block.row_stride
                for place, count, offset in _spans(block, shape):
                    table.append((start + place, count, len(rows),
                                  shape.rows.step * block.row_stride, *offset,
                                  (families + shape.family) * slots, shapes_before + number,
                                  place))
            strip.append(len(table))
        phase.append(len(strip) - 1)
    width = len(shapes[0].particles) if shapes else 0
    table = np.array(table, np.int64).reshape(-1, 7 + width)
    return Runs(*(np.ascontiguousarray(table[:, k]) for k in range(4)),
                np.ascontiguousarray(table[:, 4:-3]), *(table[:, k].copy() for k in (-3, -2, -1)),
                np.array(strip), np.array(phase), present)


def _place(block: Block, column: int) -> int:
    return block.slot(0, column) - block.first


def _spans(block: Block, shape: Shape) -> list[tuple[int, int, tuple[int, ...]]]:
    """
    Return a shape's anchors in a row, as few spans of neighbours: first place, count, offsets.

    Neighbouring parts whose constraints reach out alike are one span, with holes between them
    where a part ends without a constraint. But a vector that begins where the one before ends
    would wait for it: short parts that are joined along their row are taken each down its rows.
    """
    waits = block.short and len({j for j, _ in shape.particles}) == 1
    found, last_part = [], block.parts
    for part in range(block.parts):
        columns = [c for c in shape.columns if c % block.parts == part]
        if not columns:
            continue
        place, end = _place(block, columns[0]), _place(block, columns[-1]) + 1
        offset = tuple(block.slot(j, columns[0] + c) - block.slot(0, columns[0])
                       for j, c in shape.particles)
        if part == last_part + 1 and offset == found[-1][2] and not waits:
            found[-1] = (found[-1][0], end - found[-1][0], offset)
        else:
            found.append((place, end - place, offset))
        last_part = part
    return found


def join(runs: list[Runs]) -> Runs:
    """Return the runs of several grids, one after another."""
    places = max(r.present.shape[1] for r in runs)
    strips = [(r, s) for h in range(PHASES) for r in runs for s in range(*r.phase[h:h + 2])]
    taken = [(r, np.s_[r.strip[s]:r.strip[s + 1]]) for r, s in strips]
    columns = [np.concatenate([r[k][these] for r, these in taken]) for k in range(COLUMNS)]
    strip = np.cumsum([0, *(these.stop - these.start for _, these in taken)])
    phase = np.sum([r.phase for r in runs], axis=0)
    return Runs(*columns, strip, phase, np.concatenate(
        [np.pad(r.present, ((0, 0), (0, places - r.present.shape[1]))) for r in runs]))


@jit(inline=True)
def share_of(runs, team, phase, reverse):
    """Return the first run of a thread's share of a phase, and the one after its last."""
    if reverse:
        phase = PHASES - 1 - phase
    begin = runs.phase[phase]
    first, last = share(team, runs.phase[phase + 1] - begin)
    return runs.strip[begin + first], runs.strip[begin + last]


def first_of_runs(runs: Runs) -> np.ndarray:
    """Return the number of each run's first constraint in ``listed``, shape (runs + 1,)."""
    count = [runs.rows[r] * runs.present[runs.shape[r], runs.place[r]:][:runs.count[r]].sum()
             for r in range(len(runs.start))]
    return np.concatenate([[0], np.cumsum(count, dtype=np.int64)])


def listed(runs: Runs) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    Return all constraints of some runs, in sweep order.

    Returns
    -------
    particles : slots, shape (constraints, particles of a constraint)
    index : where each keeps its multiplier, shape (constraints,)
    shape : number of its shape, shape (constraints,)
    place : of its anchor in its row, shape (constraints,)

    """
    found = [np.zeros((0, runs.offset.shape[1]), np.int64), *[np.zeros(0, np.int64)] * 3]
    found = [[column] for column in found]
    for r in range(len(runs.start)):
        along = np.flatnonzero(runs.present[runs.shape[r], runs.place[r]:][:runs.count[r]])
        anchor = (runs.start[r] + np.arange(runs.rows[r])[:, None] * runs.stride[r]
                  + along).ravel()
        for column, numbers in zip(found, (
                anchor[:, None] + runs.offset[r], anchor + runs.base[r],
                np.full(len(anchor), runs.shape[r]),
                np.tile(runs.place[r] + along, runs.rows[r]))):
            column.append(numbers)
    return tuple(np.concatenate(column) for column in found)
