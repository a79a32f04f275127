"""
Damping: every velocity decays as exp(-rate t), as in a resisting medium.

v <- v exp(-rate h), on the velocity before this substep's gravity, so that a constant force still
gives its full acceleration. The factor comes from exact decimal arithmetic: libraries differ in
the last bit of exp.

Limits: it also damps the motion as a whole, so a cloth falls at most at g / rate.
"""

from dataclasses import dataclass
from decimal import Decimal
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.stages import force, stage


@dataclass(frozen=True)
class Parameters:
    """The rate."""

    rate: float = quantity(unit='1/s', minimum=0.0, live=True, doc='rate of decay')


class Damping(NamedTuple):
    """Data of the kernel."""

    factor: np.ndarray
    """exp(-rate h), shape (1,)"""


@stage(force, Damping)
@jit
def damp(damping, state, substep):
    """Scale every free velocity."""
    factor = damping.factor[0]
    for i in range(len(state.v)):
        if state.inv_mass[i] > 0.0:
            for k in range(3):
                state.v[i, k] *= factor


class BuiltDamping(Built):
    """Knows the rate; the factor follows the substep."""

    def __init__(self, rate: float):
        super().__init__()
        self.rate = rate
        self.data = Damping(np.ones(1))

    def begin(self, clock, state):
        exponent = -Decimal(self.rate) * Decimal(clock.dt) / clock.substeps
        self.data.factor[0] = float(max(exponent, Decimal(-700)).exp())


EFFECT = Effect('damping', Parameters, lambda parameters, world: BuiltDamping(parameters.rate))
