"""
Damping: viscous drag on every particle, in proportion to its mass and velocity.

The force -rate m v is evaluated at the substep's end, in closed form: from v = v̄ + H (g - rate v),

    v <- (v̄ + H g) / (1 + H rate),   mobility <- mobility / (1 + H rate),

so it has the integrator's order and is stable at any rate. A falling cloth reaches the terminal
speed g / rate. Pins feel that of the particles that they hold.

Limits: it also damps the motion of the cloth as a whole. With ``explicit`` it is of first order:
displacements have a relative error of about h rate / 2.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lanes, load, select, store
from xpbd_ros.sim.backend.threads import turns_on_device
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.history import step_of
from xpbd_ros.sim.stepping.stages import force, stage


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


class BuiltDamping(Built):
    """The rate, for all particles of the scene."""

    def __init__(self, parameters, world):
        super().__init__()
        self.data = Damping(np.array([parameters.rate], world.state.x.dtype))
        if 'pin' in world.built:
            world.built['pin'].damping = self.data.rate


EFFECT = Effect('damping', Parameters, BuiltDamping)
