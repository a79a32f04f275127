"""The front and the recommendation, against their definitions."""

import numpy as np
import pytest

from xpbd_ros.study.accuracy.choose import judge_defaults, mark_front, on_front, recommend, Row
from xpbd_ros.study.accuracy.errors import Errors
from xpbd_ros.study.accuracy.report import texts_of
from xpbd_ros.study.accuracy.solver_setting import Setting
from xpbd_ros.study.accuracy.timing import Timing


def row(ms, error, *, p95=None, method='line', substeps=1) -> Row:
    return Row(Setting(method, 'bdf2', substeps), Errors((error,), (error,), height_m=error),
               None if ms is None else Timing(ms, ms if p95 is None else p95, 1.0, 10, 100))


@pytest.mark.parametrize('seed', range(20))
def test_the_front_is_what_nothing_dominates(seed):
    random = np.random.default_rng(seed)
    points = [tuple(map(float, point)) for point in random.integers(1, 12, (25, 2))]
    for point, on in zip(points, on_front(points)):
        beaten = any(a <= point[0] and b <= point[1] and (a, b) != point for a, b in points)
        assert on == (not beaten)


def test_baselines_and_what_is_not_finite_are_not_on_the_front():
    rows = [row(2.0, 0.1), row(1.0, 0.01, method='pbd'), row(1.0, float('nan')), row(None, 0.01)]
    mark_front(rows, 'position')
    assert [one.pareto for one in rows] == [True, False, False, False]
    assert recommend(rows, 'position', budget=5.0) is rows[0]


@pytest.mark.parametrize('seed', range(10))
def test_what_is_recommended_obeys_and_is_the_best(seed):
    random = np.random.default_rng(seed)
    rows = [row(ms, error, p95=slower * ms) for ms, error, slower in random.uniform(
        [0.1, 0.1, 1.0], [10.0, 10.0, 3.0], (30, 3))]
    for budget in (0.5, 3.0, 20.0):
        best = recommend(rows, 'position', budget=budget)
        fits = [one for one in rows if one.timing.ms_p95 <= budget]
        assert (best is None) == (not fits)
        if fits:
            assert best.timing.ms_p95 <= budget
            assert best.error('position') == min(one.error('position') for one in fits)
    for most in (0.01, 2.0, 20.0):
        best = recommend(rows, 'position', max_error=most)
        fits = [one for one in rows if one.error('position') <= most]
        assert (best is None) == (not fits)
        if fits:
            assert best.timing.ms_p50 == min(one.timing.ms_p50 for one in fits)


def test_errors_below_what_the_truth_is_known_to_count_as_equal():
    rows = [row(1.0, 1.2e-3), row(8.0, 1.0e-3), row(0.5, 9e-3)]
    assert recommend(rows, 'position', budget=10.0) is rows[1]
    assert recommend(rows, 'position', budget=10.0, floor=2e-3) is rows[0]
    assert recommend(rows, 'position', budget=10.0, floor=1e-4) is rows[1]


def test_both_wishes_must_be_met():
    rows = [row(1.0, 0.1), row(5.0, 0.01)]
    assert recommend(rows, 'position', budget=2.0, max_error=0.05) is None
    assert recommend(rows, 'position', budget=6.0, max_error=0.05) is rows[1]


def test_a_default_is_judged_by_the_best_that_is_as_fast():
    """The fastest of those within the truth's uncertainty; a faster budget has another one."""
    rows = [row(1.0, 8e-3, substeps=1), row(4.0, 6e-3, substeps=4),
            row(3.9, 1e-3, method='explicit'), row(3.0, 1.1e-3, substeps=3),
            row(9.0, 1e-4, substeps=9)]
    chosen = {2.0: rows[0].setting, 4.0: rows[1].setting, 8.0: Setting('jacobi', 'bdf2', 1)}
    two, four = judge_defaults(rows, 'position', chosen)
    assert (two.budget_ms, two.row, two.best, two.ratio) == (2.0, rows[0], rows[0], 1.0)
    assert (four.row, four.best) == (rows[1], rows[2])
    assert four.ratio == pytest.approx(6.0)
    _, four = judge_defaults(rows, 'position', chosen, floor=2e-3)
    assert four.best is rows[3]
    assert four.ratio == pytest.approx(3.0)
    _, four = judge_defaults(rows, 'position', chosen, floor=1e-2)
    assert four.ratio == 1.0


def test_budgets_that_lead_to_one_setting_share_a_line():
    cheap, dear = row(1.0, 0.1), row(5.0, 0.01, substeps=4)
    found = judge_defaults([cheap, dear], 'position', {
        2.0: cheap.setting, 4.0: cheap.setting, 8.0: dear.setting})
    assert texts_of(found, 'position') == [
        f'auto with {budgets} ms is line bdf2 {substeps}×1: {numbers}; no setting as fast is '
        'more accurate' for budgets, substeps, numbers in (
            ('2, 4', 1, '0.1 m, 1 ms p95'), ('8', 4, '0.01 m, 5 ms p95'))]
