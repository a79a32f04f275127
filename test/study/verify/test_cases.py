"""Every case with a known answer is met, and every wrong scheme is found out."""

from pathlib import Path

import numpy as np
import pytest

from xpbd_ros.study.verify import all_cases, FAMILIES
from xpbd_ros.study.verify.case import order, value
from xpbd_ros.study.verify.controls import controls
from xpbd_ros.study.verify.negative_controls import chain, RIGHT

PAGE = Path(__file__).parents[3] / 'doc' / 'verification.md'
EVERY = [one for family in all_cases().values() for one in family]


COMPILING = ('V1', 'V2', 'V3', 'V11', 'V14', 'V15', 'V16', 'V17', 'V19', 'V20', 'V22', 'V24',
             'V27', 'V28', 'V31')
"""cases whose steps no other test compiles; most are laws of test/effects, too"""


@pytest.mark.parametrize('case', [
    pytest.param(one, id=f'{one.id}-{one.rows.__name__}',
                 marks=[pytest.mark.slow] * (one.slow or one.id in COMPILING))
    for one in EVERY])
def test_case(case):
    rows = list(case.rows())
    assert rows
    for row in rows:
        assert np.isfinite([row.expected, row.got, row.error]).all(), row
        assert row.good, row


def test_its_page_lists_every_case():
    text = ' '.join(PAGE.read_text(encoding='utf-8').split())
    for one in {one.id: one for one in reversed(EVERY)}.values():
        assert f'| {one.id} | {one.title} | ' in text
    for one in controls():
        assert f'| {one.scheme} | {one.id} | ' in text


def test_every_family_has_cases_with_ids_and_titles():
    assert set(all_cases()) == set(FAMILIES)
    for family, cases in all_cases().items():
        assert cases, family
        for one in cases:
            assert one.id[0] == 'V'
            assert one.id[1:].isdigit()
            assert one.title


@pytest.mark.parametrize('control', controls(), ids=lambda one: f'{one.id} {one.scheme}')
def test_a_wrong_scheme_fails_its_case(control):
    assert control.error > 10.0 * control.tolerance
    assert control.fails


def test_the_scheme_that_the_controls_spoil_is_right_unspoilt():
    """So it is the one thing that each control changes which the case finds out."""
    sag = 9.80665 / 1000.0
    for iterations in (1, 10):
        assert chain(1, RIGHT, iterations=iterations)[-1] - 1.0 == pytest.approx(0.5 * sag,
                                                                                 rel=1e-9)
    got = [chain(4, RIGHT, iterations=k, steps=400)[-1] - 1.0 for k in (20, 80)]
    assert got[0] == pytest.approx(got[1], rel=0.01)


def test_a_row_judges_its_error_and_its_order():
    assert value('a', 2.0, 2.02, 'm', 0.011).good
    assert not value('a', 2.0, 2.02, 'm', 0.009).good
    assert not value('a', 2.0, float('nan'), 'm', 1.0).good
    steps = (0.4, 0.2, 0.1)
    for slope, good in ((2.0, True), (1.8, False), (1.0, False)):
        row = order('a', 1.0, steps, [1.0 + h**slope for h in steps], 'm', 2.0, 1.0, step='h')
        assert row.order == pytest.approx(slope)
        assert row.good == good
