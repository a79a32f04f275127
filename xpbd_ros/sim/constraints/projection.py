"""
How one constraint changes its multiplier and its particles, by method.

Gauss-Seidel writes positions where it reads them. Methods that move all particles at once read the
positions x as they are and add up moves elsewhere: ``state.apart`` says where, and by its type how
far a constraint goes.

    Gauss-Seidel    Δf = -(C + α f) / (W + α)          Macklin et al. 2016, eq 18
    Jacobi          Δf = -ω (C + α f) / (W + α)        doc/numerics.md 3.4
    explicit        f  = -C / α, from f = 0            the force at x itself

``None`` for a multiplier: it is not kept, and is 0 before the only pass.
"""

from operator import getitem

from numba import types
from numba.extending import intrinsic

from xpbd_ros.sim.backend.jit import inline
from xpbd_ros.sim.backend.simd import fma, load, store
from xpbd_ros.sim.particles.accumulators import Explicit, Jacobi


def _kind(apart):
    return getattr(apart, 'instance_class', None)


@intrinsic
def row(typing, array, k):
    """Return row k of an array; None of None. (A function of ours could not return a view.)"""
    if isinstance(array, types.NoneType):
        return types.none(array, k), lambda context, builder, *_: context.get_dummy_value()
    view = typing.resolve_function_type(getitem, (array, k), {}).return_type

    def generate(context, builder, signature, arguments):
        return context.get_function(getitem, view(*signature.args))(builder, arguments)
    return view(array, k), generate


def recall(apart, force, c):
    """Return the multipliers from index c on; None where they are not kept, or begin at 0."""


def keep(force, c, f, df):
    """Keep multipliers f + Δf."""


def xpbd_residual(residual, alpha, f):
    """Return C + α f."""


def denominator(apart, total, alpha):
    """Return what a misfit is divided by: W + α, and what the method makes of it."""


@intrinsic
def moves(typing, apart):
    """Return where moves are added up; None: where positions are."""
    if isinstance(apart, types.NoneType):
        return types.none(apart), lambda context, builder, *_: context.get_dummy_value()
    move = apart[apart.fields.index('move')]

    def generate(context, builder, signature, arguments):
        return context.get_getattr(apart, 'move')(context, builder, apart, arguments[0], 'move')
    return move(apart), generate


def at_the_end(apart):
    """Tell whether forces are those where the substep ends."""


def put(x, target, i, xi, step, d):
    """Move by step d from xi."""


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


@inline(xpbd_residual)
def _misfit(residual, alpha, f):
    if isinstance(f, types.NoneType):
        return lambda residual, alpha, f: residual
    return lambda residual, alpha, f: fma(alpha, f, residual)


@inline(denominator)
def _divisor(apart, total, alpha):
    if _kind(apart) is Jacobi:
        return lambda apart, total, alpha: (total + alpha) * apart.per_relaxation[0]
    if _kind(apart) is Explicit:
        return lambda apart, total, alpha: alpha
    return lambda apart, total, alpha: total + alpha


@inline(at_the_end)
def _at_the_end(apart):
    if _kind(apart) is Explicit:
        return lambda apart: False
    return lambda apart: True


@inline(put)
def _put(x, target, i, xi, step, d):
    if isinstance(target, types.NoneType):
        return lambda x, target, i, xi, step, d: store(x, i, fma(step, d, xi))
    return lambda x, target, i, xi, step, d: store(target, i, fma(step, d, load(target, i)))


def zero_multipliers(apart, force):
    """
    Zero the multipliers: once per substep, never per iteration (algorithm 1, line 4).

    Those of explicit forces are new in every substep.
    """


@inline(zero_multipliers)
def _release_forces(apart, force):
    if isinstance(force, types.NoneType) or _kind(apart) is Explicit:
        return lambda apart, force: None

    def zero(apart, force):
        force[:] = 0.0
    return zero
