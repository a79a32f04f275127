"""
Springs of compliant pins: implicit with every method, of second order with ``explicit``.

The formulas are those of ``effects/pin.py`` and doc/numerics.md 6.3.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import turns_on_device
from xpbd_ros.sim.constraints.projection import at_the_end
from xpbd_ros.sim.particles.explicit_updates import displacement_before, newmark
from xpbd_ros.sim.particles.history import weights_at
from xpbd_ros.sim.particles.rounding import add_move
from xpbd_ros.sim.pins.held_places import Pin, place_of
from xpbd_ros.sim.pins.wrenches import deliver
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    add_explicit_forces,
    prepare,
    react_to_half_kick,
    stage,
)


class Spring(NamedTuple):
    """The particles that pins hold by springs."""

    pin: Pin
    """the list of these particles; rigidly pinned ones have their own"""
    compliance: np.ndarray
    """n α of each particle's spring [m/N], shape (particles,)"""
    place: np.ndarray
    """target of the implicit step, p + R q at its end [m], shape (particles, 3)"""
    softness: np.ndarray
    """compliance of that step, n α [m/N], shape (particles,)"""
    moved: np.ndarray
    """displacement in the substep before [m], shape (particles, 3); (0, 3) without ``explicit``"""


@stage(prepare, Spring, on_device=True)
@jit
def pull_to_pins(spring, state, substep):
    """Minimise each particle's inertia and spring together."""
    pin, x = spring.pin, state.x
    begin, end, turn = turns_on_device(state.team, pin.count[0])
    for k in range(begin, end, turn):
        i = pin.particle[k]
        m = state.mobility[i]
        aim(spring, state, substep, k)
        alpha = spring.softness[k]
        share = m / (m + alpha)
        for a in range(3):
            add_move(x, state.rounding, a, i, share * (spring.place[k, a] - x[a, i]))
        state.mobility[i] = m / (1.0 + m / alpha)    # also for infinite α


@jit(inline=True)
def aim(spring, state, substep, k):
    """
    Set target and compliance of the implicit step of a spring: p + R q and n α at its end.

    With ``explicit`` the spring acts at X = x_n + γ u + β (x_n+1 - x_n - u) (``newmark``): as a
    softer one, n α / β, to a target farther away.
    """
    pin, i = spring.pin, spring.pin.particle[k]
    alpha = spring.compliance[k]
    if at_the_end(state.apart):
        goal = place_of(pin, k, substep.end)
        for a in range(3):
            spring.place[k, a] = goal[a]
        spring.softness[k] = alpha
    else:
        late, beta = newmark(state.mobility[i], alpha)
        goal = place_of(pin, k, substep.begin + late * (substep.end - substep.begin))
        for a in range(3):
            start, u = state.x_prev[a, i], spring.moved[k, a]
            spring.place[k, a] = start + u + (goal[a] - start - late * u) / beta
        spring.softness[k] = alpha / beta


@stage(add_explicit_forces, Spring)
@jit
def kick_springs(spring, state, substep):
    """H² w (p + R q - x) / (n α)."""
    pin, x, move = spring.pin, state.x, state.apart.move
    for k in range(pin.count[0]):
        i = pin.particle[k]
        per, goal = state.mobility[i] / spring.compliance[k], place_of(pin, k, substep.end)
        spring.softness[k] = spring.compliance[k]
        for a in range(3):
            spring.place[k, a] = goal[a]
            move[a, i] += per * (goal[a] - x[a, i])


@stage(accumulate_reactions, Spring, on_device=True)
@jit
def stretch_springs(spring, state, substep):
    """Add the forces on the springs: (x - p - R q) / (n α)."""
    pin, part = spring.pin, substep.end - substep.begin
    begin, end, turn = turns_on_device(state.team, pin.count[0])
    for k in range(begin, end, turn):
        i = pin.particle[k]
        share, a, b = weights_at(state.history, i)
        for axis in range(3):
            f = (state.x[axis, i] - spring.place[k, axis]) / spring.softness[k]
            deliver(pin, k, axis, f, part, a, b, share)
            if not at_the_end(state.apart):
                spring.moved[k, axis] = state.x[axis, i] - state.x_prev[axis, i]


@stage(react_to_half_kick, Spring)
@jit
def stretch_springs_at_the_ends(spring, state, substep):
    """Do so in a half kick; where the frame begins, h v_n-1/2 is the displacement before."""
    pin, part = spring.pin, substep.end - substep.begin
    for k in range(pin.count[0]):
        i = pin.particle[k]
        for axis in range(3):
            f = (state.x[axis, i] - spring.place[k, axis]) / spring.softness[k]
            deliver(pin, k, axis, f, part, 0.0, 0.0, 1.0)
            spring.moved[k, axis] = displacement_before(state, i, axis, substep.h)
