"""Cases with known solutions, and the rows of their results."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

ORDER_WITHIN = 0.15
"""largest deviation of a measured order of convergence from the expected one"""


@dataclass(frozen=True)
class Row:
    """One expected value, the computed one, and its error."""

    name: str
    expected: float
    got: float
    unit: str
    tolerance: float
    """largest error that passes"""
    error: float
    norm: str = 'relative'
    """norm of the error"""
    order_expected: float | None = None
    order: float | None = None
    """measured order of convergence"""
    ladder: tuple[tuple[float, float], ...] = ()
    """(step, error) from which the order is measured, coarse to fine"""
    step: str = ''
    """name and unit of the steps"""

    @property
    def good(self) -> bool:
        """True if error and order are within their tolerances."""
        right = self.error <= self.tolerance
        if self.order_expected is not None:
            assert self.order is not None
            right = right and abs(self.order - self.order_expected) <= ORDER_WITHIN
        return bool(right)


@dataclass(frozen=True)
class Case:
    """One case; ``rows()`` computes its rows."""

    id: str
    title: str
    family: str
    rows: Callable[[], Iterable[Row]]
    slow: bool = False


CASES: list[Case] = []


def case(id_: str, title: str, *, slow: bool = False):
    """Return a decorator that registers a function, which yields rows, as a case."""
    def register(rows):
        CASES.append(Case(id_, title, rows.__module__.rpartition('.')[2], rows, slow))
        return rows
    return register


def value(name: str, expected: float, got: float, unit: str, tolerance: float, *,
          absolute: bool = False, scale: float | None = None) -> Row:
    """Return a row with an absolute error, or one relative to ``expected`` or ``scale``."""
    error = abs(got - expected)
    if not absolute:
        error /= abs(expected) if scale is None else scale
    return Row(name, float(expected), float(got), unit, tolerance, float(error),
               'absolute' if absolute else 'relative' if scale is None else f'of {scale:.3g}')


def order(name: str, expected: float, steps: Sequence[float],
          got: Sequence[float] | np.ndarray, unit: str, order_expected: float, tolerance: float,
          *, step: str) -> Row:
    """
    Return a row for values that converge with a step; the last value counts.

    The order is the slope of the regression line of log(error) over log(step).
    """
    errors = np.abs(np.asarray(got, float) - expected)
    slope = float(np.polyfit(np.log(steps), np.log(errors), 1)[0])
    scale = abs(expected) or 1.0
    return Row(name, float(expected), float(got[-1]), unit, tolerance, float(errors[-1] / scale),
               'relative' if expected else 'absolute', order_expected, slope,
               tuple(zip(map(float, steps), (errors / scale).tolist())), step)
