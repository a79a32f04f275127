"""
Wind: uniform velocity of the air, with gusts, which acts on the cloth through ``drag``.

    u(t) = velocity + gust sin(2 π t / period)

with t from the scene's start. The force is that of ``drag``, which a scene with wind always has,
by default with its usual coefficients. ``~/wind`` sets the mean velocity while the scene runs; a
reset restores the scene's.

Limits: uniform in space and not slowed by the cloth; cloth in the lee feels it too. Within a frame
gusts are interpolated linearly.
"""

from dataclasses import dataclass
from math import pi, sin
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.commands import SetWind
from xpbd_ros.sim.constraints.projection import at_the_end
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.stepping.stages import add_explicit_forces, force, stage

FASTEST = 1e4
"""largest velocity component that is accepted [m/s]"""


@dataclass(frozen=True)
class Parameters:
    """The mean velocity and the gusts."""

    velocity: tuple[float, float, float] = quantity(
        unit='m/s', minimum=-FASTEST, maximum=FASTEST, live=True, doc='mean velocity of the air')
    gust: tuple[float, float, float] = quantity(
        (0.0, 0.0, 0.0), unit='m/s', minimum=-FASTEST, maximum=FASTEST, live=True,
        doc='amplitude of the gusts')
    period: float = quantity(2.0, unit='s', above=0.0, live=True, doc='period of the gusts')


class Wind(NamedTuple):
    """Data of the kernel."""

    start: np.ndarray
    """velocity at the frame's start [m/s], shape (3,)"""
    goal: np.ndarray
    """velocity at its end [m/s], shape (3,)"""
    now: np.ndarray
    """velocity where the substep's forces act [m/s], shape (3,)"""


@stage(force, Wind)
@jit
def blow(wind, state, substep):
    """Interpolate the velocity at the substep's end; at its start for the leapfrog."""
    _blow_at(wind, substep.end if at_the_end(state.apart) else substep.begin)


@stage(add_explicit_forces, Wind)
@jit
def blow_at_an_end(wind, state, substep):
    """Interpolate the velocity at an end of the frame."""
    _blow_at(wind, substep.end)


@jit
def _blow_at(wind, share):
    for k in range(3):
        wind.now[k] = wind.start[k] + share * (wind.goal[k] - wind.start[k])


class BuiltWind(Built):
    """The wind of a scene; commands change its mean velocity."""

    def __init__(self, parameters, world):
        super().__init__()
        self.parameters = parameters
        self.velocity = np.array(parameters.velocity)
        """mean velocity of the scene or of the last command [m/s]"""
        self.data = Wind(*(np.zeros(3) for _ in range(3)))

    def refusal(self, commands, state):
        return next((f'wind: {list(command.velocity)} is faster than {FASTEST:g} m/s'
                     for command in commands if max(map(abs, command.velocity)) > FASTEST), None)

    def change(self, command, clock, state) -> None:
        """Change the mean velocity."""
        self.velocity = np.array(command.velocity)

    commands = {SetWind: change}

    def begin(self, clock, state):
        for velocity, age_ns in ((self.data.start, clock.begin_age_ns),
                                 (self.data.goal, clock.end_age_ns)):
            turns = age_ns * 1e-9 / self.parameters.period
            velocity[:] = self.velocity + np.multiply(self.parameters.gust,
                                                      sin(2.0 * pi * (turns % 1.0)))

    def reset(self, state):
        self.velocity = np.array(self.parameters.velocity)

    def adopt(self, old):
        if self.parameters.velocity == old.parameters.velocity:
            self.velocity = old.velocity

    def written_by_begin(self):
        return self.data.start, self.data.goal

    def stats(self):
        return {'wind_m_s': float(np.linalg.norm(self.data.goal))}


EFFECT = Effect('wind', Parameters, BuiltWind, brings=('drag',))
