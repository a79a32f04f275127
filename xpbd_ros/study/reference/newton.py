"""
Backward Euler, BDF2 and equilibria by Newton's method (doc/numerics.md 11).

Each step minimises its energy with a sparse factorisation, without multipliers or sweeps. The
first step of BDF2 is backward Euler, with a local error O(dt²), so the order remains 2.
"""

import numpy as np

from xpbd_ros.study.reference.problem import Array, gradient, loads, potential, Problem, slope
from xpbd_ros.study.reference.run import check, pinned_velocity, start, with_progress
from xpbd_ros.study.reference.stiffness import Stiffness

TOLERANCE = 1e-10
"""largest residual force of Newton's method, over the largest m g"""
ITERATIONS = 2000
"""Newton steps, at most; a time step needs a few, an equilibrium may need hundreds"""


def newton(problem: Problem, dt: float, steps: int, *,
           integrator: str = 'backward_euler') -> tuple[Array, Array]:
    """
    Take implicit steps, each solved to ``TOLERANCE``.

    With H = dt (backward Euler) or 2 dt / 3 (BDF2), and the history terms x̄ and v̄ of the
    formula, a step is v = v̄ + H (f(x) / m - c v), x = x̄ + H v. That x minimises

        E(x) - Σ m g·x + s Σ m |x - x̃|² / 2,   s = (1 + c H) / H²,   x̃ = x̄ + H v̄ / (1 + c H)

    Parameters
    ----------
    problem : the initial value problem
    dt : step [s]
    steps : number of steps
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
    for n in with_progress(range(steps), f'{integrator}, dt = {dt:.3g} s', steps):
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
    Return the positions of a stable equilibrium of forces [m], shape (n, 3).

    Newton's method is regularized by a multiple of the mass matrix, which falls as steps succeed.

    Parameters
    ----------
    problem : the forces and the pins
    x : positions to start from [m], shape (n, 3); None for those of the problem

    Raises
    ------
    RuntimeError : if Newton's method does not converge, or the equilibrium is unstable

    """
    stiffness = Stiffness(problem)
    x = problem.x.copy() if x is None else np.array(x, float)
    x[problem.pinned] = problem.at(0.0)
    x = _minimum(stiffness, x, tolerance=tolerance_of(problem, x, problem.v, np.inf), shift=100.0)
    if not stiffness.stable(x):
        raise RuntimeError('the forces vanish, but the equilibrium is unstable; start from other '
                           'positions')
    return x


def _minimum(stiffness: Stiffness, x: Array, *, tolerance: float, pull: float = 0.0,
             target: Array | float = 0.0, shift: float = 0.0) -> Array:
    """
    Minimise the potential plus pull Σ m |x - target|² / 2 over the free particles.

    ``shift`` [1/s²] times the mass matrix is added to the Hessian (Levenberg-Marquardt); it grows
    while steps fail and falls while they succeed.
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
                raise RuntimeError(f'Newton: no descent, with a residual of {largest:.3g} N')
        x, value = trial, there
        if shift:
            shift = max(0.1 * shift, 1e-6) if length == 1.0 else 10.0 * shift
    raise RuntimeError(f'Newton: not converged after {ITERATIONS} steps, with a residual of '
                       f'{least:.3g} N (tolerance {tolerance:.3g} N)')


def tolerance_of(problem: Problem, x: Array, v: Array, dt: float) -> float:
    """
    Return the largest residual force of a step [N], by TOLERANCE or by rounding errors.

    Without gravity or a constant force it is relative to the forces at the start of the step.
    ``dt`` [s] may be infinite.
    """
    free = ~problem.pinned
    scale = np.linalg.norm(loads(problem)[free], axis=1).max()
    if scale == 0.0:
        scale = max(np.abs(gradient(problem, x)[free]).max(),
                    (problem.mass[free, None] * np.abs(v[free])).max() / dt)
    return max(TOLERANCE * scale, problem.force_rounding(x, 2.25 / dt**2))
