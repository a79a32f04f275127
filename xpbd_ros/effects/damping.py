"""
Damping: viscous drag on every particle, in proportion to its mass and velocity.

The force -rate m v is evaluated at the substep's end, in closed form: from v = v̄ + H (g - rate v),

    v <- (v̄ + H g) / (1 + H rate),   mobility <- mobility / (1 + H rate),

so it has the integrator's order and is stable at any rate. A falling cloth reaches the terminal
speed g / rate. Pins feel that of the particles that they hold. With ``explicit`` a substep takes
the share θ of the damping at its end and the rest at its start,

    v <- ((1 - (1 - θ) h rate) v + h g) / (1 + θ h rate),   mobility <- mobility / (1 + θ h rate),

of second order with θ = 1/2 up to h rate = 1; from h rate = 2 on θ = 1. A frame's first substep
leaves out the part at its start, and the half kick that ends the frame applies it.

Limits: it also damps the motion of the cloth as a whole.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lanes, load, select, store
from xpbd_ros.sim.backend.threads import turns_on_device
from xpbd_ros.sim.constraints.projection import at_the_end
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.explicit_updates import half_of
from xpbd_ros.sim.particles.history import step_of
from xpbd_ros.sim.stepping.stages import damp_half_kick, force, stage


@dataclass(frozen=True)
class Parameters:
    """The rate."""

    rate: float = quantity(unit='1/s', minimum=0.0, live=True, doc='decay rate of velocities')


class Damping(NamedTuple):
    """Data of the kernel."""

    rate: np.ndarray
    """[1/s], shape (1,)"""


@stage(force, Damping, on_device=True)
@jit
def damp(damping, state, substep):
    """Scale the velocity and the mobility of every free particle."""
    if at_the_end(state.apart):
        _damp_at_the_end(damping, state, substep)
    else:
        _damp_leapfrog(damping, state, substep)


@jit
def _damp_at_the_end(damping, state, substep):
    v, w, slots = state.v, state.inv_mass, len(state.inv_mass)
    begin, end, turn = turns_on_device(state.team, slots // lanes(w))
    for n in range(begin, end, turn):
        q = n * lanes(w)
        step = step_of(state.history, w, q, substep.h)
        share = 1.0 / (1.0 + damping.rate[0] * step)
        free = load(w, q) > 0.0
        store(state.mobility, q, load(state.mobility, q) * share)
        for k in range(3):
            i = k * slots + q
            vi = load(v, i)
            store(v, i, select(free, vi * share, vi))


@jit(inline=True)
def _parts(damping, h):
    """Return (1 - θ) h rate and θ h rate."""
    full = damping.rate[0] * h
    theta = 0.5 + 0.5 * min(1.0, max(0.0, full - 1.0))
    return (1.0 - theta) * full, theta * full


@jit
def _damp_leapfrog(damping, state, substep):
    """
    Damp v, which other forces have changed, by its value before them and before gravity.

    That is (x - x_n) / h - h g, with x as predicted from it. Its rounding error, that of x over h,
    enters v times (1 - θ) h rate.
    """
    v, w, slots, h = state.v, state.inv_mass, len(state.inv_mass), substep.h
    early, late = _parts(damping, h)
    if substep.begin == 0.0:
        early = 0.0
    share, per_step = 1.0 / (1.0 + late), 1.0 / h
    begin, end, turn = turns_on_device(state.team, slots // lanes(w))
    for n in range(begin, end, turn):
        q = n * lanes(w)
        free = load(w, q) > 0.0
        store(state.mobility, q, load(state.mobility, q) * share)
        for k in range(3):
            i = k * slots + q
            vi, fall = load(v, i), h * state.gravity[k]
            before = (load(state.x, i) - load(state.x_prev, i)) * per_step - fall
            store(v, i, select(free, (vi - early * before) * share, vi))


@stage(damp_half_kick, Damping, on_device=True)
@jit
def damp_kick(damping, state, substep):
    """Damp the half kick that ends a frame by (1 - θ) h rate v, also of particles in contact."""
    if half_of(substep) < 0.0:
        return
    v, w, move, slots = state.v, state.inv_mass, state.apart.move, len(state.inv_mass)
    early, _ = _parts(damping, substep.h)
    begin, end, turn = turns_on_device(state.team, slots // lanes(w))
    for n in range(begin, end, turn):
        q = n * lanes(w)
        for k in range(3):
            i = k * slots + q
            store(move, i, load(move, i) - 2.0 * early * substep.h * load(v, i))


class BuiltDamping(Built):
    """The rate, for all particles of the scene."""

    def __init__(self, parameters, world):
        super().__init__()
        self.data = Damping(np.array([parameters.rate], world.state.x.dtype))
        if 'pin' in world.built:
            world.built['pin'].damping = self.data.rate


EFFECT = Effect('damping', Parameters, BuiltDamping)
