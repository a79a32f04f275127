"""
The initial value problem of the reference solver as plain arrays, its energy and gradient.

    m x'' = -∇E(x) + m g + f - m c x',   E the sum over ``elements``

Pinned particles have positions given as functions of time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xpbd_ros.study.reference.elements import Elements

Array = NDArray[Any]

EPS = float(np.finfo(float).eps)
NOT_GIVEN: Any = None
"""default of arrays that ``Problem`` then fills with zeros"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """
    An initial value problem of particles with elastic elements.

    The arrays are checked, copied and made read-only. All units are SI.
    """

    x: Array
    """positions at the start [m], shape (n, 3)"""
    v: Array = NOT_GIVEN
    """velocities at the start [m/s], shape (n, 3); None for rest; unused for pinned particles"""
    mass: Array
    """masses [kg], shape (n,), > 0"""
    pinned: Array = NOT_GIVEN
    """True if a particle is pinned, shape (n,); None if none is"""
    motion: Callable[[float], ArrayLike] | None = None
    """time since the start [s] -> positions of the pinned particles in the order of their indices
    [m], shape (p, 3); None if they do not move"""
    interval: float | None = None
    """length of the intervals in which motion is smooth [s]; its velocity may jump between them"""
    gravity: ArrayLike = (0.0, 0.0, 0.0)
    """[m/s²], shape (3,)"""
    damping: float = 0.0
    """rate c at which velocities decay [1/s]"""
    force: Array = NOT_GIVEN
    """constant force on each particle [N], shape (n, 3); None for none"""
    elements: tuple[Elements, ...] = ()
    """elastic elements"""

    def __post_init__(self):
        """Check the values, and keep read-only copies."""
        n = len(self.x)
        zeros = np.zeros((n, 3))
        for name, value, shape, kind in (
                ('x', self.x, (n, 3), float),
                ('v', zeros if self.v is None else self.v, (n, 3), float),
                ('mass', self.mass, (n,), float),
                ('pinned', np.zeros(n) if self.pinned is None else self.pinned, (n,), bool),
                ('gravity', self.gravity, (3,), float),
                ('force', zeros if self.force is None else self.force, (n, 3), float)):
            array = np.array(value, kind, order='C')
            if array.shape != shape:
                raise ValueError(f'{name}: must have shape {shape} (got {array.shape})')
            if kind is float and not np.isfinite(array).all():
                raise ValueError(f'{name}: must be finite')
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if (self.mass <= 0.0).any():
            raise ValueError(f'mass: must be > 0 (got {self.mass.min():g})')
        if not 0.0 <= self.damping < np.inf:
            raise ValueError(f'damping: must be >= 0 1/s (got {self.damping:g})')
        if self.interval is not None and not 0.0 < self.interval < np.inf:
            raise ValueError(f'interval: must be > 0 s (got {self.interval:g})')
        for part in self.elements:
            named = part.particles
            if named.size and not (named.min() >= 0 and named.max() < n):
                raise ValueError(f'{part.name}: particles must be from 0 to {n - 1} '
                                 f'(got {named.min()} to {named.max()})')
        if self.pinned.all():
            raise ValueError('pinned: no particle is free')
        if self.motion is not None and self.at(0.0).shape != (self.pinned.sum(), 3):
            raise ValueError(f'motion: must give shape {(int(self.pinned.sum()), 3)} '
                             f'(got {self.at(0.0).shape})')

    def at(self, t: float) -> Array:
        """Return the positions of the pinned particles at time t [m], shape (p, 3)."""
        return self.x[self.pinned] if self.motion is None else np.array(self.motion(t), float)

    def all_of(self, kind: type[Elements]) -> tuple[Array, ...]:
        """Return particles and parameters of all elements of a kind; empty without any."""
        found = [(part.particles, *part.parameters) for part in self.elements
                 if type(part) is kind]
        return tuple(map(np.concatenate, zip(*found)))

    @cached_property
    def _stiffness_at_start(self) -> Array:
        return stiffness_bound(self, self.x)

    def force_rounding(self, x: Array, pull: float = 0.0) -> float:
        """
        Return the error of the gradient by rounding of positions [N].

        ``pull`` [1/s²] times the mass is a further stiffness of each particle.
        """
        k = pull * self.mass + 0.5 * self._stiffness_at_start
        return float(4.0 * EPS * k.max() * np.abs(x).max())


def rms(difference: Array) -> float:
    """Return the root mean square of the lengths of vectors, shape (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(np.square(difference), -1)))) if len(difference) else 0.0


def potential(problem: Problem, x: Array) -> float:
    """Return E(x) - Σ (m g + f)·x [J]."""
    return elastic(problem, x) - float((x * loads(problem)).sum())


def loads(problem: Problem) -> Array:
    """Return m g + f of each particle [N], shape (n, 3)."""
    return problem.mass[:, None] * problem.gravity + problem.force


def elastic(problem: Problem, x: Array) -> float:
    """Return the elastic energy E(x) [J]."""
    return sum((part.energy(x) for part in problem.elements), 0.0)


def kinetic(problem: Problem, v: Array) -> float:
    """Return Σ m v² / 2 over the free particles [J]."""
    free = ~problem.pinned
    return float(0.5 * (problem.mass[free] * np.square(v[free]).sum(1)).sum())


def gradient(problem: Problem, x: Array) -> Array:
    """Return the gradient of ``potential`` [N], shape (n, 3): minus the forces."""
    return slope(problem, x)[0]


def slope(problem: Problem, x: Array) -> tuple[Array, float]:
    """Return the gradient of ``potential`` [N], and the rounding error of the energy [J]."""
    total = -loads(problem)
    size = np.abs(total).sum()
    for part in problem.elements:
        pull = part.slope(x)
        size += np.abs(pull).sum()
        for k in range(3):
            total[:, k] += np.bincount(part.particles.ravel(), pull[:, :, k].ravel(), len(x))
    return total, float(8.0 * EPS * np.abs(x).max() * size)


def stiffness_bound(problem: Problem, x: Array) -> Array:
    """Return b of a bound zᵀ H z ≤ Σ b_i |z_i|² of the Hessian [N/m], shape (n,)."""
    total = np.zeros(len(x))
    for part in problem.elements:
        total += np.bincount(part.particles.ravel(), part.bound(x).ravel(), len(x))
    return total


def highest_frequency_bound(problem: Problem, x: Array) -> float:
    """
    Return an upper bound of the angular frequencies of vibrations about x [rad/s].

    For a flat sheet of edges it is √2 times the highest frequency.
    """
    rate = stiffness_bound(problem, x) / problem.mass
    return float(np.sqrt(rate[~problem.pinned].max(initial=0.0)))
