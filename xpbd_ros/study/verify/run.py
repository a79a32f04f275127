"""Run the cases with known solutions, and draw their errors."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
import time

from xpbd_ros.errors import InputError
from xpbd_ros.scene.read import unknown
from xpbd_ros.study.chart import COLOURS, INK, page, save
from xpbd_ros.study.parallel import run_tasks
from xpbd_ros.study.verify import all_cases, Case, Row


@dataclass(frozen=True)
class Answer:
    """A case and its rows."""

    id: str
    title: str
    family: str
    rows: tuple[Row, ...]
    seconds: float


def verify(chosen: str | None = None, *, slow: bool = True, scheduler: str | None = None,
           progress: Callable[[Iterable, str], Iterable] = lambda items, _: items
           ) -> list[Answer]:
    """
    Run all cases, or those of one id.

    Parameters
    ----------
    chosen : id of a case, such as V6; None for all
    slow : whether to run the cases that take minutes
    scheduler : address of a Dask scheduler whose workers run the cases instead
    progress : wraps the list of cases to show progress

    """
    cases = {k: one for k, one in enumerate(_cases())
             if (slow or not one.slow) and chosen in (None, one.id)}
    if not cases:
        known = sorted({one.id for one in _cases()}, key=number)
        raise InputError(f"--case {chosen}: {unknown(chosen, known, 'case')}")
    tasks = [(k,) for k in sorted(cases, key=lambda k: number(cases[k].id))]
    found = dict(run_tasks(_answer, tasks, processes=1, scheduler=scheduler, what='cases',
                           progress=progress))
    return [found[k] for k in sorted(found)]


def _cases() -> list[Case]:
    return [one for family in all_cases().values() for one in family]


def _answer(k: int) -> Answer:
    """Run one of ``_cases``."""
    one, start = _cases()[k], time.perf_counter()
    rows = tuple(one.rows())
    return Answer(one.id, one.title, one.family, rows, time.perf_counter() - start)


def number(id_: str) -> int:
    """Return the number in an id."""
    return int(''.join(c for c in id_ if c.isdigit()) or 0)


def draw(answers: list[Answer], folder: Path) -> list[Path]:
    """Draw errors over tolerances and over steps, a file per family; return the paths."""
    written = []
    for family in dict.fromkeys(answer.family for answer in answers):
        rows = [(answer.id, row) for answer in answers if answer.family == family
                for row in answer.rows]
        ladders = [(id_, row) for id_, row in rows if row.ladder]
        figure, axes = page(6.5 * (1 + bool(ladders)), max(5.0, 0.2 * len(rows)),
                            columns=1 + bool(ladders))
        _bars(axes[0, 0], rows, family)
        written.append(folder / f'verify_{family}.png')
        for axis in axes[0, 1:]:
            _ladders(axis, ladders)
        save(figure, written[-1])
    return written


def _bars(axis, rows, family: str) -> None:
    """Draw each error over its tolerance."""
    part = [max(row.error / row.tolerance, 1e-9) if row.tolerance else float(row.error > 0.0)
            for _, row in rows][::-1]
    axis.barh(range(len(rows)), part, color=[COLOURS[0] if row.good else COLOURS[3]
                                             for _, row in reversed(rows)])
    axis.set_yticks(range(len(rows)), [f'{id_} {row.name}' for id_, row in reversed(rows)],
                    fontsize=6.5)
    axis.set_xscale('log')
    axis.axvline(1.0, color=INK, linewidth=1.0)
    axis.set_xlabel('error over tolerance', fontsize=8)
    axis.set_title(f'{family}: errors against known solutions', fontsize=10, loc='left')


def _ladders(axis, rows) -> None:
    """Draw errors over steps."""
    for k, (id_, row) in enumerate(rows):
        # relative to the coarsest step, so that steps of all kinds share an axis
        steps = [step / row.ladder[0][0] for step, _ in row.ladder]
        axis.loglog(steps, [error for _, error in row.ladder], marker='o', markersize=3.5,
                    linewidth=1.2, color=COLOURS[k % len(COLOURS)],
                    linestyle=('-', '--', ':')[k // len(COLOURS) % 3],
                    label=f'{id_} {row.name}: order {row.order:.2f} '
                          f'({row.order_expected:g})')
    axis.set_xlabel('step, relative to the coarsest', fontsize=8)
    axis.set_ylabel('error', fontsize=8)
    axis.grid(alpha=0.25)
    axis.legend(fontsize=6.5, frameon=False)
