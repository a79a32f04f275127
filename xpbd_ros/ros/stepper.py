"""
The thread that steps the simulation: by a clock, on request, or as fast as possible.

All access to the simulation and the log happens in this thread, between frames, so neither needs
a lock; a service posts an action and waits for its result.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
import threading
import time

IDLE = 0.2
"""longest sleep, so that work in wall time (markers, diagnostics, flushes) is done [s]"""
LATE_FRAMES = 3
"""delay at which frames are dropped [frames]"""
COARSE_NS = 250_000_000
"""largest step of a clock whose frames are computed at once, as of /clock at 4 Hz [ns]"""
STEPS = 8
"""latest steps of the clock of which the largest counts"""
JUMP_NS = 10**9
"""a clock that advances by more than this between two readings may have been set [ns]"""
JUMP = 10
"""a clock that also advances by more than this times the elapsed time has been set"""
STOPPED = 'the simulation has stopped'


class Stepper(threading.Thread):
    """
    Call ``step(late_ns)`` when a frame is due.

    Parameters
    ----------
    step : computes one frame; is given a function that returns the time since the frame was due
        [ns], or None in modes without due times
    idle : called between frames, at least every IDLE seconds
    failed : called once, with the exception that ended the thread
    jumped : called with the change of a clock that was set [ns]
    now_ns : clock to step on [ns]
    frame_ns : time of frame n after the start [ns], as a function of n
    mode : 'realtime', 'lockstep' (only on request) or 'fast'
    poll : period at which to read the clock [s]

    """

    def __init__(self, step: Callable[[Callable[[], int] | None], None],
                 idle: Callable[[], None], failed: Callable[[Exception], None],
                 jumped: Callable[[int], None], *, now_ns: Callable[[], int],
                 frame_ns: Callable[[int], int], mode: str, poll: float):
        super().__init__(name='stepper', daemon=True)
        self.mode = mode
        self.playing = True
        self.dropped = 0
        """dropped frames: they were late and are never computed"""
        self._step, self._idle, self._failed, self._jumped = step, idle, failed, jumped
        self._now_ns, self._frame_ns = now_ns, frame_ns
        self._poll = poll
        self._wake = threading.Condition()
        self._asked: deque[tuple[Callable, Future]] = deque()
        self._stopping = False
        self._start_ns, self._count = 0, 0
        self._seen = 0, 0    # last readings of the clock and of a steady clock [ns]
        self._steps: deque[int] = deque([0], STEPS)    # of the clock, beyond the time passed [ns]

    @property
    def free_running(self) -> bool:
        """True while playing in mode ``realtime`` or ``fast``: frames need no request."""
        return self.playing and self.mode != 'lockstep'

    def ask(self, action: Callable) -> Future:
        """Call ``action()`` between frames; return a future with its result or exception."""
        future: Future = Future()
        with self._wake:
            if self._stopping:
                future.set_exception(RuntimeError(STOPPED))
            else:
                self._asked.append((action, future))
                self._wake.notify()
        return future

    def stop(self) -> None:
        """Stop after the present frame, and wait for the thread to end."""
        self._refuse_more()
        if self.is_alive() and threading.current_thread() is not self:
            self.join()

    def switch(self, mode: str) -> Future:
        """Change the mode, from the next frame on."""
        def switch():
            self.mode = mode
            self.resume()
        return self.ask(switch)

    def follow(self, now_ns: Callable[[], int], poll: float) -> Future:
        """Step by another clock, read with period ``poll`` [s]."""
        def follow():
            self._now_ns, self._poll = now_ns, poll
            self.resume()
        return self.ask(follow)

    def resume(self) -> None:
        """Restart the schedule, so that a pause causes no dropped frames."""
        self._start_ns, self._count = self._now_ns(), 0
        self._seen = self._start_ns, time.monotonic_ns()

    def run(self) -> None:
        """Step until ``stop`` is called."""
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
        """Call the posted actions."""
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
            self.resume()    # the clock has not started, or starts now
        now, period = self._now_ns(), self._frame_ns(1)
        if self._was_set(now):
            self.resume()
            return self._poll
        late = now - self._due_ns()
        if late >= LATE_FRAMES * period + max(self._steps):
            self.dropped += late // period
            self._start_ns += late // period * period
            late %= period
        return -late * 1e-9

    def _due_ns(self) -> int:
        """Return the time at which the next frame is due [ns]."""
        return self._start_ns + self._frame_ns(self._count + 1)

    def _late_ns(self) -> int:
        """Return the time since the next frame was due [ns], at most a frame or a clock's step."""
        late = self._now_ns() - self._due_ns()
        return min(max(late, 0), max(self._frame_ns(1), *self._steps))

    def _was_set(self, now: int) -> bool:
        """Return whether the clock went back, or forward by far more than the elapsed time."""
        steady = time.monotonic_ns()
        on, passed = now - self._seen[0], steady - self._seen[1]
        self._seen = now, steady
        back = now - self._start_ns < self._frame_ns(self._count) - self._frame_ns(1)
        if not back and (on <= JUMP_NS or on <= JUMP * passed):
            if on:
                self._steps.append(on - passed if passed < on <= COARSE_NS else 0)
            return False
        self._jumped(on - passed)
        return True
