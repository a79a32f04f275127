"""The thread that steps, on a clock that the test turns."""

from concurrent.futures import CancelledError
import threading
import time
from types import SimpleNamespace

import pytest

from xpbd_ros.ros.stepper import Stepper

FRAME = 10_000_000
"""[ns]"""


class Rig:
    """A stepper that counts frames, and its clock."""

    def __init__(self, mode: str, step=None, now: int = 1):
        self.now = now
        self.frames = 0
        self.errors, self.jumps, self.late = [], [], []
        self.stepper = Stepper(step or self.step, lambda: None, self.errors.append,
                               self.jumps.append, now_ns=lambda: self.now,
                               frame_ns=lambda n: n * FRAME, mode=mode, poll=0.001)

    def step(self, late_ns=None):
        """Compute nothing."""
        self.frames += 1
        self.late.append(None if late_ns is None else late_ns())

    def turn(self, nanoseconds: int) -> int:
        """Turn the clock; return how many frames that made."""
        before = self.frames
        self.now += nanoseconds
        for _ in range(3):
            self.stepper.ask(lambda: None).result(10.0)
            time.sleep(0.01)
        return self.frames - before


@pytest.fixture
def rig():
    """Return a function that makes a stepper; it ends with the test."""
    made = []

    def make(*arguments, **options) -> Rig:
        made.append(Rig(*arguments, **options))
        made[-1].stepper.start()
        made[-1].stepper.ask(lambda: None).result(10.0)
        return made[-1]
    yield make
    for one in made:
        one.stepper.stop()
        assert not one.stepper.is_alive()


def test_steps_when_a_frame_is_due(rig):
    real = rig('realtime')
    assert real.turn(FRAME - 1) == 0
    assert real.turn(1) == 1
    assert real.turn(2 * FRAME) == 2
    assert real.stepper.dropped == 0


def test_drops_what_it_can_not_make_up_for(rig):
    real = rig('realtime')
    assert real.turn(100 * FRAME) < 6
    assert real.stepper.dropped > 90
    assert real.turn(FRAME) == 1, 'and keeps up again'


def test_a_coarse_clock_loses_no_frame(rig, monkeypatch):
    """The 6 frames of a 10 Hz /clock step are computed at once, each with its own delay."""
    monkeypatch.setattr('xpbd_ros.ros.stepper.time', SimpleNamespace(monotonic_ns=lambda: 0))
    real = rig('realtime')
    for _ in range(4):
        assert real.turn(6 * FRAME) == 6
    assert real.late == [k * FRAME for k in (5, 4, 3, 2, 1, 0)] * 4
    assert real.stepper.dropped == 0


def test_tells_how_long_ago_a_frame_was_due(rig):
    real = rig('realtime')
    real.turn(FRAME + 7)
    real.turn(2 * FRAME)
    assert real.late == [7, FRAME + 7, 7]
    real.stepper.switch('fast').result(10.0)
    real.stepper.switch('lockstep').result(10.0)
    assert set(real.late[3:]) == {None}, 'not due at any time'


@pytest.mark.parametrize('seconds', [60, -60, -1000])
def test_a_clock_that_is_set_is_followed_and_no_frame_is_late(rig, seconds):
    real = rig('realtime', now=1000 * 10**9 + 1)
    assert real.turn(2 * FRAME) == 2
    assert real.turn(seconds * 10**9) == 0
    assert [round(jump * 1e-9, 1) for jump in real.jumps] == [seconds]
    assert real.stepper.dropped == 0
    assert real.turn(FRAME) == 1, 'goes on from there'


def test_another_clock_is_followed_from_its_time_on(rig):
    real = rig('realtime', now=1000 * 10**9)
    other = Rig('realtime', now=5 * 10**9)
    real.stepper.follow(lambda: other.now, 0.001).result(10.0)
    assert real.turn(10 * FRAME) == 0
    other.now += FRAME
    assert real.turn(0) == 1
    assert (real.jumps, real.stepper.dropped) == ([], 0)


def test_waits_for_a_clock_that_has_not_begun(rig):
    """As /clock before its first message."""
    real = rig('realtime', now=0)
    assert real.turn(0) == 0
    assert real.turn(1000 * FRAME) == 0
    assert real.stepper.dropped == 0, 'nothing was missed'
    assert real.turn(FRAME) == 1


def test_goes_on_after_the_clock_was_set_back(rig):
    real = rig('realtime', now=1000 * FRAME)
    assert real.turn(2 * FRAME) == 2
    assert real.turn(-500 * FRAME) == 0
    assert real.turn(2 * FRAME) == 2


def test_does_not_make_up_for_another_mode(rig):
    one = rig('lockstep')
    assert one.turn(1000 * FRAME) == 0
    one.stepper.switch('realtime').result(10.0)
    assert one.turn(FRAME) == 1
    assert one.stepper.dropped == 0


def test_tells_what_was_raised_to_whom_it_concerns(rig):
    one = rig('lockstep')
    with pytest.raises(ZeroDivisionError):
        one.stepper.ask(lambda: 1 / 0).result(10.0)
    assert one.stepper.ask(lambda: 7).result(10.0) == 7
    assert one.errors == []


def test_does_not_do_what_was_given_up(rig):
    one = rig('lockstep')
    gate, done = threading.Event(), []
    one.stepper.ask(gate.wait)
    given_up = one.stepper.ask(lambda: done.append('late'))
    assert given_up.cancel()
    gate.set()
    assert one.stepper.ask(lambda: 'still there').result(10.0) == 'still there'
    assert done == []
    with pytest.raises(CancelledError):
        given_up.result(0.0)


def test_an_error_cancels_pending_requests(rig):
    begun, gate = threading.Event(), threading.Event()

    def break_down(late_ns):
        begun.set()
        gate.wait(10.0)
        raise ArithmeticError('no')
    one = rig('lockstep', step=break_down)
    one.stepper.switch('fast')
    assert begun.wait(10.0)
    waiting = [one.stepper.ask(lambda: None) for _ in range(3)]
    gate.set()
    for future in waiting:
        with pytest.raises(RuntimeError, match='the simulation has stopped'):
            future.result(10.0)
    one.stepper.join(10.0)
    assert [type(error) for error in one.errors] == [ArithmeticError]
    with pytest.raises(RuntimeError, match='the simulation has stopped'):
        one.stepper.ask(lambda: None).result(10.0)


def test_stopping_cancels_pending_requests(rig):
    one = rig('lockstep')
    gate = threading.Event()
    one.stepper.ask(gate.wait)
    waiting = one.stepper.ask(lambda: None)
    stopping = threading.Thread(target=one.stepper.stop)
    stopping.start()
    with pytest.raises(RuntimeError, match='the simulation has stopped'):
        waiting.result(10.0)
    gate.set()
    stopping.join(10.0)
