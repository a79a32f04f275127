"""Log time passes at the rate, stands still, and jumps."""

import math

from xpbd_ros.log.replay_clock import Playhead


class Steady:
    """A clock that is moved by hand (ns)."""

    def __init__(self):
        self.now = 5_000_000_000

    def __call__(self):
        return self.now

    def pass_s(self, seconds):
        self.now += round(seconds * 1e9)


def test_time_passes_at_the_rate():
    steady = Steady()
    head = Playhead(1_000, rate=2.0, clock=steady)
    steady.pass_s(1.5)
    assert head.time_ns == 1_000 + 3_000_000_000


def test_a_wait_is_in_wall_time():
    head = Playhead(0, rate=4.0, clock=Steady())
    assert head.wait(2_000_000_000) == 0.5
    assert head.wait(0) == 0.0
    assert head.wait(-1) == 0.0


def test_no_time_passes_while_paused():
    steady = Steady()
    head = Playhead(100, clock=steady)
    steady.pass_s(1.0)
    head.pause()
    steady.pass_s(9.0)
    assert head.time_ns == 1_000_000_100
    assert head.wait(0) == math.inf
    head.resume()
    steady.pass_s(1.0)
    assert head.time_ns == 2_000_000_100


def test_another_rate_goes_on_from_the_present():
    steady = Steady()
    head = Playhead(0, clock=steady)
    steady.pass_s(1.0)
    head.set_rate(3.0)
    assert head.time_ns == 1_000_000_000
    steady.pass_s(1.0)
    assert head.time_ns == 4_000_000_000


def test_a_pause_while_paused_changes_nothing():
    steady = Steady()
    head = Playhead(100, paused=True, clock=steady)
    steady.pass_s(1.0)
    head.pause()
    assert head.time_ns == 100


def test_a_resume_while_playing_changes_nothing():
    steady = Steady()
    head = Playhead(0, clock=steady)
    steady.pass_s(1.0)
    head.resume()
    assert head.time_ns == 1_000_000_000


def test_a_jump_keeps_playing_or_standing():
    steady = Steady()
    head = Playhead(0, paused=True, clock=steady)
    head.jump(700)
    steady.pass_s(1.0)
    assert head.time_ns == 700
    head.resume()
    head.jump(0)
    steady.pass_s(1.0)
    assert head.time_ns == 1_000_000_000
