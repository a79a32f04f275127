"""
Damping of constraints (Macklin et al. 2016, eq 26), compiled only where a scene asks for it.

A damper β parallel to each constraint of compliance α gives γ = α β / h; β = τ / α, with one
relaxation time τ, gives γ = τ / h. In force form, for a velocity v = (x - x̄) / H and γ = τ / H,

    Δf = -(C + α f + γ ∇C·(x - x̄)) / ((1 + γ) W + α).

A damping of None makes γ and all other terms None, and compiles to the undamped constraint.
"""

from typing import NamedTuple

from numba import types
import numpy as np

from xpbd_ros.sim.backend.jit import inline
from xpbd_ros.sim.backend.simd import fma, load
from xpbd_ros.sim.backend.simd_records import load_records
from xpbd_ros.sim.backend.simd_vector3 import dot, vector3


class Past(NamedTuple):
    """Positions x̄ of a substep, from which v = (x - x̄) / H."""

    x: np.ndarray
    """x̄ [m], shape (3, slots)"""
    records: np.ndarray
    """x̄ as records, for constraints of meshes, shape (slots, 4)"""
    per_step: np.ndarray
    """1 / H [1/s], shape (1,)"""


class Damping(NamedTuple):
    """Damping of one batch of constraints."""

    past: Past
    time: np.ndarray
    """τ [s], of each shape of constraint on grids, or of each constraint of meshes"""


def gamma_of(damping, shape):
    """Return γ of a shape of constraint on grids."""


def gammas_of(damping, c):
    """Return the vector γ of mesh constraints from index c on."""


def apart_before(damping, i, j):
    """Return vectors x̄_i - x̄_j of the particles from slots i and j on."""


def records_before(damping, particles, c):
    """Return vectors x̄_i - x̄_j of mesh edges from index c on; ``particles``: slots, (2, edges)."""


def lag(xpbd_residual, gamma, before, d, l):
    """Return C + α f + γ n·(d - d̄) for an edge d = l n, where ``before`` is d̄."""


def damped(total, gamma):
    """Return (1 + γ) W for W = ``total``."""


def _none(kind) -> bool:
    return isinstance(kind, types.NoneType)


@inline(gamma_of)
def _gamma_of(damping, shape):
    if _none(damping):
        return lambda damping, shape: None
    return lambda damping, shape: damping.time[shape] * damping.past.per_step[0]


@inline(gammas_of)
def _gammas_of(damping, c):
    if _none(damping):
        return lambda damping, c: None
    return lambda damping, c: load(damping.time, c) * damping.past.per_step[0]


@inline(apart_before)
def _apart_before(damping, i, j):
    if _none(damping):
        return lambda damping, i, j: None

    def apart(damping, i, j):
        x = damping.past.x
        n = x.shape[1]
        return vector3(load(x, i) - load(x, j), load(x, n + i) - load(x, n + j),
                       load(x, 2 * n + i) - load(x, 2 * n + j))
    return apart


@inline(records_before)
def _records_before(damping, particles, c):
    if _none(damping):
        return lambda damping, particles, c: None

    def apart(damping, particles, c):
        xi, yi, zi, _ = load_records(damping.past.records, particles[0], c)
        xj, yj, zj, _ = load_records(damping.past.records, particles[1], c)
        return vector3(xi - xj, yi - yj, zi - zj)
    return apart


@inline(lag)
def _lag(xpbd_residual, gamma, before, d, l):
    if _none(gamma):
        return lambda xpbd_residual, gamma, before, d, l: xpbd_residual
    return lambda xpbd_residual, gamma, before, d, l: fma(
        gamma, l - dot(d, before) / l, xpbd_residual)


@inline(damped)
def _damped(total, gamma):
    if _none(gamma):
        return lambda total, gamma: total
    return lambda total, gamma: fma(gamma, total, total)
