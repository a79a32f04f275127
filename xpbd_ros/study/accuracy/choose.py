"""Mark the Pareto front of error and time, recommend a setting, and judge the default by it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math

from xpbd_ros.study.accuracy.errors import Errors
from xpbd_ros.study.accuracy.solver_setting import Setting
from xpbd_ros.study.accuracy.timing import Timing

POSITION, SHAPE = 'position', 'shape'


@dataclass
class Row:
    """A setting with its errors and its timing."""

    setting: Setting
    errors: Errors
    timing: Timing | None = None
    pareto: bool = False
    scene: bool = False
    """True if it is the setting of the scene itself"""

    @property
    def timed(self) -> Timing:
        """The timing of a row that has one."""
        assert self.timing is not None
        return self.timing

    def error(self, by: str) -> float:
        """Return the error by POSITION (at the last time) or SHAPE [m]; NaN if there is none."""
        if by == SHAPE:
            return self.errors.height_m
        return self.errors.rms_m[-1] if self.errors.rms_m and self.errors.finite else math.nan


def judged(rows: Sequence[Row], by: str) -> list[Row]:
    """Return the rows that have both a time and an error, without baselines."""
    return [row for row in rows if row.timing is not None and math.isfinite(row.error(by))
            and not row.setting.is_baseline]


def on_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Return for each point (ms, error) whether no other point dominates it."""
    order = sorted(range(len(points)), key=lambda k: points[k])
    found, best, last = [False] * len(points), math.inf, None
    for k in order:
        if points[k][1] < best or points[k] == last:
            found[k], best, last = True, points[k][1], points[k]
    return found


def mark_front(rows: Sequence[Row], by: str) -> None:
    """Mark the rows on the Pareto front of time and error."""
    known = judged(rows, by)
    for row, on in zip(known, on_front([(row.timed.ms_p50, row.error(by)) for row in known])):
        row.pareto = on


def recommend(rows: Sequence[Row], by: str, *, budget: float | None = None,
              max_error: float | None = None, floor: float = 0.0) -> Row | None:
    """
    Return the recommended row, or None if no row is within the limits.

    With ``max_error`` it is the fastest row within it, else the most accurate row whose 95th
    percentile of the frame time is within the budget.

    Parameters
    ----------
    rows : candidates
    by : POSITION or SHAPE
    budget : time per frame [ms]; None for no limit
    max_error : [m]; None for no limit
    floor : uncertainty of the true solution [m]; smaller errors count as equal

    """
    known = [row for row in judged(rows, by)
             if (budget is None or row.timed.ms_p95 <= budget)
             and (max_error is None or row.error(by) <= max_error)]
    if not known:
        return None
    if max_error is None:
        best = min(row.error(by) for row in known)
        known = [row for row in known if row.error(by) <= max(best, floor)]
    return min(known, key=lambda row: row.timed.ms_p50)


@dataclass(frozen=True)
class Default:
    """What ``auto`` chose with a budget, beside the best setting that is as fast."""

    budget_ms: float
    row: Row
    best: Row
    """the most accurate row whose 95th percentile of the frame time is not larger"""
    ratio: float
    """error over that of ``best``, both at least the uncertainty of the true solution"""


def judge_defaults(rows: Sequence[Row], by: str, chosen: Mapping[float, Setting],
                   floor: float = 0.0) -> list[Default]:
    """
    Return the settings that ``auto`` chose beside the best ones; without those not judged.

    Parameters
    ----------
    rows : all settings
    by : POSITION or SHAPE
    chosen : settings of ``auto``, by budget [ms]
    floor : uncertainty of the true solution [m]

    """
    found = []
    known = {row.setting.key: row for row in judged(rows, by)}
    for budget, setting in chosen.items():
        if setting.key in known:
            row = known[setting.key]
            best = recommend(rows, by, budget=row.timed.ms_p95, floor=floor)
            assert best is not None
            least = max(best.error(by), floor)
            ratio = max(row.error(by), floor) / least if least > 0.0 else 1.0
            found.append(Default(budget, row, best, ratio))
    return found
