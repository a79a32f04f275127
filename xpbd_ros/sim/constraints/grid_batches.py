"""
Batches of constraints on grids: runs of one shape of constraint at consecutive slots.

A run has ``count`` constraints in each of its rows. Constraint k of a row has its particles at the
slots start + row · stride + k + offset, with one offset per particle. As many consecutive ones as
a vector has lanes share no particle and are projected as a vector; vectors, rows and runs follow
one another in Gauss-Seidel order.

A sweep takes a grid in strips of rows and two phases: first every other strip, no two of which a
constraint couples, then those in between. Several threads share the strips of a phase.
"""

from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lane_count
from xpbd_ros.sim.backend.threads import share
from xpbd_ros.sim.constraints.projection import max_compliance
from xpbd_ros.sim.particles.memory_layout import Block, zeros

STRIP = 8
"""rows of a strip: few enough to stay in the cache, more than a constraint spans"""
PHASES = 2
ABSENT = -1.0
"""compliance where there is no constraint"""
COLUMNS = 8
"""number of the fields of ``Runs`` that have one entry per run"""


class Runs(NamedTuple):
    """Runs in sweep order."""

    start: np.ndarray
    """slot of the first constraint's anchor, shape (runs,)"""
    count: np.ndarray
    """positions in a row, those without a constraint included, shape (runs,)"""
    rows: np.ndarray
    """number of rows, shape (runs,)"""
    stride: np.ndarray
    """slots from row to row, shape (runs,)"""
    offset: np.ndarray
    """slot of each particle relative to the anchor, shape (runs, particles of a constraint)"""
    base: np.ndarray
    """a constraint's multiplier is at base + anchor; shape (runs,)"""
    shape: np.ndarray
    """index of the shape of constraint, shape (runs,)"""
    place: np.ndarray
    """slot of the first anchor relative to the start of its grid row, shape (runs,)"""
    strip: np.ndarray
    """index of each strip's first run, and the number of runs; shape (strips + 1,)"""
    phase: np.ndarray
    """index of each phase's first strip, and the number of strips; shape (phases + 1,)"""
    present: np.ndarray
    """True where a shape has a constraint at a place of a row, shape (shapes, places)"""


class Shape(NamedTuple):
    """A shape of constraint on a grid (relative positions of its particles) and its anchors."""

    particles: tuple[tuple[int, int], ...]
    """(row, column) of each particle relative to the anchor"""
    rows: range
    """rows of the anchors"""
    columns: range
    """columns of the anchors"""
    family: int
    """index of the array of multipliers; shapes without common anchors may share it"""


def grid_runs(block: Block, shapes: list[Shape], slots: int, *, families: int = 0,
              shapes_before: int = 0) -> Runs:
    """
    Return the runs of some shapes of constraint on one grid, strip by strip.

    Parameters
    ----------
    block : slots of the grid
    shapes : in their order within a strip
    slots : number of slots of the state; the multipliers of family f are at f * slots + anchor
    families : number of families of the grids before this one
    shapes_before : number of shapes of the grids before this one

    """
    table, strip, phase = [], [0], [0]
    present = np.zeros((len(shapes), block.row_stride), bool)
    for number, shape in enumerate(shapes):
        present[number, [place_of(block, c) for c in shape.columns]] = True
    for first in range(PHASES):
        for top in range(first * STRIP, block.rows, PHASES * STRIP):
            for number, shape in enumerate(shapes):
                rows = [j for j in range(top, min(top + STRIP, block.rows)) if j in shape.rows]
                if not rows:
                    continue
                start = block.first + rows[0] * block.row_stride
                for place, count, offset in spans(block, shape):
                    table.append((start + place, count, len(rows),
                                  shape.rows.step * block.row_stride, *offset,
                                  (families + shape.family) * slots, shapes_before + number,
                                  place))
            strip.append(len(table))
        phase.append(len(strip) - 1)
    width = len(shapes[0].particles) if shapes else 0
    table = np.array(table, np.int64).reshape(-1, 7 + width)
    start, count, rows, stride = (np.ascontiguousarray(table[:, k]) for k in range(4))
    return Runs(start, count, rows, stride, np.ascontiguousarray(table[:, 4:-3]),
                table[:, -3].copy(), table[:, -2].copy(), table[:, -1].copy(),
                np.array(strip), np.array(phase), present)


def place_of(block: Block, column: int) -> int:
    """Return the slot of a column relative to the start of its row."""
    return block.slot(0, column) - block.first


def spans(block: Block, shape: Shape, *,
          merge: bool = True) -> list[tuple[int, int, tuple[int, ...]]]:
    """
    Return a shape's anchors in a row as spans of consecutive slots: (first place, count, offsets).

    Adjacent parts with equal offsets are merged into one span, which includes slots without a
    constraint at the end of a part. Short parts of constraints within one row are not merged,
    since each vector would wait for the stores of the one before; they are swept down their rows.
    Without ``merge`` no parts are merged.
    """
    waits = not merge or block.short and len({j for j, _ in shape.particles}) == 1
    found: list[tuple[int, int, tuple]] = []
    last_part = block.parts
    for part in range(block.parts):
        columns = [c for c in shape.columns if c % block.parts == part]
        if not columns:
            continue
        place, end = place_of(block, columns[0]), place_of(block, columns[-1]) + 1
        offset = tuple(block.slot(j, columns[0] + c) - block.slot(0, columns[0])
                       for j, c in shape.particles)
        if part == last_part + 1 and offset == found[-1][2] and not waits:
            found[-1] = (found[-1][0], end - found[-1][0], offset)
        else:
            found.append((place, end - place, offset))
        last_part = part
    return found


def join(runs: list[Runs]) -> Runs:
    """Return the runs of several grids: phase by phase, in each grid by grid."""
    places = max(r.present.shape[1] for r in runs)
    strips = [(r, s) for h in range(PHASES) for r in runs for s in range(*r.phase[h:h + 2])]
    taken = [(r, np.s_[r.strip[s]:r.strip[s + 1]]) for r, s in strips]
    columns = [np.concatenate([r[k][these] for r, these in taken]) for k in range(COLUMNS)]
    strip = np.cumsum([0, *(these.stop - these.start for _, these in taken)])
    phase = np.sum([r.phase for r in runs], axis=0)
    present = np.concatenate(
        [np.pad(r.present, ((0, 0), (0, places - r.present.shape[1]))) for r in runs])
    return Runs._make((*columns, strip, phase, present))


def by_place(runs: Any, compliance: list, dtype) -> np.ndarray:
    """
    Return the compliances of grids as one table, ABSENT where there is no constraint.

    Parameters
    ----------
    runs : runs of all grids
    compliance : of each grid, by its shapes and places in a row, (shapes, places) or (shapes, 1)
    dtype : of the table

    Returns
    -------
    shape (shapes, places), padded by a vector

    """
    table = zeros((len(runs.present), runs.present.shape[1] + lane_count(dtype)), dtype)
    table[:] = ABSENT
    first_ = 0
    for each in compliance:
        each = np.minimum(each, max_compliance(dtype))
        there = np.s_[first_:first_ + len(each), :runs.present.shape[1]]
        width = each.shape[1] if each.shape[1] > 1 else runs.present.shape[1]
        table[there][:, :width] = each
        first_ += len(each)
    table[:, :runs.present.shape[1]][~runs.present] = ABSENT
    return table


@jit(inline=True)
def share_of(runs, team, phase, reverse):
    """Return the range of runs (first, last + 1) of this thread in a phase."""
    if reverse:
        phase = PHASES - 1 - phase
    begin = runs.phase[phase]
    first, last = share(team, runs.phase[phase + 1] - begin)
    return runs.strip[begin + first], runs.strip[begin + last]


def first_of_runs(runs: Any) -> np.ndarray:
    """Return the index of each run's first constraint in ``listed``, shape (runs + 1,)."""
    count = [runs.rows[r] * runs.present[runs.shape[r], runs.place[r]:][:runs.count[r]].sum()
             for r in range(len(runs.start))]
    return np.concatenate([[0], np.cumsum(count, dtype=np.int64)])


def listed(runs: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    Return all constraints of some runs as arrays, in sweep order.

    Returns
    -------
    particles : slots, shape (constraints, particles of a constraint)
    index : position of each multiplier, shape (constraints,)
    shape : index of each constraint's shape, shape (constraints,)
    place : slot of each anchor relative to the start of its row, shape (constraints,)

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
    particles, index, shape, place = (np.concatenate(column) for column in found)
    return particles, index, shape, place
