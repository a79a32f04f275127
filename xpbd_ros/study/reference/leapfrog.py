"""
Leapfrog (velocity Verlet), with exact damping in the kicks.

It is symmetric in time, so its error has even powers of dt only. Unstable steps are refused.
"""

import numpy as np
from scipy.sparse.linalg import eigsh, LinearOperator

from xpbd_ros.study.reference.forces import fast, FORCE_KERNELS, small
from xpbd_ros.study.reference.problem import Array, highest_frequency_bound, loads, Problem
from xpbd_ros.study.reference.run import check, pinned_velocity, start, with_progress
from xpbd_ros.study.reference.stiffness import Stiffness

BLOCKS = 64
"""number of checks in a run that the step is still stable"""


class StepTooLongError(ValueError):
    """Leapfrog is unstable with this step."""


def explicit(problem: Problem, dt: float, steps: int) -> tuple[Array, Array]:
    """
    Take leapfrog steps: half a kick, a drift, half a kick.

    A kick of length τ is exact for constant forces: v <- v e + (f / m) (1 - e) / c, with
    e = exp(-c τ). Positions and velocities are stored with their rounding errors, because a sheet
    that may wrinkle amplifies these by 1e10 in half a second.

    Parameters
    ----------
    problem : the initial value problem
    dt : step [s]
    steps : number of steps

    Returns
    -------
    x : [m], shape (n, 3)
    v : [m/s], shape (n, 3)

    Raises
    ------
    StepTooLongError : if dt exceeds 2 / ω for the highest frequency ω, at the start or later

    """
    check(dt, steps)
    stiffness = Stiffness(problem)
    x, v = problem.x.copy(), start(problem)
    free, pull = ~problem.pinned, np.empty_like(x)
    x_low, v_low = np.zeros_like(x), np.zeros_like(v)
    kernels = [(FORCE_KERNELS[type(part)], part.particles, part.parameters)
               for part in problem.elements]
    load, mass = loads(problem), problem.mass
    lost = -np.expm1(-0.5 * problem.damping * dt)
    gain = lost / problem.damping if problem.damping else 0.5 * dt
    whole = (2.0 - lost) * np.array([lost, gain])

    def kick(lost, gain):
        pull[:] = load
        for add, particles, parameters in kernels:
            add(x, x_low, pull, particles, *parameters)
        _kick(v, v_low, pull, mass, free, lost, gain)

    kick(lost, gain)
    size = -(-steps // BLOCKS)
    for first in with_progress(range(0, steps, size), f'explicit, dt = {dt:.3g} s',
                               -(-steps // size)):
        _check_stable(stiffness, x, dt, first)
        last = min(first + size, steps)
        for n in range(first + 1, last + 1):
            _drift(x, x_low, v, v_low, free, dt)
            if problem.motion:
                x[problem.pinned] = problem.at(n * dt)
            kick(*(whole if n < steps else (lost, gain)))
        if not np.isfinite(x).all():
            raise StepTooLongError(f'dt = {dt:.6g} s: leapfrog was unstable within {last} steps')
    v[problem.pinned] = pinned_velocity(problem, dt, steps)
    return x, v


def highest_frequency(problem: Problem, x: Array | None = None) -> float:
    """
    Return the highest angular frequency of small vibrations about x [rad/s].

    Its square is the largest eigenvalue of M^-1/2 H M^-1/2 in magnitude (Lanczos iteration).
    Leapfrog is stable for dt below 2 / ω.
    """
    return _highest_frequency(Stiffness(problem), problem.x if x is None else x)


def _highest_frequency(stiffness: Stiffness, x: Array) -> float:
    scale = np.repeat(1.0 / np.sqrt(stiffness.problem.mass[stiffness.particles]), 3)
    hessian = stiffness.operator(x)
    if not highest_frequency_bound(stiffness.problem, x):
        return 0.0
    H = LinearOperator(hessian.shape, lambda z: scale * (hessian @ (scale * np.ravel(z))),
                       dtype=float)
    first = np.random.default_rng(0).standard_normal(len(scale))
    largest = eigsh(H, k=1, which='LM', tol=1e-6, v0=first, return_eigenvectors=False)
    return float(np.sqrt(np.abs(largest[0])))


def _check_stable(stiffness: Stiffness, x: Array, dt: float, step: int) -> None:
    """Raise StepTooLongError if dt is not below 2 / ω; a cheap bound of ω suffices mostly."""
    if dt * highest_frequency_bound(stiffness.problem, x) < 2.0:
        return
    longest = 2.0 / _highest_frequency(stiffness, x)
    if dt >= longest:
        raise StepTooLongError(f'dt = {dt:.6g} s: leapfrog needs less than {longest:.6g} s here '
                               f'(after {step} steps)')


@small
def _added(high, low, change):
    """Return high + low + change as a rounded sum and its rounding error (Knuth)."""
    change += low
    total = high + change
    part = total - high
    return total, (high - (total - part)) + (change - part)


@fast
def _drift(x, x_low, v, v_low, free, dt):
    for i in range(len(x)):
        if free[i]:
            for k in range(3):
                x[i, k], x_low[i, k] = _added(x[i, k], x_low[i, k], dt * (v[i, k] + v_low[i, k]))


@fast
def _kick(v, v_low, f, mass, free, lost, gain):
    """v <- v (1 - lost) + gain f / m."""
    for i in range(len(v)):
        if free[i]:
            for k in range(3):
                v[i, k], v_low[i, k] = _added(v[i, k], v_low[i, k],
                                              gain * f[i, k] / mass[i] - lost * v[i, k])
