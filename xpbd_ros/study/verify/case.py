"""What a case is, and a row of its answer."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

ORDER_WITHIN = 0.15
"""how far a measured order of convergence may be from the expected one"""


@dataclass(frozen=True)
class Row:
    """One number that is known, and ours."""

    name: str
    expected: float
    got: float
    unit: str
    tolerance: float
    """largest error"""
    error: float
    norm: str = 'relative'
    """what the error is"""
    order_expected: float | None = None
    order: float | None = None
    ladder: tuple[tuple[float, float], ...] = ()
    """steps and errors that the order is from, coarse to fine"""
    step: str = ''
    """what the ladder's steps are, with their unit"""

    @property
    def good(self) -> bool:
        """Whether the error is small enough, and the order as expected."""
        right = self.error <= self.tolerance
        if self.order_expected is not None:
            right = right and abs(self.order - self.order_expected) <= ORDER_WITHIN
        return bool(right)


@dataclass(frozen=True)
class Case:
    """One case: ``rows()`` computes."""

    id: str
    title: str
    family: str
    rows: Callable[[], Iterable[Row]]
    slow: bool = False


CASES: list[Case] = []


def case(id_: str, title: str, *, slow: bool = False):
    """Register a function that yields rows."""
    def register(rows):
        CASES.append(Case(id_, title, rows.__module__.rpartition('.')[2], rows, slow))
        return rows
    return register


def value(name: str, expected: float, got: float, unit: str, tolerance: float, *,
          absolute: bool = False, scale: float | None = None) -> Row:
    """Return a row whose error is relative: to what is expected, or to ``scale``; or absolute."""
    error = abs(got - expected)
    if not absolute:
        error /= abs(expected) if scale is None else scale
    return Row(name, float(expected), float(got), unit, tolerance, float(error),
               'absolute' if absolute else 'relative' if scale is None else f'of {scale:.3g}')


def order(name: str, expected: float, steps: Sequence[float], got: Sequence[float], unit: str,
          order_expected: float, tolerance: float, *, step: str) -> Row:
    """
    Return a row for values that converge with a step; the last is ours.

    The order is the slope of a straight line through log(error) over log(step).
    """
    errors = np.abs(np.asarray(got, float) - expected)
    slope = float(np.polyfit(np.log(steps), np.log(errors), 1)[0])
    scale = abs(expected) or 1.0
    return Row(name, float(expected), float(got[-1]), unit, tolerance, float(errors[-1] / scale),
               'relative' if expected else 'absolute', order_expected, slope,
               tuple(zip(map(float, steps), (errors / scale).tolist())), step)
