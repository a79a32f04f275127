"""Which frames of a run are timed."""

from types import SimpleNamespace

import pytest

from xpbd_ros.study.accuracy import timing
from xpbd_ros.study.accuracy.timing import ENOUGH_S, LEAST_FRAMES, time_frames

FRAMES, LATE = 600, 500


@pytest.fixture
def timed(monkeypatch):
    """Return a function that times a run of frames of 10 ms, some of which take longer late."""
    def of(early_ms: float, late_ms: float):
        clock, count = [0.0], [0]

        def step(inputs):
            count[0] += 1
            clock[0] += 1e-3 * (early_ms if count[0] <= LATE else late_ms)
        for name in ('thread_time', 'perf_counter'):
            monkeypatch.setattr(timing, name, lambda: clock[0])
        return time_frames(SimpleNamespace(compile=lambda: None, step=step, frame_dt=0.01,
                                           state=(), effects={}), FRAMES, {})
    return of


@pytest.mark.parametrize('early_ms', [0.1, 5.0, 9.9])
def test_a_setting_that_holds_real_time_is_timed_to_the_end(timed, early_ms):
    """All settings are compared over the same frames, of which the last may be in contact."""
    found = timed(early_ms, 3.0 * early_ms)
    assert (found.frames, found.ms_p50) == (FRAMES, pytest.approx(early_ms))
    assert found.ms_p95 == pytest.approx(3.0 * early_ms)


@pytest.mark.parametrize('early_ms', [21.0, 40.0, 1000.0])
def test_a_slower_one_is_timed_for_as_long_as_is_enough(timed, early_ms):
    found = timed(early_ms, early_ms)
    assert found.frames == max(LEAST_FRAMES, int(1e3 * ENOUGH_S / early_ms) + 1)
