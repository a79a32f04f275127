"""
Force: a constant force on particles, given per particle, per mass or as a total.

    v <- v + H w f,   x <- x + H² w f

with f [N] of each particle: ``per_particle`` itself, ``per_mass`` times its mass (a field such as
gravity), or its part by mass of ``total``, the sum over all named particles. It acts on one cloth
or all, or on some particles of a cloth. Pinned particles pass it on to their pin.

Limits: one force per scene, constant in space, and in time except for live changes.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import fma, lanes, load, select, store
from xpbd_ros.sim.backend.threads import turns_on_device
from xpbd_ros.sim.effect import Built, cloth_of, Effect
from xpbd_ros.sim.parameters import check_place, quantity
from xpbd_ros.sim.particles.history import step_of
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    add_explicit_forces,
    force,
    react_to_half_kick,
    stage,
)

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Parameters:
    """One of three measures, and the particles that it acts on."""

    per_particle: Vector | None = quantity(None, unit='N', live=True, doc='force on each particle')
    per_mass: Vector | None = quantity(None, unit='N/kg', live=True, doc='force per mass')
    total: Vector | None = quantity(None, unit='N', live=True, doc='total force, shared by mass')
    cloth: str | None = quantity(None, doc='the cloth that it acts on; all unless given')
    at: str | tuple[int, ...] | None = quantity(
        None, doc='corner_00 …, edge_0x …, or indices; all particles unless given')

    def __post_init__(self):
        """Require exactly one measure, and a cloth for particles named by index."""
        if sum(f is not None for f in (self.per_particle, self.per_mass, self.total)) != 1:
            raise InputError('needs per_particle (N), per_mass (N/kg) or total (N), and only one '
                             'of them')
        check_place(self.at)
        if self.at is not None and self.cloth is None:
            raise InputError('at: needs cloth, to tell whose particles are meant')


class Force(NamedTuple):
    """Data of the kernels."""

    f: np.ndarray
    """[N], shape (3, slots)"""


@stage(force, Force, on_device=True)
@jit
def push(data, state, substep):
    """Add the force to the velocity of every free particle."""
    v, w, f, slots = state.v, state.inv_mass, data.f, len(state.inv_mass)
    begin, end, turn = turns_on_device(state.team, slots // lanes(w))
    for n in range(begin, end, turn):
        q = n * lanes(w)
        step = step_of(state.history, w, q, substep.h)
        rate = step * load(w, q)
        for k in range(3):
            i = k * slots + q
            store(v, i, fma(rate, load(f, i), load(v, i)))


@stage(add_explicit_forces, Force)
@jit
def kick_force(data, state, substep):
    """H² w f."""
    move, f, m, slots = state.apart.move, data.f, state.mobility, len(state.mobility)
    for q in range(0, slots, lanes(m)):
        for k in range(3):
            i = k * slots + q
            store(move, i, fma(load(m, q), load(f, i), load(move, i)))


@stage(react_to_half_kick, Force)
@stage(accumulate_reactions, Force, on_device=True)
@jit
def react_force(data, state, substep):
    """Add the force on pinned particles to the load of their pins."""
    r, w, f, slots = state.reaction, state.inv_mass, data.f, len(state.inv_mass)
    part = substep.end - substep.begin
    begin, end, turn = turns_on_device(state.team, slots // lanes(w))
    for n in range(begin, end, turn):
        q = n * lanes(w)
        free = load(w, q) > 0.0
        for k in range(3):
            i = k * slots + q
            store(r, i, load(r, i) + select(free, 0.0, part * load(f, i)))


class BuiltForce(Built):
    """The force on each particle."""

    def __init__(self, parameters, world):
        super().__init__()
        state, cloths = world.state, {cloth.name: cloth for cloth in world.cloths}
        if parameters.cloth is None:
            slots = np.concatenate([cloth.slots for cloth in world.cloths])
        else:
            cloth = cloth_of(cloths, parameters.cloth, 'effects.force.cloth')
            slots = (cloth.slots if parameters.at is None
                     else cloth.at(parameters.at, 'effects.force.at'))
        mass = state.mass[slots].astype(float)
        if parameters.per_particle is not None:
            force_, share = parameters.per_particle, np.ones(len(slots))
        elif parameters.per_mass is not None:
            force_, share = parameters.per_mass, mass
        else:
            force_, share = parameters.total, mass / mass.sum()
        self.data = Force(zeros((3, world.slots), state.x.dtype))
        self.data.f[:, slots] = np.outer(force_, share)
        self.force = self.data.f


EFFECT = Effect('force', Parameters, BuiltForce)
