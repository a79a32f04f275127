"""
Extrapolate either method to dt → 0.

Runs with steps that halve each time are extrapolated (Richardson); the uncertainty follows from
the differences of the last extrapolations.
"""

from dataclasses import dataclass
import hashlib
import math
import os
from pathlib import Path as FilePath
import zipfile

import numpy as np

from xpbd_ros.study.reference.leapfrog import explicit, StepTooLongError
from xpbd_ros.study.reference.newton import newton, tolerance_of
from xpbd_ros.study.reference.problem import Array, EPS, highest_frequency_bound, Problem, rms

POWERS = {'explicit': (2, 4), 'bdf2': (2, 3), 'backward_euler': (1, 2)}
"""the two lowest powers of dt in the error at a fixed time"""


@dataclass(frozen=True, eq=False)
class Reference:
    """Positions and velocities at a time, with their uncertainties."""

    x: Array
    """positions [m], shape (n, 3)"""
    v: Array
    """velocities [m/s], shape (n, 3)"""
    uncertainty: float
    """uncertainty of x, RMS over the particles [m]"""
    uncertainty_v: float
    """uncertainty of v, RMS over the particles [m/s]"""
    time: float
    """time since the start of the problem [s]"""
    method: str
    """'explicit', 'bdf2' or 'backward_euler'"""
    ladder: tuple[tuple[float, float], ...]
    """(step dt [s], RMS distance of its positions from x [m]) of each run"""

    def error(self, x: Array) -> float:
        """Return the RMS distance of positions, shape (n, 3), from these [m]."""
        return rms(x - self.x)


def limit(problem: Problem, time: float, tolerance: float, *, method: str = 'explicit',
          dt: float | None = None, levels: int = 10,
          cache: str | os.PathLike | None = None) -> Reference:
    """
    Return the solution at a time, for dt → 0.

    With rungs X(dt), X(dt/2), … of a method of order p, the extrapolation is
    T_k = X_k + (X_k - X_{k-1}) / (2^p - 1), whose error goes with the next power q. With
    d_k = rms(T_k - T_{k-1}), the uncertainty is max(d_k, d_{k-1} / 2^q); if the error has these
    powers, it is smaller by 2^q - 1. If d falls by less than half from rung to rung, the expected
    change by further rungs is added, as are the effects of rounding and of the tolerance of
    Newton's method. There are at least four rungs.

    The ladder ends when the uncertainty is within ``tolerance``, after ``levels`` rungs, or when
    two rungs in a row have not lowered it, by rounding or in a chaotic scene. The result with the
    smallest uncertainty is returned, which may exceed the tolerance.

    Parameters
    ----------
    problem : the initial value problem
    time : time since the start [s]; a multiple of the problem's ``interval`` if it has one
    tolerance : wanted uncertainty of the positions [m]
    method : 'explicit', 'bdf2' or 'backward_euler'
    dt : approximate first and longest step [s]; None for 1/240 s with implicit methods, and for
        a step that is stable at the start with leapfrog
    levels : largest number of rungs
    cache : folder where rungs are kept for later calls

    """
    if method not in POWERS:
        raise ValueError(f'method: must be one of {", ".join(POWERS)} (got {method!r})')
    if not 0.0 < time < np.inf:
        raise ValueError(f'time: must be > 0 s (got {time:g})')
    if not levels >= 4:
        raise ValueError(f'levels: must be >= 4 (got {levels})')
    multiple = 1
    if problem.interval is not None:
        multiple = round(time / problem.interval)
        if multiple < 1 or abs(multiple * problem.interval - time) > 1e-9 * time:
            raise ValueError(f'time: must be a multiple of {problem.interval:g} s, the interval '
                             f'of the motion (got {time:g})')
    if dt is None:
        fastest = highest_frequency_bound(problem, problem.x)
        dt = 1.0 / 240.0 if method != 'explicit' else 1.99 / max(fastest, 1e-300)
    first = multiple * math.ceil(max(time / dt, 8) / multiple)
    rungs = _Rungs(cache, problem, method, time, first)
    found: list[Reference] = []
    ladder: list[int] = []
    steps = first
    while len(ladder) < levels:
        try:
            if steps not in rungs.solutions:
                rungs.add(steps, _run(problem, method, time / steps, steps))
        except StepTooLongError:
            if steps > first << 10:
                raise
            found, ladder, steps = [], [], 2 * steps
            continue
        ladder.append(steps)
        steps *= 2
        if len(ladder) < 4:
            continue
        found.append(_extrapolated(problem, method, time,
                                   {n: rungs.solutions[n] for n in ladder}))
        last = [reference.uncertainty for reference in found[-3:]]
        if last[-1] <= tolerance or (len(last) == 3 and min(last[1:]) >= last[0]):
            break
    return min(found, key=lambda reference: reference.uncertainty)


def _run(problem: Problem, method: str, dt: float, steps: int) -> tuple[Array, Array]:
    if method == 'explicit':
        return explicit(problem, dt, steps)
    return newton(problem, dt, steps, integrator=method)


def _extrapolated(problem: Problem, method: str, time: float,
                  solutions: dict[int, tuple[Array, Array]]) -> Reference:
    """Return the extrapolation of the solutions, given by number of steps."""
    p, q = POWERS[method]
    counts = sorted(solutions)
    found = []
    for part in range(2):
        rungs = [solutions[n][part] for n in counts]
        tops = [b + (b - a) / (2**p - 1) for a, b in zip(rungs, rungs[1:])]
        before, last = (rms(b - a) for a, b in zip(tops[-3:], tops[-2:]))
        found.append((tops[-1], _uncertainty(before, last, q)))
    (x, u), (v, u_v) = found
    free = ~problem.pinned
    steps = counts[-1]
    floor = 4.0 * EPS * np.abs(x).max() * math.sqrt(steps)
    floor_v = 4.0 * EPS * np.abs(v).max() * math.sqrt(steps) + floor / time
    if method != 'explicit':
        left = tolerance_of(problem, x, v, time / steps) / problem.mass[free].min()
        floor, floor_v = floor + 0.5 * left * time**2, floor_v + left * time
    ladder = tuple((time / n, rms(solutions[n][0] - x)) for n in counts)
    return Reference(x, v, u + floor, u_v + floor_v, time, method, ladder)


def _uncertainty(before: float, last: float, q: int) -> float:
    """Return the uncertainty of an extrapolation from its last two changes."""
    ratio = min(last / before, 0.9) if before > 0.0 else 0.0
    return max(last, before / 2**q) * max(1.0, ratio / (1.0 - ratio))


class _Rungs:
    """Solutions by number of steps, also kept in a file if a folder is given."""

    def __init__(self, folder: str | os.PathLike | None, problem: Problem, method: str,
                 time: float, first: int):
        self.solutions: dict[int, tuple[Array, Array]] = {}
        self._file = None
        if folder is None:
            return
        key = _key(problem, method, time, first)
        self._file = FilePath(folder) / f'reference_{method}_{key}.npz'
        try:
            with np.load(self._file, allow_pickle=False) as stored:
                self.solutions = {int(n): (x, v) for n, x, v in zip(
                    stored['steps'], stored['x'], stored['v'])}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            pass    # absent or corrupt: computed again

    def add(self, steps: int, solution: tuple[Array, Array]) -> None:
        """Add a solution."""
        self.solutions[steps] = solution
        if self._file is None:
            return
        self._file.parent.mkdir(parents=True, exist_ok=True)
        part = self._file.with_suffix(f'.{os.getpid()}.part')
        counts = sorted(self.solutions)
        with part.open('wb') as file:
            np.savez(file, steps=counts, x=[self.solutions[n][0] for n in counts],
                     v=[self.solutions[n][1] for n in counts])
        part.replace(self._file)


def _key(problem: Problem, method: str, time: float, first: int) -> str:
    """Return a hash of all that a solution depends on: problem, steps and this code."""
    digest = hashlib.blake2b(digest_size=16)
    for file in sorted(FilePath(__file__).parent.glob('*.py')):
        digest.update(file.read_bytes())
    digest.update(repr((method, time, first, problem.damping, problem.interval)).encode())
    arrays = [getattr(problem, name) for name in ('x', 'v', 'mass', 'pinned', 'gravity', 'force')]
    for part in problem.elements:
        digest.update(part.name.encode())
        arrays += [part.particles, *part.parameters]
    for array in arrays:
        digest.update(f'{array.shape}'.encode())
        digest.update(np.ascontiguousarray(array).data)
    if problem.motion is not None:
        count = 8 * round(time / problem.interval) if problem.interval else 4096
        for t in np.linspace(0.0, time, count + 1):
            digest.update(np.ascontiguousarray(problem.at(t)).data)
    return digest.hexdigest()
