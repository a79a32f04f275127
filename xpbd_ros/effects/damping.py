"""
Damping: a drag on every particle in proportion to its mass and velocity, as in a resisting medium.

The force -rate m v is taken at the end of the substep, in closed form: with v = v̄ + H (g - rate v),

    v <- (v̄ + H g) / (1 + H rate),   mobility <- mobility / (1 + H rate),

so it is of the integrator's own order, stable at any rate, and a cloth falls at most at g / rate.

Limits: it also damps the motion as a whole.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.stages import force, stage
from xpbd_ros.sim.vector import lanes, load, select, store


@dataclass(frozen=True)
class Parameters:
    """The rate."""

    rate: float = quantity(unit='1/s', minimum=0.0, live=True, doc='rate of decay')


class Damping(NamedTuple):
    """Data of the kernel."""

    rate: np.ndarray
    """[1/s], shape (1,)"""


@stage(force, Damping)
@jit
def damp(damping, state, substep):
    """Slow every free particle, and what constraints may do to it."""
    _damp(damping.rate, state, state.history, substep.h)


@jit
def _damp(rate, state, history, h):
    w, mobility = state.inv_mass, state.mobility
    for q in range(0, len(w), lanes(w)):
        if history is None:
            share = 1.0 / (1.0 + h * rate[0] + 0.0 * load(w, q))
        else:
            share = 1.0 / (1.0 + rate[0] * load(history.step, q))
        store(mobility, q, load(mobility, q) * share)
        for k in range(3):
            v = state.v[k]
            store(v, q, select(load(w, q) > 0.0, load(v, q) * share, load(v, q)))


class BuiltDamping(Built):
    """Knows the rate."""

    def __init__(self, parameters, world):
        super().__init__()
        self.data = Damping(np.array([parameters.rate], world.state.x.dtype))


EFFECT = Effect('damping', Parameters, BuiltDamping)
