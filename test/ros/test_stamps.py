"""Stamps: within a frame of the clock, evenly where frames come in time, and never back."""

import random

import pytest

from xpbd_ros.ros.stamps import Stamps, STEADY_NS

FRAME = 16_666_667
"""[ns]"""
BEGIN = 1_700_000_000_000_000_000
"""what the clock says at the start [ns]"""


@pytest.fixture
def stamps():
    """Return stamps that begin at frame 0."""
    stamps = Stamps()
    assert stamps.begin(0, BEGIN) == BEGIN
    return stamps


def test_frames_late_within_a_frame_have_even_stamps(stamps):
    noise = random.Random(1)
    for k in range(1, 200):
        late = noise.randrange(FRAME)
        reading = noise.randrange(STEADY_NS // 2)    # between one clock and the other
        assert stamps.at(k * FRAME, BEGIN + k * FRAME + late + reading, late) == BEGIN + k * FRAME
    assert stamps.moved_ns == 0


def test_after_a_pause_they_are_the_clocks_again(stamps):
    pause = 6 * 10**9
    for k in range(1, 10):
        assert stamps.at(k * FRAME, BEGIN + pause + k * FRAME, 0) == BEGIN + pause + k * FRAME
    assert stamps.moved_ns == pause


def test_frames_that_are_not_due_are_from_now_and_rise(stamps):
    now = BEGIN
    for k in range(1, 100):
        now += 10**6 if k < 50 else 0    # a clock that stands still
        last = stamps.last_ns
        assert now <= stamps.at(k * FRAME, now) <= now + 50
        assert stamps.last_ns > last
    assert abs(stamps.at(100 * FRAME, now + FRAME, 0) - now - FRAME) <= STEADY_NS


@pytest.mark.parametrize('back', [10**9, BEGIN - 7])
def test_a_clock_that_goes_back_is_followed(stamps, back):
    stamps.at(FRAME, BEGIN + FRAME, 0)
    now = BEGIN + FRAME - back
    assert stamps.at(2 * FRAME, now, 0) == now
    assert stamps.at(3 * FRAME, now + FRAME, 0) == now + FRAME
    assert stamps.begin(3 * FRAME, now + 2 * FRAME) == now + 2 * FRAME
    assert stamps.moved_ns == 0


def test_a_clock_that_is_simulation_time_itself_gives_it(stamps):
    assert [stamps.even(k * FRAME) for k in range(5)] == [BEGIN + k * FRAME for k in range(5)]
