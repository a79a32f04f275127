"""A long run under random commands; ``python test/support/soak.py`` does it for hours."""

import pytest

from support.soak import soak


@pytest.mark.slow
def test_ten_minutes_leave_nothing_behind():
    found = soak(600.0)
    assert found['worse'] == [], found
