"""
Backward Euler and BDF2, and what is at rest, by Newton's method (doc/numerics.md 11).

Each step minimises its energy, with an exact sparse factorisation. No multipliers, no sweeps. The
first step of BDF2 is backward Euler: local error O(dt²), so the whole stays of second order.
"""

import numpy as np

from xpbd_ros.study.reference.problem import Array, gradient, loads, potential, Problem, slope
from xpbd_ros.study.reference.run import check, pinned_velocity, start, watched
from xpbd_ros.study.reference.stiffness import Stiffness

TOLERANCE = 1e-10
"""largest force left by Newton's method, relative to the largest m g"""
ITERATIONS = 2000
"""Newton steps before giving up; in time a few do, an equilibrium may be hundreds away"""


def newton(problem: Problem, dt: float, steps: int, *,
           integrator: str = 'backward_euler') -> tuple[Array, Array]:
    """
    Take implicit steps, each solved to ``TOLERANCE``.

    With H = dt (backward Euler) or 2 dt / 3 (BDF2), and what the formula makes of the past,
    x̄ and v̄, a step is v = v̄ + H (f(x) / m - c v), x = x̄ + H v. That x minimises

        E(x) - Σ m g·x + s Σ m |x - x̃|² / 2,   s = (1 + c H) / H²,   x̃ = x̄ + H v̄ / (1 + c H)

    Parameters
    ----------
    dt : [s]
    steps : how many
    integrator : 'backward_euler' or 'bdf2'

    Returns
    -------
    x : [m], shape (n, 3)
    v : [m/s], shape (n, 3)

    """
    if integrator not in ('backward_euler', 'bdf2'):
        raise ValueError(f"integrator: must be 'backward_euler' or 'bdf2' (got {integrator!r})")
    check(dt, steps)
    stiffness = Stiffness(problem)
    free = stiffness.free
    x, v = problem.x.copy(), start(problem)
    x_old, v_old = x, v
    for n in watched(range(steps), f'{integrator}, dt = {dt:.3g} s', steps):
        if integrator == 'backward_euler' or n == 0:
            H, x_past, v_past = dt, x, v
        else:
            H, x_past, v_past = 2.0 * dt / 3.0, (4.0 * x - x_old) / 3.0, (4.0 * v - v_old) / 3.0
        damped = 1.0 + problem.damping * H
        target = x_past + (H / damped) * v_past
        guess = x + dt * v
        guess[problem.pinned] = problem.at((n + 1) * dt)
        x_old, v_old = x, v
        x = _minimum(stiffness, guess, pull=damped / H**2, target=target,
                     tolerance=tolerance_of(problem, x, v, dt))
        v = np.zeros_like(x)
        v[free] = (x[free] - x_past[free]) / H
    v[problem.pinned] = pinned_velocity(problem, dt, steps)
    return x, v


def equilibrium(problem: Problem, *, x: Array | None = None) -> Array:
    """
    Return positions where all forces vanish, and that a small push does not leave [m], (n, 3).

    Newton's method with a pull to where it is that fades as the steps succeed.

    Parameters
    ----------
    x : where to start from [m], shape (n, 3); None: the problem's own start

    """
    stiffness = Stiffness(problem)
    x = problem.x.copy() if x is None else np.array(x, float)
    x[problem.pinned] = problem.at(0.0)
    x = _minimum(stiffness, x, tolerance=tolerance_of(problem, x, problem.v, np.inf), shift=100.0)
    if not stiffness.stable(x):
        raise RuntimeError('the forces vanish, but the least push would end this equilibrium; '
                           'start elsewhere')
    return x


def _minimum(stiffness: Stiffness, x: Array, *, tolerance: float, pull: float = 0.0,
             target: Array | float = 0.0, shift: float = 0.0) -> Array:
    """
    Minimise the potential plus pull Σ m |x - target|² / 2 over the free particles.

    ``shift`` [1/s²] times the masses is added to the Hessian while steps fail (Levenberg and
    Marquardt), and fades while they succeed.
    """
    problem = stiffness.problem
    m = problem.mass[:, None]
    free = ~problem.pinned

    def energy(x: Array) -> float:
        return potential(problem, x) + 0.5 * pull * float((m * np.square(x - target))[free].sum())

    value = energy(x)
    least = None
    for _ in range(ITERATIONS):
        down, noise = slope(problem, x)
        down += pull * m * (x - target)
        down[problem.pinned] = 0.0
        largest = np.abs(down).max()
        if largest <= tolerance:
            return x
        least = largest if least is None else min(least, largest)
        step = -stiffness.solve(stiffness.factor(x, pull + shift), down)
        descent = float((down * step).sum())
        noise += 1e-15 * abs(value)
        length = 1.0
        while True:
            trial = x + length * step
            there = energy(trial)
            if there <= value + 1e-4 * length * descent + noise:    # Armijo
                break
            length *= 0.5
            if length < 1e-12:
                raise RuntimeError(f'Newton: no way down, with {largest:.3g} N left')
        x, value = trial, there
        if shift:
            shift = max(0.1 * shift, 1e-6) if length == 1.0 else 10.0 * shift
    raise RuntimeError(f'Newton: {least:.3g} N left after {ITERATIONS} steps '
                       f'(wanted {tolerance:.3g} N)')


def tolerance_of(problem: Problem, x: Array, v: Array, dt: float) -> float:
    """
    Return the force that a step may leave [N]: what TOLERANCE says, or what rounding leaves.

    Without gravity or a force the forces at the start of the step are the measure. ``dt`` may be
    infinite.
    """
    free = ~problem.pinned
    scale = np.linalg.norm(loads(problem)[free], axis=1).max()
    if scale == 0.0:
        scale = max(np.abs(gradient(problem, x)[free]).max(),
                    (problem.mass[free, None] * np.abs(v[free])).max() / dt)
    return max(TOLERANCE * scale, problem.force_rounding(x, 2.25 / dt**2))
