"""
An independent reference: where the particles really are at a time, and how well that is known.

Two methods that share no code with the simulation, nor the right-hand side with each other:

``newton``    backward Euler or BDF2; each step minimises its energy by Newton's method with an
              exact sparse factorisation (NUMERICS 3.6). No multipliers, no sweeps. The first step
              of BDF2 is backward Euler: local error O(dt²), so the whole stays of second order.
``explicit``  leapfrog (velocity Verlet), damping exact in the kicks. Symmetric in time, so its
              error has even powers of dt only. Refuses a step that is too long to be stable.

``limit`` takes either to dt → 0: a ladder of steps, each half the one before, one Richardson
extrapolation on top, and an uncertainty from how the last extrapolations differ.

Limits: no contact, no friction, no rigid edges (a compliance of 0); only ``equilibrium`` and
``newton`` can take edges so stiff that leapfrog would need more steps than anyone waits for.
"""

from collections.abc import Callable, Iterable
import copy
from dataclasses import dataclass
import hashlib
import math
import os
from pathlib import Path as FilePath
import sys
from typing import Any
import zipfile

from numba import njit
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import eigsh

from xpbd_ros.errors import InputError
from xpbd_ros.study.reference_problem import (
    Array,
    elastic,
    energy_rounding,
    EPS,
    force_rounding,
    gradient,
    highest_frequency_bound,
    kinetic,
    potential,
    Problem,
    rms,
    Stiffness,
)

__all__ = ['elastic', 'equilibrium', 'explicit', 'gradient', 'highest_frequency', 'kinetic',
           'limit', 'newton', 'potential', 'Problem', 'problem_of', 'Reference', 'rms',
           'StepTooLongError']

TOLERANCE = 1e-10
"""largest force left by Newton's method, relative to the largest m g"""
ITERATIONS = 2000
"""Newton steps before giving up; in time a few do, an equilibrium may be hundreds away"""
BLOCKS = 64
"""times in a run that leapfrog looks whether its step is still stable"""
POWERS = {'explicit': (2, 4), 'bdf2': (2, 3), 'backward_euler': (1, 2)}
"""the first two powers of dt in the error at a fixed time"""


class StepTooLongError(ValueError):
    """Leapfrog at this step would blow up."""


# What a simulation is, as plain arrays

KNOWN = ('stretch', 'shear', 'bend', 'pin', 'damping')


def problem_of(simulation: Any) -> Problem:
    """
    Return what a compiled simulation should compute from here on.

    The masses, constraints and pins are those of the simulation, numbers only. Pins go on as they
    would without further commands: straight from frame to frame.

    Raises
    ------
    InputError : naming an effect that the reference does not know

    """
    for name in simulation.effects:
        if name not in KNOWN:
            raise InputError(f'effects.{name}: the reference solver does not know it (it knows: '
                             f'{", ".join(KNOWN)})')
    edges, rest_length, compliance = (
        np.concatenate(parts) for parts in zip(
            (np.zeros((0, 2), np.int64), [], []),
            *(_constraints(simulation, name) for name in ('stretch', 'shear')
              if name in simulation.effects)))
    bends, weight, bend_compliance = (
        _constraints(simulation, 'bend') if 'bend' in simulation.effects
        else (np.zeros((0, 4), np.int64), np.zeros((0, 4)), np.zeros(0)))
    if (compliance == 0.0).any():
        raise InputError('effects.stretch.compliance: the reference solver cannot take rigid '
                         'edges; must be > 0 m/N (got 0)')
    pin = simulation.effects.get('pin')
    for name, held in (pin.held if pin else {}).items():
        if held.compliance or held.slip is not None:
            raise InputError(f'pins.{name}: the reference solver holds rigidly and does not let '
                             'go; leave out compliance and slip')
    frame = simulation.frame()
    pinned = frame.inv_mass == 0.0
    motion = _path(simulation, frame.x, pinned) if pinned.any() else None
    return Problem(
        x=frame.x, v=frame.v, mass=simulation.state.mass[simulation.slot], pinned=pinned,
        gravity=simulation.state.gravity, motion=motion,
        interval=simulation.frame_dt if motion else None,
        damping=(float(simulation.effects['damping'].data.rate[0])
                 if 'damping' in simulation.effects else 0.0),
        edges=edges, rest_length=rest_length, stiffness=1.0 / compliance,
        bends=bends, weight=weight, bend_stiffness=1.0 / bend_compliance)


def _constraints(simulation: Any, name: str) -> tuple[Array, Array, Array]:
    """
    Read an effect's constraints; the only place that knows how the simulation stores them.

    Returns
    -------
    particles : natural order, shape (constraints, 2), or (constraints, 4) for ``bend``
    rest_length : [m], shape (constraints,); for ``bend`` the weights [1/m], (constraints, 4)
    compliance : [m/N], or [1/(N m)] for ``bend``; shape (constraints,)

    """
    found = simulation.effects[name].constraints
    return (_numbers(simulation)[found.particles],
            found.weight if name == 'bend' else found.rest_length, found.compliance)


def _numbers(simulation: Any) -> Array:
    """Return the natural number of the particle in each slot, -1 in the padding."""
    numbers = np.full(len(simulation.state.mass), -1)
    numbers[simulation.slot] = np.arange(len(simulation.slot))
    return numbers


def _path(simulation: Any, x: Array, pinned: Array) -> Callable[[float], Array] | None:
    """Return where the pinned particles will be, or None if they stay."""
    rank = np.cumsum(pinned) - 1
    moving = []
    for name, held in simulation.effects['pin'].held.items():
        motion = held.motion
        if motion.keyframes is None and motion.target == motion.pose:
            continue
        if motion.target.orientation != motion.pose.orientation:
            raise InputError(f'pins.{name}: the reference solver cannot turn a pin')
        moving.append((rank[_numbers(simulation)[held.particles]], copy.deepcopy(motion)))
    return _Path(simulation, x[pinned], moving) if moving else None


class _Path:
    """Pinned particles that move with their pins, straight from frame to frame."""

    def __init__(self, simulation: Any, x: Array, moving: list):
        self._knots = [x]
        self._moving = moving
        self._index = simulation.index
        self._dt = simulation.frame_dt
        self._time_ns = simulation.time_ns

    def __call__(self, t: float) -> Array:
        """Return positions [m], shape (p, 3), at a time since the start [s]."""
        frame = max(0, math.ceil(t / self._dt - 1e-9) - 1)
        while len(self._knots) < frame + 2:
            self._advance()
        a, b = self._knots[frame], self._knots[frame + 1]
        return a + (t / self._dt - frame) * (b - a)

    def _advance(self) -> None:
        knot = self._knots[-1].copy()
        for rows, motion in self._moving:
            motion.advance(self._time_ns(self._index + len(self._knots)), self._dt)
            knot[rows] += np.subtract(motion.pose.position, motion.start.position)
        self._knots.append(knot)


# Implicit: Newton's method on the energy of a step

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
    _check(dt, steps)
    stiffness = Stiffness(problem)
    free = stiffness.free
    x, v = problem.x.copy(), _start(problem)
    x_old, v_old = x, v
    for n in _watched(range(steps), f'{integrator}, dt = {dt:.3g} s', steps):
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
                     tolerance=_tolerance(problem, x, v, dt))
        v = np.zeros_like(x)
        v[free] = (x[free] - x_past[free]) / H
    v[problem.pinned] = _pinned_velocity(problem, dt, steps)
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
    x = _minimum(stiffness, x, tolerance=_tolerance(problem, x, problem.v, np.inf), shift=100.0)
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
        slope = gradient(problem, x) + pull * m * (x - target)
        slope[problem.pinned] = 0.0
        largest = np.abs(slope).max()
        if largest <= tolerance:
            return x
        least = largest if least is None else min(least, largest)
        step = -stiffness.solve(stiffness.factor(x, pull + shift), slope)
        descent = float((slope * step).sum())
        noise = energy_rounding(problem, x) + 1e-15 * abs(value)
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


def _tolerance(problem: Problem, x: Array, v: Array, dt: float) -> float:
    """
    Return the force that a step may leave [N]: what TOLERANCE says, or what rounding leaves.

    Without gravity the forces at the start of the step are the measure. ``dt`` may be infinite.
    """
    free = ~problem.pinned
    scale = (problem.mass[free] * np.linalg.norm(problem.gravity)).max()
    if scale == 0.0:
        scale = max(np.abs(gradient(problem, x)[free]).max(),
                    (problem.mass[free, None] * np.abs(v[free])).max() / dt)
    return max(TOLERANCE * scale, force_rounding(problem, x, 2.25 / dt**2))


# Explicit: leapfrog

def explicit(problem: Problem, dt: float, steps: int) -> tuple[Array, Array]:
    """
    Take leapfrog steps: half a kick, a drift, half a kick.

    A kick of τ is exact for the forces where it happens: v <- v e + (f / m) (1 - e) / c, with
    e = exp(-c τ). Positions and velocities carry what rounding took from them along: a sheet that
    may wrinkle makes 1e10 times more of it in half a second.

    Returns
    -------
    x : [m], shape (n, 3)
    v : [m/s], shape (n, 3)

    Raises
    ------
    StepTooLongError : dt is above 2 / ω for the highest frequency ω, at the start or later on

    """
    _check(dt, steps)
    stiffness = Stiffness(problem)
    x, v = problem.x.copy(), _start(problem)
    inv_mass = np.where(problem.pinned, 0.0, 1.0 / problem.mass)
    moved = np.flatnonzero(problem.pinned) if problem.motion else np.zeros(0, np.int64)
    a, x_low, v_low = np.empty_like(x), np.zeros_like(x), np.zeros_like(v)
    size = -(-steps // BLOCKS)
    for first in _watched(range(0, steps, size), f'explicit, dt = {dt:.3g} s', -(-steps // size)):
        _check_stable(stiffness, x, dt, first)
        count = min(size, steps - first)
        path = np.empty((count, len(moved), 3))
        if len(moved):
            for n in range(count):
                path[n] = problem.at((first + n + 1) * dt)
        _leapfrog(x, x_low, v, v_low, a, inv_mass, problem.gravity, problem.damping,
                  problem.edges, problem.rest_length, problem.stiffness, problem.bends,
                  problem.weight, problem.bend_stiffness, moved, path, dt, count)
        if not np.isfinite(x).all():
            raise StepTooLongError(f'dt = {dt:.6g} s: leapfrog blew up within '
                                   f'{first + count} steps')
    v[problem.pinned] = _pinned_velocity(problem, dt, steps)
    return x, v


def highest_frequency(problem: Problem, x: Array | None = None) -> float:
    """
    Return the highest angular frequency of small vibrations about x [rad/s].

    The largest eigenvalue of M^-1/2 H M^-1/2, in magnitude, by Lanczos iteration. Leapfrog is
    stable for dt below 2 / ω.
    """
    return _highest_frequency(Stiffness(problem), problem.x if x is None else x)


def _highest_frequency(stiffness: Stiffness, x: Array) -> float:
    scale = np.repeat(1.0 / np.sqrt(stiffness.problem.mass[stiffness.particles]), 3)
    H = stiffness.matrix(x)
    if not H.nnz or not np.abs(H.data).max():
        return 0.0
    H = sparse.diags(scale) @ H @ sparse.diags(scale)
    start = np.random.default_rng(0).standard_normal(len(scale))
    largest = eigsh(H, k=1, which='LM', tol=1e-6, v0=start, return_eigenvectors=False)
    return float(np.sqrt(np.abs(largest[0])))


def _check_stable(stiffness: Stiffness, x: Array, dt: float, step: int) -> None:
    """Raise StepTooLongError if dt is not below 2 / ω; a bound says so quickly for most steps."""
    if dt * highest_frequency_bound(stiffness.problem, x) < 2.0:
        return
    longest = 2.0 / _highest_frequency(stiffness, x)
    if dt >= longest:
        raise StepTooLongError(f'dt = {dt:.6g} s: leapfrog needs less than {longest:.6g} s here '
                          f'(after {step} steps)')


@njit(nogil=True, error_model='numpy', inline='always')
def _added(high, low, change):
    """Return high + low + change as a rounded sum and what rounding took from it (Knuth)."""
    change += low
    total = high + change
    part = total - high
    return total, (high - (total - part)) + (change - part)


@njit(nogil=True, error_model='numpy')
def _accelerations(x, x_low, inv_mass, gravity, edges, rest_length, stiffness, bends, weight,
                   bend_stiffness, a):
    """a = g - ∇E / m for free particles, 0 for pinned ones."""
    for i in range(len(x)):
        for k in range(3):
            a[i, k] = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        dx = x[j, 0] - x[i, 0] + (x_low[j, 0] - x_low[i, 0])
        dy = x[j, 1] - x[i, 1] + (x_low[j, 1] - x_low[i, 1])
        dz = x[j, 2] - x[i, 2] + (x_low[j, 2] - x_low[i, 2])
        l = np.sqrt(dx * dx + dy * dy + dz * dz)
        if l == 0.0:
            continue
        tension = stiffness[e] * (l - rest_length[e]) / l
        a[i, 0] += tension * dx
        a[i, 1] += tension * dy
        a[i, 2] += tension * dz
        a[j, 0] -= tension * dx
        a[j, 1] -= tension * dy
        a[j, 2] -= tension * dz
    for h in range(len(bends)):
        for k in range(3):
            moment = 0.0
            for p in range(4):
                moment += weight[h, p] * (x[bends[h, p], k] - x[bends[h, 0], k]
                                          + (x_low[bends[h, p], k] - x_low[bends[h, 0], k]))
            for p in range(4):
                a[bends[h, p], k] -= bend_stiffness[h] * weight[h, p] * moment
    for i in range(len(x)):
        for k in range(3):
            a[i, k] = inv_mass[i] * a[i, k] + gravity[k] if inv_mass[i] > 0.0 else 0.0


@njit(nogil=True, error_model='numpy')
def _leapfrog(x, x_low, v, v_low, a, inv_mass, gravity, damping, edges, rest_length, stiffness,
              bends, weight, bend_stiffness, moved, path, dt, steps):
    """Advance x and v in place; path (steps, p, 3) says where the moved particles go."""
    half_lost = -np.expm1(-0.5 * damping * dt)
    half_gain = half_lost / damping if damping > 0.0 else 0.5 * dt
    full_lost = half_lost * (2.0 - half_lost)
    full_gain = half_gain * (2.0 - half_lost)
    for n in range(-1, steps):
        if n >= 0:
            for i in range(len(x)):
                if inv_mass[i] > 0.0:
                    for k in range(3):
                        x[i, k], x_low[i, k] = _added(x[i, k], x_low[i, k],
                                                      dt * (v[i, k] + v_low[i, k]))
            for p in range(len(moved)):
                for k in range(3):
                    x[moved[p], k] = path[n, p, k]
        _accelerations(x, x_low, inv_mass, gravity, edges, rest_length, stiffness, bends, weight,
                       bend_stiffness, a)
        inside = 0 <= n < steps - 1
        lost, gain = (full_lost, full_gain) if inside else (half_lost, half_gain)
        for i in range(len(x)):
            for k in range(3):
                v[i, k], v_low[i, k] = _added(v[i, k], v_low[i, k],
                                              gain * a[i, k] - lost * v[i, k])


# To dt -> 0

@dataclass(frozen=True, eq=False)
class Reference:
    """Where the particles are at a time, and how well that is known."""

    x: Array
    """positions [m], shape (n, 3)"""
    v: Array
    """velocities [m/s], shape (n, 3)"""
    uncertainty: float
    """of x: root mean square over the particles [m]"""
    uncertainty_v: float
    """of v, likewise [m/s]"""
    time: float
    """since the problem's start [s]"""
    method: str
    """'explicit', 'bdf2' or 'backward_euler'"""
    ladder: tuple[tuple[float, float], ...]
    """each step dt [s], and how far its positions are from x (root mean square) [m]"""

    def error(self, x: Array) -> float:
        """Return how far positions (n, 3) are from these: root mean square [m]."""
        return rms(x - self.x)


def limit(problem: Problem, time: float, tolerance: float, *, method: str = 'explicit',
          dt: float | None = None, levels: int = 10,
          cache: str | os.PathLike | None = None) -> Reference:
    """
    Return the solution at a time, for dt → 0.

    With rungs X(dt), X(dt/2), … of a method of order p, the extrapolation is
    T_k = X_k + (X_k - X_{k-1}) / (2^p - 1), whose error goes with the next power q. With
    d_k = rms(T_k - T_{k-1}), the uncertainty is max(d_k, d_{k-1} / 2^q): where the powers hold,
    the error is 2^q - 1 times less. Where d shrinks by less than half from rung to rung, what the
    further rungs would add is counted in. What rounding and the tolerance of Newton's method may
    have done is added. At least four rungs are taken.

    The ladder ends when the uncertainty is within ``tolerance``, after ``levels`` rungs, or when
    two rungs in a row have not lowered it (rounding, or a sheet that wrinkles chaotically); what
    has the least uncertainty is returned. That may be above the tolerance: look at it.

    Parameters
    ----------
    time : since the start [s]; a multiple of the problem's ``interval`` if it has one
    tolerance : [m]
    method : 'explicit', 'bdf2' or 'backward_euler'
    dt : about the first and longest step [s]; None: a quarter of a frame for implicit methods,
        what is stable whatever the shape for leapfrog
    levels : rungs at most
    cache : folder where rungs are kept, so that asking again, or for less tolerance, is quick

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
            raise ValueError(f'time: must be a multiple of {problem.interval:g} s, where the '
                             f'motion kinks (got {time:g})')
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
    """Extrapolate from the rungs, by their number of steps."""
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
        left = _tolerance(problem, x, v, time / steps) / problem.mass[free].min()
        floor, floor_v = floor + 0.5 * left * time**2, floor_v + left * time
    ladder = tuple((time / n, rms(solutions[n][0] - x)) for n in counts)
    return Reference(x, v, u + floor, u_v + floor_v, time, method, ladder)


def _uncertainty(before: float, last: float, q: int) -> float:
    """Return what two successive changes of the extrapolation say about the last."""
    ratio = min(last / before, 0.9) if before > 0.0 else 0.0
    return max(last, before / 2**q) * max(1.0, ratio / (1.0 - ratio))


class _Rungs:
    """Solutions by number of steps, kept in a file if there is a folder for it."""

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
            pass    # absent, or a file that somebody broke: computed again

    def add(self, steps: int, solution: tuple[Array, Array]) -> None:
        """Keep a rung."""
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
    """Hash all that a solution depends on: the problem, the ladder, and this code."""
    digest = hashlib.blake2b(digest_size=16)
    for name in ('reference.py', 'reference_problem.py'):
        digest.update(FilePath(__file__).with_name(name).read_bytes())
    digest.update(repr((method, time, first, problem.damping, problem.interval)).encode())
    for name in ('x', 'v', 'mass', 'pinned', 'gravity', 'edges', 'rest_length', 'stiffness',
                 'bends', 'weight', 'bend_stiffness'):
        array = getattr(problem, name)
        digest.update(f'{name}{array.shape}'.encode())
        digest.update(array)
    if problem.motion is not None:
        count = 8 * round(time / problem.interval) if problem.interval else 4096
        for t in np.linspace(0.0, time, count + 1):
            digest.update(np.ascontiguousarray(problem.at(t)))
    return digest.hexdigest()


def _check(dt: float, steps: int) -> None:
    if not 0.0 < dt < np.inf:
        raise ValueError(f'dt: must be > 0 s (got {dt:g})')
    if steps < 0:
        raise ValueError(f'steps: must be >= 0 (got {steps})')


def _start(problem: Problem) -> Array:
    """Return the velocities to start with [m/s]; those of pinned particles are 0."""
    return np.where(problem.pinned[:, None], 0.0, problem.v)


def _pinned_velocity(problem: Problem, dt: float, steps: int) -> Array:
    """Return the velocities of the pinned particles at the end [m/s]: a backward difference."""
    if problem.motion is None or steps == 0:
        return np.zeros((int(problem.pinned.sum()), 3))
    at = [problem.at((steps - k) * dt) for k in range(min(steps, 2) + 1)]
    if len(at) == 2:
        return (at[0] - at[1]) / dt
    return (1.5 * at[0] - 2.0 * at[1] + 0.5 * at[2]) / dt


def _watched(items: Iterable, what: str, total: int) -> Iterable:
    """Pass items on, with a bar on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        return items
    from tqdm import tqdm
    return tqdm(items, desc=what, total=total, leave=False)
