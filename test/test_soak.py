"""A long run under random commands; ``python test/support/soak.py`` does it for hours."""

import pytest

from support.soak import soak


@pytest.mark.slow
def test_ten_minutes_at_the_default_setting_leave_nothing_behind():
    found = soak(600.0, {})
    assert found['worse'] == [], found
    assert found['method_switches'] > 10


@pytest.mark.slow
def test_ten_minutes_leave_nothing_behind():
    found = soak(600.0)
    assert found['worse'] == [], found
