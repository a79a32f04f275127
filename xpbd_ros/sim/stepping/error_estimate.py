"""
How wrong a frame is: the same frame once more with twice the substeps (step doubling).

What is left of the error after doubling is 1 / (2^p - 1) of what doubling took away (Hairer,
Nørsett and Wanner, Solving ordinary differential equations I, II.4), for a method of order p: as
much again for backward Euler, a third for BDF2. Which of the two a frame is nearer to depends on
contacts and on how far the sweeps converge, so LEFT is their geometric mean. It holds while the
substeps follow the cloth's waves; under-resolved, twice the substeps take little away
(doc/numerics.md 4.1), and only a third run tells. So where a cloth is strained by more than
DOUBTFUL there is one, with four times the substeps: if it moves the cloth further than the second
did, the frame is not resolved.
"""

from collections.abc import Callable
import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from xpbd_ros.sim.particles.state import State
from xpbd_ros.sim.stepping.overwrite import overwrite

LEFT = 3.0**-0.5
"""of the error, for 1 that doubling takes away"""
DOUBTFUL = 0.1
"""largest strain up to which twice the substeps tell enough"""


@dataclass(frozen=True)
class Start:
    """What a frame started from, and how it was computed: enough to compute it again."""

    effects: tuple
    state: State
    step: Callable
    method: Any
    frame_dt: float
    """[s]"""
    substeps: int

    def copy(self, onto: 'Start | None' = None) -> 'Start':
        """Return a copy that shares no array; in the memory of ``onto``, if it is one of old."""
        found = onto and (onto.effects, onto.state)
        if not (found and overwrite(found, (self.effects, self.state))):
            found = copy.deepcopy((self.effects, self.state))
        return Start(*found, self.step, self.method, self.frame_dt, self.substeps)

    def end(self, factor: int) -> State:
        """Return the state at the frame's end, computed with ``factor`` times the substeps."""
        again = self.copy()
        refine(again.state, self.frame_dt / self.substeps, factor)
        step = copy.deepcopy(self.step)    # which would keep the copied arrays
        step(again.effects, again.state, self.method, self.frame_dt, factor * self.substeps)
        return again.state


@dataclass(frozen=True)
class Estimate:
    """What is known of the error of one frame."""

    frame: int
    """its index"""
    substeps: int
    rms: float
    """estimated error of the positions, RMS over the particles [m]"""
    largest: float
    """of one particle [m]"""
    resolved: bool
    """True if the estimate holds; else it is only a lower bound"""
    frames: int
    """how many frames' worth of work it took"""


def refine(state: State, h: float, factor: int) -> None:
    """
    Let the history of substeps of h be one of substeps of h / factor.

    It moves up onto the cubic through x and v at both ends of the last substep, which is of higher
    order than BDF2 and NDF2.
    """
    history = state.history
    if history is None or factor == 1:
        return
    last = state.x_prev.copy(), history.v.copy(), state.x, state.v
    state.x_prev[:], history.v[:] = _cubic(*last, h, 1.0 - 1.0 / factor)
    if history.older_v is not None:
        history.x[:], history.older_v[:] = _cubic(*last, h, 1.0 - 2.0 / factor)


def _cubic(x0, v0, x1, v1, h: float, s: float):
    """Return position and velocity at the part s of a substep from its ends."""
    return ((1 + 2 * s) * (1 - s)**2 * x0 + s * (1 - s)**2 * h * v0
            + s**2 * (3 - 2 * s) * x1 - s**2 * (1 - s) * h * v1,
            6 * s * (1 - s) * (x1 - x0) / h
            + (1 - s) * (1 - 3 * s) * v0 + s * (3 * s - 2) * v1)


def estimate(start: Start, end: np.ndarray, *, frame: int, slot: np.ndarray,
             strain: float) -> Estimate:
    """
    Return the error of a frame.

    Parameters
    ----------
    start : what it started from; stays as it is
    end : positions where it ended [m], shape (3, slots)
    frame : its index
    slot : where the particles are, shape (particles,)
    strain : the largest at its end

    """
    def moved(a, b):
        return np.sqrt(((a - b)[:, slot].astype(float)**2).sum(0))

    twice = start.end(2).x
    first = moved(end, twice)
    left, resolved, frames = LEFT * first, True, 2
    if not strain <= DOUBTFUL:
        second = moved(twice, start.end(4).x)
        left, frames = (1.0 + LEFT) * second, 6
        resolved = bool(rms(second) <= rms(first))
    error = first + left
    return Estimate(frame, start.substeps, rms(error), float(error.max()), resolved, frames)


def rms(distances: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt((distances**2).mean()))
