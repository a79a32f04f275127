"""Time candidates in turn, so that whatever else the machine does falls on all of them alike."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import time

import numpy as np


@dataclass
class Timed:
    """One candidate: ``run(count)`` does its work so many times."""

    run: Callable[[int], None]
    units: float = 1.0
    """how many of what is reported are in one piece of work"""
    reset: Callable[[], None] = lambda: None
    """goes back to the start; not timed"""
    most: int = 10**9
    """largest count"""


def interleave(candidates: Sequence[Timed], *, rounds: int, seconds: float) -> np.ndarray:
    """
    Return seconds per unit, shape (candidates, rounds).

    Every candidate runs to warm up; then its count is chosen to take about ``seconds``.
    """
    counts = []
    for candidate in candidates:
        _timed(candidate, 1)
        once = _timed(candidate, 1)
        counts.append(min(max(1, round(seconds / max(once, 1e-7))), candidate.most))
    found = np.empty((len(candidates), rounds))
    for k in range(rounds):
        for c, (candidate, count) in enumerate(zip(candidates, counts)):
            found[c, k] = _timed(candidate, count) / (count * candidate.units)
    return found


def _timed(candidate: Timed, count: int) -> float:
    candidate.reset()
    start = time.perf_counter()
    candidate.run(count)
    return time.perf_counter() - start
