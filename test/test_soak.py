"""A long run under random commands; ``python test/soak.py`` does it for hours."""

import pytest
from soak import soak


@pytest.mark.slow
def test_ten_minutes_leave_nothing_behind():
    found = soak(600.0)
    assert found['worse'] == [], found
