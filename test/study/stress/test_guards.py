"""Each guard of the solver is needed by the case that it is for."""

import pytest

from xpbd_ros.study.stress import all_hard
from xpbd_ros.study.stress.guards import GUARDS, PACKAGE, without

ATTEMPTS = {one.id: one.attempts for one in all_hard()}


@pytest.mark.parametrize('guard', GUARDS, ids=lambda one: f'{one.case} {one.what}')
def test_a_guard_is_where_it_is_said_to_be(guard):
    assert (PACKAGE / guard.file).read_text(encoding='utf-8').count(guard.code) == 1
    assert guard.attempt in [getattr(each, 'name', '') for each in ATTEMPTS[guard.case]()]


@pytest.mark.slow
@pytest.mark.parametrize('guard', GUARDS, ids=lambda one: f'{one.case} {one.what}')
def test_its_case_fails_without_it(guard):
    assert without(guard)
