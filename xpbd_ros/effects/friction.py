"""
Friction: Coulomb's law in position form, for every contact of this substep.

With Δp = (x - x_prev) - (motion of the collider's surface), its tangential part Δp_t and the
contact's push d along the normal (Macklin et al. 2014, eq 24; without what only undoes an old
overlap),

    s <- s - Δp_t, shortened to |s| ≤ μ d,   x += change of s

stick where |Δp_t| ≤ μ d, else slide with the friction μ d. In rest on a slope d = g cos(θ) h², so
sticking is exact and a sliding particle slows by exactly μ g cos(θ). μ of a pair is the geometric
mean of the two coefficients unless one is given for the pair.

Limits: one coefficient for sticking and sliding. A collider's velocity changes where frames meet,
at once, so cloth on one that speeds up slips a little where smooth motion would carry it along.
"""

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.contacts import Contacts, surface_motion
from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.stages import stage, touch


@dataclass(frozen=True)
class Parameters:
    """Coefficients of pairs; all other pairs take the geometric mean of the two surfaces."""

    pairs: dict[str, dict[str, float]] = quantity(
        {}, minimum=0.0, doc='cloth: {collider: coefficient μ}')


class Friction(NamedTuple):
    """Data of the kernels."""

    contacts: Contacts
    cloth: np.ndarray
    """index of each particle's cloth, shape (slots,)"""
    coefficient: np.ndarray
    """μ by cloth and collider, shape (cloths, capacity)"""


@stage(touch, Friction)
@jit
def resist(friction, state, substep):
    """Take back tangential motion, within the cone |s| ≤ μ d."""
    contacts, x, before = friction.contacts, state.x, state.x_prev
    n, s = contacts.normal, contacts.slip
    for k in range(contacts.count[0]):
        if contacts.push[k] == 0.0 and s[k, 0] == 0.0 and s[k, 1] == 0.0 and s[k, 2] == 0.0:
            continue
        i = contacts.particle[k]
        ux, uy, uz = surface_motion(contacts, k, state, substep)
        px, py = x[0, i] - before[0, i] - ux, x[1, i] - before[1, i] - uy
        pz = x[2, i] - before[2, i] - uz
        pn = px * n[k, 0] + py * n[k, 1] + pz * n[k, 2]
        sx, sy = s[k, 0] - (px - pn * n[k, 0]), s[k, 1] - (py - pn * n[k, 1])
        sz = s[k, 2] - (pz - pn * n[k, 2])
        l = sqrt(sx * sx + sy * sy + sz * sz)
        load = contacts.push[k] - min(contacts.overlap[k], contacts.push[k])
        limit = friction.coefficient[friction.cloth[i], contacts.collider[k]] * load
        if l > limit:
            f = limit / l
            sx, sy, sz = f * sx, f * sy, f * sz
        x[0, i] += sx - s[k, 0]
        x[1, i] += sy - s[k, 1]
        x[2, i] += sz - s[k, 2]
        s[k, 0], s[k, 1], s[k, 2] = sx, sy, sz


class BuiltFriction(Built):
    """Friction has no state of its own: it reads the contacts."""

    def __init__(self, parameters: Parameters, world):
        super().__init__()
        contact = world.built['contact']
        coefficient = np.zeros((len(world.cloths), len(contact.colliders.friction)))
        cloth_of = np.zeros(world.slots, np.int64)
        unknown = set(parameters.pairs) - {cloth.name for cloth in world.cloths}
        if unknown:
            raise InputError(f'effects.friction.pairs: unknown cloth {sorted(unknown)}')
        for k, cloth in enumerate(world.cloths):
            cloth_of[cloth.slots] = k
            pairs = parameters.pairs.get(cloth.name, {})
            unknown = set(pairs) - set(contact.entries)
            if unknown:
                raise InputError(f'effects.friction.pairs.{cloth.name}: unknown collider '
                                 f'{sorted(unknown)} (known: {", ".join(contact.entries)})')
            for c, name in enumerate(contact.entries):
                coefficient[k, c] = pairs.get(
                    name, sqrt(cloth.friction * contact.colliders.friction[c]))
        self.data = Friction(contact.contacts, cloth_of, coefficient)


EFFECT = Effect('friction', Parameters, BuiltFriction, needs=('contact', 'self_collision'))
