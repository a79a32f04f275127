"""
Nonlinear least squares for the logarithms of a scene's values.

The search begins at the best of some values over the range of each key. Then
scipy.optimize.least_squares (trust region) minimises the sum of squared residuals. The sum is then
computed along each key; where it is lower, the minimum was a local one, and the search starts from
there. With the Jacobian J at its end, by central differences, the covariance of the logarithms is
s² (JᵀJ)⁻¹, where s² is the mean squared residual. That holds for independent errors of the points;
errors that points share, such as a camera's pose, come on top.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
import math

import numpy as np
from scipy.optimize import least_squares

from xpbd_ros.fit.model import Model

STEP = 0.02
"""of the central differences, in the logarithm"""
SCAN = 17
"""values over the range of a key at which the search looks for its start"""
RESTARTS = 5
"""searches, at most; another one starts where a profile is lower than the minimum found"""
SIGMAS = 1.959964
"""half width of an interval of 95 %, in standard deviations"""
WIDEST = 2.0
"""high over low of an interval, up to which a value is determined"""
RISE = 12.0
"""
least increase of the sum of squares at half and at double a determined value, or at the ends of a
narrower range, in s²
"""
LN2 = math.log(2.0)


@dataclass(frozen=True)
class Key:
    """A key to fit, and the range to search."""

    name: str
    start: float
    low: float
    high: float


@dataclass(frozen=True)
class Value:
    """A fitted value, with an interval of 95 %."""

    value: float
    low: float
    high: float
    determined: bool
    why_not: str
    """reason if it is not determined; else empty"""
    profile: tuple[tuple[float, float], ...]
    """values and RMS residuals [m], the other keys at their fitted values"""


@dataclass(frozen=True)
class Fit:
    """The result of a fit."""

    values: dict[str, Value]
    """by key"""
    residual_m: float
    """RMS residual of a measured number"""
    runs: int
    """runs of the simulation"""


class Search:
    """
    The residuals of logarithms of values, computed in parallel threads.

    Parameters
    ----------
    model : the recording
    keys : keys to fit
    threads : number of threads
    progress : wraps a list of steps to show progress

    """

    def __init__(self, model: Model, keys: Sequence[Key], *, threads: int = 1,
                 progress: Callable[[Iterable, str], Iterable] = lambda items, _: items):
        self._model, self._keys, self._threads = model, keys, threads
        self._progress = progress
        self.runs = 0

    def residuals(self, points: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the residuals at several points of the search."""
        self.runs += len(points)
        with ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(lambda point: self._model.residuals(self.values(point)), points))

    def values(self, point: Iterable[float]) -> dict[str, float]:
        """Return the values by key at a point of the search."""
        return {key.name: math.exp(z) for key, z in zip(self._keys, point)}

    def squares(self, points: Sequence[np.ndarray]) -> np.ndarray:
        """Return the sums of squared residuals [m²] at several points."""
        return np.array([found @ found for found in self.residuals(points)])

    def jacobian(self, point: np.ndarray) -> np.ndarray:
        """Return ∂ residuals / ∂ point by central differences."""
        steps = STEP * np.eye(len(point))
        found = self.residuals([*(point + steps), *(point - steps)])
        return np.stack([(up - down) / (2.0 * STEP) for up, down in zip(
            found[:len(point)], found[len(point):])], axis=1)

    def start(self) -> np.ndarray:
        """Return the best of SCAN values of each key in turn, and the given ones."""
        best = np.log([key.start for key in self._keys])
        for k, key in enumerate(self._progress(self._keys, 'keys')):
            points = [best, *(_with(best, k, z) for z in np.linspace(
                math.log(key.low), math.log(key.high), SCAN))]
            best = points[int(np.argmin(self.squares(points)))]
        return best

    def solve(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the point of least squares, and the covariance there."""
        low, high = (np.log([getattr(key, side) for key in self._keys])
                     for side in ('low', 'high'))
        found = least_squares(lambda point: self.residuals([point])[0],
                              np.clip(start, low + 1e-6, high - 1e-6), self.jacobian,
                              bounds=(low, high), xtol=1e-4, ftol=1e-7, max_nfev=40,
                              gtol=np.finfo(float).eps)    # ends at once where J is 0
        _, scales, axes = np.linalg.svd(self.jacobian(found.x), full_matrices=False)
        least = max(scales.max() * 1e-9, 1e-12)
        spread = axes.T / np.maximum(scales, least)
        return found.x, self.variance(2.0 * found.cost) * spread @ spread.T

    def variance(self, squares: float) -> float:
        """Return s² [m²] of a sum of squares."""
        return squares / max(1, self.numbers - len(self._keys))

    @property
    def numbers(self) -> int:
        """Number of measured numbers."""
        return self._model.numbers


def fit(model: Model, keys: Sequence[Key], start: Mapping[str, float] | None = None, *,
        threads: int = 1,
        progress: Callable[[Iterable, str], Iterable] = lambda items, _: items) -> Fit:
    """
    Return the values of keys that explain a recording best.

    Parameters
    ----------
    model : the recording
    keys : keys to fit
    start : values to begin with; None looks for them over the ranges
    threads : number of parallel threads
    progress : wraps a list of steps to show progress

    """
    search = Search(model, keys, threads=threads, progress=progress)
    point = search.start() if start is None else np.log([start[key.name] for key in keys])
    for _ in range(RESTARTS):
        point, covariance = search.solve(point)
        deviations = np.sqrt(np.diag(covariance))
        least = float(search.squares([point])[0])
        profiles = [_profile(search, point, k, key, deviations[k])
                    for k, key in enumerate(progress(keys, 'profiles'))]
        lowest, k, z = min((squares, k, z) for k, profile in enumerate(profiles)
                           for z, squares in profile)
        if lowest > least - search.variance(least):
            break
        point = _with(point, k, z)    # that was a local minimum
    values = {key.name: _value(search, point[k], key, deviations[k], least, profiles[k])
              for k, key in enumerate(keys)}
    return Fit(values, math.sqrt(least / model.numbers), search.runs)


def _profile(search: Search, point: np.ndarray, k: int, key: Key, deviation: float
             ) -> list[tuple[float, float]]:
    """Return (logarithm of the value, sum of squares), ascending."""
    low, high = math.log(key.low), math.log(key.high)
    near = point[k] + min(max(8.0 * deviation, 0.1), 1.0) * np.linspace(-1.0, 1.0, 9)
    sides = [point[k] - LN2, point[k] + LN2]
    these = sorted({float(np.clip(z, low, high)) for z in (
        *np.linspace(low, high, SCAN), *near, *sides)})
    return list(zip(these, search.squares([_with(point, k, z) for z in these])))


def _value(search: Search, z: float, key: Key, deviation: float, least: float,
           profile: list[tuple[float, float]]) -> Value:
    variance = search.variance(least)
    half, double = max(z - LN2, math.log(key.low)), min(z + LN2, math.log(key.high))
    aside = [squares for other, squares in profile
             if not half < other < double and abs(other - z) > STEP]
    wide = math.exp(min(SIGMAS * deviation, 300.0))
    value = math.exp(z)
    if min(aside, default=math.inf) <= least + RISE * variance:
        why = 'the residual is flat: this motion does not depend on it'
    elif value <= key.low * (1.0 + STEP) or value >= key.high / (1.0 + STEP):
        why = 'at the end of its range'
    elif wide**2 > WIDEST:
        why = f'its interval is wider than a factor of {WIDEST:g}'
    else:
        why = ''
    return Value(value, max(value / wide, key.low), min(value * wide, key.high), not why, why,
                 tuple((math.exp(other), math.sqrt(squares / search.numbers))
                       for other, squares in profile))


def _with(point: np.ndarray, k: int, z: float) -> np.ndarray:
    """Return a copy of a point with another coordinate k."""
    changed = np.array(point, float)
    changed[k] = z
    return changed
