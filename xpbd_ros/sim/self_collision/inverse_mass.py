"""
Inverse masses with which particles give way to impulses.

The spring of a compliant pin bears a part of every impulse on its particle, so the mobility m is
less than w H² (``effects.pin``). Pairs then weigh particles by m / H².
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.particles.history import weights_before


@jit
def note_length(h, length):
    """Note the length of the substep [s]; ``h`` is that of ``NeighbourList``."""
    if h is not None:
        h[0] = length


@jit(inline=True)
def inverse_mass(h, state, j):
    """Return the inverse mass of slot j: w, or m / H² in a scene with compliant pins [1/kg]."""
    if h is None:
        return state.inv_mass[j]
    else:    # Numba prunes the branch that is not taken
        return state.mobility[j] / (weights_before(state.history, j)[0] * h[0])**2
