"""Coefficients and limits of friction between cloths and colliders."""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.contacts import Contacts


class Friction(NamedTuple):
    """Friction between cloths and colliders; data of the kernels of ``effects.friction``."""

    contacts: Contacts
    cloth: np.ndarray
    """index of each particle's cloth, shape (slots,)"""
    coefficient: np.ndarray
    """μ_k by cloth and collider, shape (cloths, capacity)"""
    static: np.ndarray | None
    """μ_s likewise; None where it is μ_k everywhere"""


@jit(inline=True)
def holds(static, a, c, kinetic):
    """Return μ_s of cloth a and collider c."""
    if static is None:
        return kinetic
    else:    # Numba prunes the branch that is not taken
        return static[a, c]


@jit(inline=True)
def limits(friction, k):
    """Return μ_s d and μ_k d of contact k [m]."""
    contacts = friction.contacts
    load = contacts.push[k] - min(contacts.overlap[k], contacts.push[k])
    a, c = friction.cloth[contacts.particle[k]], contacts.collider[k]
    mu = friction.coefficient[a, c]
    return holds(friction.static, a, c, mu) * load, mu * load
