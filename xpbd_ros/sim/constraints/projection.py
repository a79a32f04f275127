"""
Projection of a constraint: updates of its multiplier and positions, by solver method.

Gauss-Seidel updates positions in place. Jacobi and explicit methods read x and add displacements
to the accumulator ``state.apart``, whose type selects the update:

    Gauss-Seidel    Δf = -(C + α f) / (W + α)          Macklin et al. 2016, eq 18
    Jacobi          Δf = -(C + α f) / (W / ω + α)      doc/numerics.md 3.5
    explicit        f  = -C / α                        the elastic force at x

A multiplier of None is not stored; it is 0 before the only pass.
"""

from numba import types
import numpy as np

from xpbd_ros.sim.backend.jit import inline
from xpbd_ros.sim.backend.simd import fma, lanes, load, store
from xpbd_ros.sim.backend.simd_vector3 import fma3, Vector3, vector3
from xpbd_ros.sim.backend.threads import is_on_device, turns_on_device
from xpbd_ros.sim.particles.accumulators import Explicit, Jacobi
from xpbd_ros.sim.particles.rounding import store_moved


def max_compliance(dtype) -> float:
    """Return the largest compliance [m/N]: finite, so that its product with a zero f is 0."""
    return float(np.sqrt(np.finfo(dtype).max))


def _kind(apart):
    return getattr(apart, 'instance_class', None)


def recall(apart, force, c):
    """Return a vector of multipliers from index c on; None if they are 0 before the pass."""


def keep(force, c, f, df):
    """Store multipliers f + Δf from index c on, if multipliers are kept."""


def recall3(apart, force, c):
    """Return a Vector3 of the multipliers in three rows; None if they are 0 before the pass."""


def keep3(force, c, f, df):
    """Store multipliers f + Δf in three rows, given as Vector3, if multipliers are kept."""


def xpbd_residual(residual, alpha, f):
    """Return C + α f."""


def denominator(apart, total, alpha):
    """Return the method's denominator of C + α f: W + α, W / ω + α (Jacobi), α (explicit)."""


def at_the_end(apart):
    """Return True if forces are implicit, at the substep's end; False for the explicit method."""


def put(x, target, errors, i, xi, step, d):
    """
    Store x = xi + step d from index i on, or add step d to ``target`` if it is not None.

    ``errors`` are those of x, as in ``rounding.store_moved``.
    """


@inline(recall)
def _recall(apart, force, c):
    if isinstance(force, types.NoneType) or _kind(apart) is Explicit:
        return lambda apart, force, c: None
    return lambda apart, force, c: load(force, c)


@inline(keep)
def _keep(force, c, f, df):
    if isinstance(force, types.NoneType):
        return lambda force, c, f, df: None
    if isinstance(f, types.NoneType):
        return lambda force, c, f, df: store(force, c, df)
    return lambda force, c, f, df: store(force, c, f + df)


@inline(recall3)
def _recall3(apart, force, c):
    if isinstance(force, types.NoneType) or _kind(apart) is Explicit:
        return lambda apart, force, c: None
    return lambda apart, force, c: vector3(
        load(force[0], c), load(force[1], c), load(force[2], c))


@inline(keep3)
def _keep3(force, c, f, df):
    if isinstance(force, types.NoneType):
        return lambda force, c, f, df: None

    if not isinstance(f, types.NoneType):
        return lambda force, c, f, df: keep3(force, c, None, f + df)

    def overwrite(force, c, f, df):
        store(force[0], c, df.x)
        store(force[1], c, df.y)
        store(force[2], c, df.z)
    return overwrite


@inline(xpbd_residual)
def _xpbd_residual(residual, alpha, f):
    if isinstance(f, types.NoneType):
        return lambda residual, alpha, f: residual
    if isinstance(f, Vector3):
        return lambda residual, alpha, f: fma3(alpha, f, residual)
    return lambda residual, alpha, f: fma(alpha, f, residual)


@inline(denominator)
def _denominator(apart, total, alpha):
    if _kind(apart) is Jacobi:
        return lambda apart, total, alpha: total * apart.per_relaxation[0] + alpha
    if _kind(apart) is Explicit:
        return lambda apart, total, alpha: alpha
    return lambda apart, total, alpha: total + alpha


@inline(at_the_end)
def _at_the_end(apart):
    if _kind(apart) is Explicit:
        return lambda apart: False
    return lambda apart: True


@inline(put)
def _put(x, target, errors, i, xi, step, d):
    if isinstance(target, types.NoneType):
        return lambda x, target, errors, i, xi, step, d: store_moved(x, errors, i, xi, step, d)
    return lambda x, target, errors, i, xi, step, d: store(
        target, i, fma(step, d, load(target, i)))


def zero_multipliers(apart, force, team):
    """
    Zero the multipliers: once per substep, not per iteration (algorithm 1, line 4).

    The threads of a GPU share that. The explicit method needs no zeros: it overwrites them.
    """


def zero_multipliers_at(apart, force, c):
    """Zero the vector of multipliers at index c, or that of each row."""


@inline(zero_multipliers_at)
def _zero_multipliers_at(apart, force, c):
    if isinstance(force, types.NoneType) or _kind(apart) is Explicit:
        return lambda apart, force, c: None

    def zero(apart, force, c):
        for i in range(c, force.size, force.shape[-1]):
            store(force, i, 0.0)
    return zero


@inline(zero_multipliers)
def _zero_multipliers(apart, force, team):
    if isinstance(force, types.NoneType) or _kind(apart) is Explicit:
        return lambda apart, force, team: None

    def zero(apart, force, team):
        force[:] = 0.0

    def zero_shared(apart, force, team):
        first, last, step = turns_on_device(team, force.size // lanes(force))
        for k in range(first, last, step):
            store(force, k * lanes(force), 0.0)
    return zero_shared if is_on_device(team) else zero
