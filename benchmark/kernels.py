"""The tables of nanoseconds per projection: grid, irregular, line, bend."""

import candidates
from checks import (
    check_bend,
    check_bend_bound,
    check_grid_bound,
    check_lines,
    check_lines_bound,
    check_steps,
)
from native import BendBound, GridBound, LinesBound, Textbook
from report import Report, Table
from timing import Timed
from works import (
    bend_work,
    FRAME_DT,
    grid_work,
    irregular_work,
    line_work,
    LineWork,
    SUBSTEPS,
    Work,
)

PRECISIONS = ('float32', 'float64')
STRIP = 8
"""rows that the lower bound sweeps together"""
H = FRAME_DT / SUBSTEPS
"""[s]"""
ARITHMETIC = {False: 'sqrt + division', True: 'rsqrt + Newton'}
"""of the lower bound: IEEE operations, or the CPU's estimates refined"""


def grid(report: Report, n: int) -> None:
    """Whole steps on the regular grid."""
    work = grid_work(n)
    for precision in PRECISIONS:
        table = Table(report, 'grid', n, precision)
        table.add('textbook', _textbook_steps, work)
        for estimate, arithmetic in ARITHMETIC.items():
            for strip, order in ((STRIP, f'{STRIP} rows'), (n, 'all rows')):
                table.add(f'bound, {arithmetic}, {order}', _bound_steps, work, estimate, strip)
        _add_our_steps(table, work)
        table.measure()


def irregular(report: Report, n: int) -> None:
    """Whole steps on a mesh without rows."""
    work = irregular_work(n)
    for precision in PRECISIONS:
        table = Table(report, 'irregular', n, precision)
        table.add('textbook', _textbook_steps, work)
        _add_our_steps(table, work)
        table.measure()


def line(report: Report, n: int) -> None:
    """Line solves, and the textbook's Gauss-Seidel on the same edges."""
    warp, weft = line_work(n, along=True), line_work(n, along=False)
    for precision in PRECISIONS:
        table = Table(report, 'line', n, precision)
        for work, direction in ((weft, 'across'), (warp, 'along')):
            table.add('textbook', _textbook_passes, work.as_work(), work.h, direction=direction)
            for estimate, arithmetic in ARITHMETIC.items():
                table.add(f'bound, {arithmetic}', _bound_lines, work, estimate,
                          direction=direction)
        table.add('line', _our_lines, warp, weft)
        table.measure()


def bend(report: Report, n: int) -> None:
    """Projections of isometric hinges."""
    work = bend_work(n)
    for precision in PRECISIONS:
        table = Table(report, 'bend', n, precision)
        table.add('textbook', _textbook_passes, work, H)
        table.add('bound', _bound_bend, work)
        table.add('gauss_seidel', _our_bend, work)
        table.measure()


# What a table adds

def _textbook_steps(table: Table, work: Work) -> Timed:
    cloth = Textbook(table.report.native, work, table.precision)
    return Timed(lambda frames: cloth.advance(frames, FRAME_DT, SUBSTEPS),
                 SUBSTEPS * work.projections)


def _add_our_steps(table: Table, work: Work) -> None:
    for method in candidates.STEPS:
        for threads in (1, 2):
            table.add(method, _our_steps, work, method, threads, threads=threads)


def _our_steps(table: Table, work: Work, method: str, threads: int) -> Timed:
    def make(work):
        return candidates.whole_steps(work, method=method, precision=table.precision,
                                      threads=threads)

    def positions_after(work, frames):
        ours = make(work)
        ours.run(frames)
        return ours.state()

    ours = make(work)
    if table.report.native.textbook:
        check_steps(table.report.native, work, table.precision, method, positions_after)
    return Timed(ours.run, SUBSTEPS * work.projections)


def _bound_steps(table: Table, work: Work, estimate: bool, strip: int) -> Timed:
    bound = GridBound(table.report.native, work, table.precision, estimate=estimate, strip=strip)
    check_grid_bound(table.report.native, work, table.precision, bound)
    bound.reset()
    return Timed(lambda frames: bound.advance(frames * SUBSTEPS, H), SUBSTEPS * work.projections)


def _textbook_passes(table: Table, work: Work, h: float) -> Timed:
    cloth = Textbook(table.report.native, work, table.precision)
    return Timed(lambda passes: cloth.project(passes, h), work.projections, cloth.reset)


def _bound_lines(table: Table, work: LineWork, estimate: bool) -> Timed:
    bound = LinesBound(table.report.native, work, table.precision, estimate=estimate)
    check_lines_bound(work, table.precision, bound)
    return Timed(bound.solve, work.projections, bound.reset)


def _our_lines(table: Table, warp: LineWork, weft: LineWork) -> Timed:
    ours = candidates.line_passes(warp, weft, precision=table.precision)

    def solve(passes):
        ours.reset()
        ours.run(passes)
        return ours.state()

    check_lines((warp, weft), table.precision, 'line', solve)
    return Timed(ours.run, warp.projections + weft.projections, ours.reset)


def _bound_bend(table: Table, work: Work) -> Timed:
    bound = BendBound(table.report.native, work, table.precision)
    check_bend_bound(table.report.native, work, table.precision, bound)
    return Timed(bound.project, work.projections, bound.reset)


def _our_bend(table: Table, work: Work) -> Timed:
    def positions_after(work, passes):
        ours = candidates.bend_passes(work, precision=table.precision)
        ours.run(passes)
        return ours.state()

    ours = candidates.bend_passes(work, precision=table.precision)
    if table.report.native.textbook:
        check_bend(table.report.native, work, table.precision, 'bend', positions_after)
    return Timed(ours.run, work.projections, ours.reset)
