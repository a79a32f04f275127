"""Coefficients and limits of friction between cloths and colliders."""

from xpbd_ros.sim.backend.jit import jit


@jit(inline=True)
def holds(static, a, c, kinetic):
    """Return μ_s of cloth a and collider c."""
    if static is None:
        return kinetic
    else:    # Numba prunes the branch that is not taken
        return static[a, c]


@jit(inline=True)
def limits(friction, k):
    """Return μ_s d and μ_k d of contact k [m], with the data of ``effects.friction``."""
    contacts = friction.contacts
    load = contacts.push[k] - min(contacts.overlap[k], contacts.push[k])
    a, c = friction.cloth[contacts.particle[k]], contacts.collider[k]
    mu = friction.coefficient[a, c]
    return holds(friction.static, a, c, mu) * load, mu * load
