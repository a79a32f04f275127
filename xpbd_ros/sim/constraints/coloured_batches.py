"""
The coloured order (``solver.order: coloured``): batches that share no particle, colour by colour.

On grids a colour is a set of runs (``constraints.grid_batches``) without a common particle, within
a run and among them; on meshes a range of the constraints. Each shape of constraint, or each
constraint, goes into the first colour where none of its particles is in use (greedy colouring).
All constraints of a colour may be projected at the same time, which a GPU needs. A CPU sweeps
farther through memory than in the sequential order. The two orders give different states, as any
two orders of Gauss-Seidel do; within the coloured order the bits depend on no number of threads.

A vector also writes back the lanes of a run that hold no constraint. So threads of a CPU share the
rows of one run after another; with one lane, as on a GPU, such places are skipped.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.constraints.grid_batches import COLUMNS, place_of, Shape, spans
from xpbd_ros.sim.constraints.mesh_batches import EMPTY
from xpbd_ros.sim.particles.memory_layout import Block


class ColouredRuns(NamedTuple):
    """Runs in sweep order, colour by colour; the first fields are those of ``Runs``."""

    start: np.ndarray
    count: np.ndarray
    rows: np.ndarray
    stride: np.ndarray
    offset: np.ndarray
    base: np.ndarray
    shape: np.ndarray
    place: np.ndarray
    colour: np.ndarray
    """index of each colour's first run, and the number of runs; shape (colours + 1,)"""
    present: np.ndarray


def coloured_runs(block: Block, shapes: list[Shape], slots: int, *, families: int = 0,
                  shapes_before: int = 0) -> ColouredRuns:
    """Return the runs of some shapes of constraint on one grid; parameters as ``grid_runs``."""
    present = np.zeros((len(shapes), block.row_stride), bool)
    colours: list[list[tuple]] = []
    used: list[np.ndarray] = []    # particles of each colour
    for number, shape in enumerate(shapes):
        present[number, [place_of(block, c) for c in shape.columns]] = True
        for rows in _separate_rows(shape):
            for place, count, offset in spans(block, shape, merge=not _in_one_row(shape)):
                start, step = (block.first + rows[0] * block.row_stride + place,
                               rows.step * block.row_stride)
                anchors = (start + np.arange(len(rows))[:, None] * step
                           + np.flatnonzero(present[number, place:place + count]))
                places = anchors[..., None] + np.array(offset) - block.first
                touched = np.zeros(block.size, bool)
                touched[places] = True
                assert np.count_nonzero(touched) == places.size
                colour = next((k for k, taken in enumerate(used) if not (taken & touched).any()),
                              len(used))
                if colour == len(used):
                    used.append(np.zeros(block.size, bool))
                    colours.append([])
                used[colour] |= touched
                colours[colour].append((
                    start, count, len(rows), step, *offset, (families + shape.family) * slots,
                    shapes_before + number, place))
    width = len(shapes[0].particles) if shapes else 0
    table = np.array([run for runs in colours for run in runs], np.int64).reshape(-1, 7 + width)
    start, count, rows, stride = (np.ascontiguousarray(table[:, k]) for k in range(4))
    return ColouredRuns(start, count, rows, stride, np.ascontiguousarray(table[:, 4:-3]),
                        table[:, -3].copy(), table[:, -2].copy(), table[:, -1].copy(),
                        np.cumsum([0, *map(len, colours)]), present)


def _separate_rows(shape: Shape) -> list[range]:
    """Return the rows of a shape's anchors in sets whose constraints reach no common row."""
    tall = 1 + max(j for j, _ in shape.particles)
    return [rows for rows in (shape.rows[k::tall] for k in range(tall)) if len(rows)]


def _in_one_row(shape: Shape) -> bool:
    """Return True if two particles are in one row: then anchors in a row share particles."""
    rows = [j for j, _ in shape.particles]
    return len(set(rows)) < len(rows)


def join_coloured(runs: list[ColouredRuns]) -> ColouredRuns:
    """Return the runs of several grids: colour by colour, in each grid by grid."""
    places = max(r.present.shape[1] for r in runs)
    most = max(len(r.colour) for r in runs) - 1
    taken = [(r, np.s_[r.colour[k]:r.colour[k + 1]], k) for k in range(most) for r in runs
             if k + 1 < len(r.colour)]
    columns = [np.concatenate([r[n][these] for r, these, _ in taken] or [runs[0][n]])
               for n in range(COLUMNS)]
    size = np.zeros(most, np.int64)
    for _, these, k in taken:
        size[k] += these.stop - these.start
    present = np.concatenate(
        [np.pad(r.present, ((0, 0), (0, places - r.present.shape[1]))) for r in runs])
    return ColouredRuns._make((*columns, np.concatenate([[0], np.cumsum(size)]), present))


def coloured_packs(particles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return constraints of meshes ordered by colour, each colour in whole packs.

    Parameters
    ----------
    particles : slots, shape (constraints, particles of a constraint)

    Returns
    -------
    order : indices of the constraints, EMPTY in unfilled packs, shape (packs * PACK,)
    first : position of each colour's first constraint, and the length of ``order``, shape
        (colours + 1,)

    """
    order = np.argsort(particles.min(1), kind='stable') if len(particles) else np.zeros(0, int)
    colour = np.full(len(order), -1)
    used = np.full(1 + particles.max(initial=0), -1)
    count = _colour(np.ascontiguousarray(particles[order], np.int64), colour, used)
    found, first = [np.zeros(0, int)], [0]
    for k in range(count):
        members = order[colour == k]
        found.append(np.pad(members, (0, -len(members) % PACK), constant_values=EMPTY))
        first.append(first[-1] + len(found[-1]))
    return np.concatenate(found), np.array(first)


@jit
def _colour(particles, colour, used):
    """
    Give each constraint the first colour that none of its particles has; return their number.

    Parameters
    ----------
    particles : slots, shape (constraints, particles of a constraint)
    colour : output, -1 at first, shape (constraints,)
    used : the last colour of each particle, -1 at first, shape (slots,)

    """
    left, count = len(colour), 0
    while left > 0:
        for c in range(len(colour)):
            free = colour[c] < 0
            for i in particles[c]:
                free = free and used[i] != count
            if free:
                colour[c] = count
                left -= 1
                for i in particles[c]:
                    used[i] = count
        count += 1
    return count
