"""Functions that both methods of the reference solver share."""

from collections.abc import Iterable
import sys

import numpy as np

from xpbd_ros.study.reference.problem import Array, Problem


def check(dt: float, steps: int) -> None:
    """Check step and number of steps."""
    if not 0.0 < dt < np.inf:
        raise ValueError(f'dt: must be > 0 s (got {dt:g})')
    if steps < 0:
        raise ValueError(f'steps: must be >= 0 (got {steps})')


def start(problem: Problem) -> Array:
    """Return the initial velocities [m/s]; those of pinned particles are 0."""
    return np.where(problem.pinned[:, None], 0.0, problem.v)


def pinned_velocity(problem: Problem, dt: float, steps: int) -> Array:
    """Return the velocities of the pinned particles at the end [m/s], by backward differences."""
    if problem.motion is None or steps == 0:
        return np.zeros((int(problem.pinned.sum()), 3))
    at = [problem.at((steps - k) * dt) for k in range(min(steps, 2) + 1)]
    if len(at) == 2:
        return (at[0] - at[1]) / dt
    return (1.5 * at[0] - 2.0 * at[1] + 0.5 * at[2]) / dt


def with_progress(items: Iterable, what: str, total: int) -> Iterable:
    """Return an iterable of the items, with a progress bar on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        return items
    from tqdm import tqdm
    return tqdm(items, desc=what, total=total, leave=False)
