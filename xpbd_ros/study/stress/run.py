"""Run the hard cases, and draw and tabulate their results."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
import time

from xpbd_ros.errors import InputError
from xpbd_ros.scene.read import unknown
from xpbd_ros.study.chart import INK, page, save
from xpbd_ros.study.parallel import run_tasks
from xpbd_ros.study.stress import all_hard
from xpbd_ros.study.stress.case import NONE_SET, Outcome, Setting
from xpbd_ros.study.stress.guards import GUARDS
from xpbd_ros.study.stress.refusals import Refusal
from xpbd_ros.study.stress.trial import Trial

NODE_CASES = {'H20': 'clocks that jump', 'H21': 'slower than real time',
              'H23': 'non-finite inputs at run time'}
"""titles of the cases that need a node (``xpbd_ros.node_stress``), by id"""
GOOD, BAD, REFUSED, NONE = '#3b8c5a', '#b5443c', '#7fb3d5', '#ededed'


@dataclass(frozen=True)
class Result:
    """A case and its outcomes."""

    id: str
    title: str
    family: str
    outcomes: tuple[Outcome, ...]
    seconds: float


def known_ids() -> list[str]:
    """Return the ids of all cases that do not need a node."""
    return [one.id for one in all_hard()]


def stress(chosen: str | None = None, *, quick: bool = False, scheduler: str | None = None,
           progress: Callable[[Iterable, str], Iterable] = lambda items, _: items
           ) -> list[Result]:
    """
    Run all cases that do not need a node, or one of them.

    Parameters
    ----------
    chosen : id of a case, such as H13; None for all
    quick : run only the attempts of ``is_quick``
    scheduler : address of a Dask scheduler whose workers run the cases instead
    progress : wraps the list of cases to show progress

    """
    tasks = [(k, quick) for k, one in enumerate(all_hard()) if chosen in (None, one.id)]
    if not tasks:
        known = sorted([*known_ids(), *NODE_CASES], key=lambda one: int(one[1:]))
        raise InputError(f"--case {chosen}: {unknown(chosen, known, 'case')}")
    found = dict(run_tasks(_result, tasks, processes=1, scheduler=scheduler, what='cases',
                           progress=progress))
    return [found[k] for k in sorted(found)]


def _result(k: int, quick: bool) -> Result:
    """Run one of ``all_hard``."""
    one, start = all_hard()[k], time.perf_counter()
    attempts = [each for each in one.attempts() if not quick or is_quick(one, each)]
    return Result(one.id, one.title, one.family, tuple(each.outcome() for each in attempts),
                  time.perf_counter() - start)


def is_quick(case, attempt) -> bool:
    """Return whether an attempt is a refusal, or a run of at most 5 s with the default setting."""
    if isinstance(attempt, Refusal):
        return True
    return (isinstance(attempt, Trial) and attempt.setting == Setting() and not case.slow
            and attempt.seconds <= 5.0)


def columns(results: list[Result]) -> list[str]:
    """Return the settings of all attempts, without their labels, in order; NONE_SET last."""
    found = dict.fromkeys(each.column for result in results for each in result.outcomes)
    return [name for name in found if name != NONE_SET] + [NONE_SET] * (NONE_SET in found)


def draw(results: list[Result], file: Path) -> Path:
    """Draw a map of cases and settings: passed, refused, failed; with the textbook solver."""
    names = columns(results)
    shown = [name for name in names if sum(each.column == name for result in results
                                           for each in result.outcomes) > 2]
    shown = [name for name in shown if name != NONE_SET] + ['others', NONE_SET, 'textbook']
    figure, axes = page(11.0, 1.6 + 0.24 * len(results))
    axis = axes[0, 0]
    for y, result in enumerate(results):
        for x, name in enumerate(shown):
            these = [each for each in result.outcomes if name == 'textbook' or name == (
                each.column if each.column in shown else 'others')]
            if name == 'textbook':
                marks = [each.textbook for each in these if each.textbook is not None]
            else:
                marks = [each.good for each in these]
            colour = NONE if not marks else (
                REFUSED if name != 'textbook' and all(marks)
                and all(each.finite is None for each in these) else
                GOOD if all(marks) else BAD)
            axis.add_patch(_cell(x, y, colour))
            if marks:
                axis.text(x, y, f'{sum(marks)}/{len(marks)}', ha='center', va='center',
                          color='white', fontsize=6)
    axis.set_xlim(-0.5, len(shown) - 0.5)
    axis.set_ylim(len(results) - 0.5, -0.5)
    axis.set_xticks(range(len(shown)), shown, rotation=35, ha='left', fontsize=6.5)
    axis.xaxis.tick_top()
    axis.set_yticks(range(len(results)), [f'{r.id} {r.title}' for r in results], fontsize=6.5)
    axis.spines[['left', 'bottom']].set_visible(False)
    axis.tick_params(length=0)
    for colour, text in ((GOOD, 'passed'), (REFUSED, 'refused with its reason'), (BAD, 'failed'),
                         (NONE, 'does not apply')):
        axis.plot([], [], 's', color=colour, label=text)
    axis.legend(loc='upper center', bbox_to_anchor=(0.4, -0.01), ncols=4, fontsize=7,
                frameon=False, labelcolor=INK)
    return save(figure, file)


def table(results: list[Result]) -> str:
    """Return a Markdown table: by case, the passed attempts and the guards that it needs."""
    rows = ['| Case | | Passed | Textbook | Fails without |', '|---|---|---|---|---|']
    for result in results:
        tried = [each for each in result.outcomes if not each.skipped]
        book = [each.textbook for each in tried if each.textbook is not None]
        rows.append(f'| {result.id} | {result.title} | '
                    f'{sum(each.good for each in tried)} of {len(tried)} | '
                    + (f'{sum(book)} of {len(book)} | ' if book else '| ')
                    + '; '.join(one.what for one in GUARDS if one.case == result.id) + ' |')
    return '\n'.join(rows)


def _cell(x: int, y: int, colour: str):
    from matplotlib.patches import Rectangle
    return Rectangle((x - 0.46, y - 0.44), 0.92, 0.88, color=colour)


def skipped(id_: str, title: str, why: str) -> Result:
    """Return the result of a case that cannot be run here, with the reason."""
    return Result(id_, title, 'node', (Outcome('node', False, why=why, skipped=True),), 0.0)
