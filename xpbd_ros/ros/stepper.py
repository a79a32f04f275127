"""
The thread that steps: on a clock, on request, or as fast as it can.

Everything that touches the simulation or the log happens here, between frames, so nothing needs a
lock; a service posts what it wants done and waits for the answer.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
import threading
import time

IDLE = 0.2
"""the longest nap, so that something waiting for wall time is looked after [s]"""
LATE_FRAMES = 3
"""frames behind the clock before frames are dropped"""
JUMP_NS = 10**9
"""a clock that goes on by more at once, and by JUMP times what passed, was set [ns]"""
JUMP = 10
STOPPED = 'the simulation has stopped'


class Stepper(threading.Thread):
    """
    Call ``step(late_ns)`` at the right times.

    Parameters
    ----------
    step : computes one frame; is given a function that tells how long ago it was due [ns], or
        None where no time is due
    idle : called at least every IDLE seconds, between frames
    failed : called once with the exception that ended the thread
    jumped : called with how far the clock was set on, or back [ns]
    now_ns : the clock to step on [ns]
    frame_ns : time of frame n since the start [ns], a function of n
    mode : 'realtime', 'lockstep' (only on request) or 'fast'
    poll : how often to look at the clock [s]

    """

    def __init__(self, step: Callable[[Callable[[], int] | None], None],
                 idle: Callable[[], None], failed: Callable[[Exception], None],
                 jumped: Callable[[int], None], *, now_ns: Callable[[], int],
                 frame_ns: Callable[[int], int], mode: str, poll: float = IDLE):
        super().__init__(name='stepper', daemon=True)
        self.mode = mode
        self.playing = True
        self.dropped = 0
        """frames that were not computed in time and never will be"""
        self._step, self._idle, self._failed, self._jumped = step, idle, failed, jumped
        self._now_ns, self._frame_ns = now_ns, frame_ns
        self._poll = poll
        self._wake = threading.Condition()
        self._asked: deque[tuple[Callable, Future]] = deque()
        self._stopping = False
        self._start_ns, self._count = 0, 0
        self._seen = 0, 0    # the clock and a steady one, when they were looked at [ns]

    @property
    def free_running(self) -> bool:
        """Whether it steps without being asked."""
        return self.playing and self.mode != 'lockstep'

    def ask(self, action: Callable) -> Future:
        """Have something done between frames; the future holds what it returned or raised."""
        future: Future = Future()
        with self._wake:
            if self._stopping:
                future.set_exception(RuntimeError(STOPPED))
            else:
                self._asked.append((action, future))
                self._wake.notify()
        return future

    def stop(self) -> None:
        """End after the frame in hand, and wait for that."""
        self._refuse_more()
        if self.is_alive() and threading.current_thread() is not self:
            self.join()

    def switch(self, mode: str) -> Future:
        """Go on in another mode, from the next frame."""
        def switch():
            self.mode = mode
            self.resume()
        return self.ask(switch)

    def follow(self, now_ns: Callable[[], int], poll: float) -> Future:
        """Go on on another clock."""
        def follow():
            self._now_ns, self._poll = now_ns, poll
            self.resume()
        return self.ask(follow)

    def resume(self) -> None:
        """Restart the schedule, so that a pause causes no dropped frames."""
        self._start_ns, self._count = self._now_ns(), 0
        self._seen = self._start_ns, time.monotonic_ns()

    def run(self) -> None:
        """Step until told to stop."""
        try:
            self.resume()
            while not self._stopping:
                self._answer()
                wait = self._due_in()
                if wait <= 0.0:
                    self._step(self._late_ns if self.mode == 'realtime' else None)
                    self._count += 1
                else:
                    self._idle()
                    with self._wake:
                        if not self._asked and not self._stopping:
                            self._wake.wait(min(wait, self._poll))
        except Exception as error:
            self._refuse_more()
            self._failed(error)

    def _refuse_more(self) -> None:
        """Stop, and cancel pending requests."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
            for _, future in self._asked:
                if future.set_running_or_notify_cancel():
                    future.set_exception(RuntimeError(STOPPED))
            self._asked.clear()

    def _answer(self) -> None:
        while True:
            with self._wake:
                if not self._asked:
                    return
                action, future = self._asked.popleft()
            if not future.set_running_or_notify_cancel():
                continue    # the caller timed out
            try:
                future.set_result(action())
            except Exception as error:
                future.set_exception(error)

    def _due_in(self) -> float:
        """Return the time until the next frame is due [s]."""
        if not self.free_running:
            return float('inf')
        if self.mode == 'fast':
            return 0.0
        if self._start_ns == 0:
            self.resume()    # the clock has not begun, or does so now
        now, period = self._now_ns(), self._frame_ns(1)
        if self._was_set(now):
            self.resume()
            return self._poll
        late = now - self._due_ns()
        if late >= LATE_FRAMES * period:
            self.dropped += late // period
            self._start_ns += late // period * period
            late %= period
        return -late * 1e-9

    def _due_ns(self) -> int:
        """Return when the next frame is due [ns]."""
        return self._start_ns + self._frame_ns(self._count + 1)

    def _late_ns(self) -> int:
        """Return for how long the next frame has been due [ns]."""
        return self._now_ns() - self._due_ns()

    def _was_set(self, now: int) -> bool:
        """Tell whether the clock went back, or on by more than could have passed."""
        steady = time.monotonic_ns()
        on, passed = now - self._seen[0], steady - self._seen[1]
        self._seen = now, steady
        back = now - self._start_ns < self._frame_ns(self._count) - self._frame_ns(1)
        if not back and (on <= JUMP_NS or on <= JUMP * passed):
            return False
        self._jumped(on - passed)
        return True
