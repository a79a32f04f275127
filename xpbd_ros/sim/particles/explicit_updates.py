"""
Updates of methods that add up moves: Jacobi's sum, and the leapfrog of the explicit method.

The leapfrog keeps velocities half a substep from the positions (doc/numerics.md 2.3).
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lanes, load, select, store
from xpbd_ros.sim.backend.threads import wait
from xpbd_ros.sim.particles.integration import own
from xpbd_ros.sim.particles.state import State


@jit
def at_start(state):
    """Return the state with the particles where the substep starts."""
    return State(state.x_prev, state.x_prev, state.v, state.mass, state.inv_mass, state.mobility,
                 state.gravity, state.reaction, state.history, state.apart, state.team,
                 state.gap)


@jit(inline=True)
def _taken(move, i):
    """Return moves from index i on, and set them to zero."""
    found = load(move, i)
    store(move, i, 0.0)
    return found


@jit
def add_moves(state):
    """x += the moves that the constraints summed up."""
    x, move, slots = state.x, state.apart.move, len(state.inv_mass)
    first, last = own(state)
    for k in range(3):
        for i in range(k * slots + first, k * slots + last, lanes(x)):
            store(x, i, load(x, i) + _taken(move, i))
    wait(state.team)


@jit
def apply_leapfrog_kick(state, substep):
    """
    v += h F / m, with the moves h² F / m that were summed up, and x as v then says.

    The moves themselves, added to x, would lose what is below its last bit, and v with it. What
    moved x since it was predicted (soft pins) is kept.
    """
    w, v, move, slots = state.inv_mass, state.v, state.apart.move, len(state.inv_mass)
    h = substep.h
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        free = load(w, q) > 0.0
        for k in range(3):
            i = k * slots + q
            xi, start, vi = load(state.x, i), load(state.x_prev, i), load(v, i)
            moved = xi - (start + h * vi)
            vi = vi + _taken(move, i) * (1.0 / h)
            store(v, i, select(free, vi, load(v, i)))
            store(state.x, i, select(free, start + h * vi + moved, xi))
    wait(state.team)


@jit(inline=True)
def stay(state, i, h):
    """Have a particle keep its velocity in ``half_kick``."""
    for k in range(3):
        state.apart.move[k, i] = -h * h * state.gravity[k]


@jit
def half_kick(state, h, share):
    """v += share h a, with the moves h² F / m that were summed up; pinned particles keep v."""
    v, w, move, slots = state.v, state.inv_mass, state.apart.move, len(state.inv_mass)
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        free = load(w, q) > 0.0
        for k in range(3):
            i = k * slots + q
            vi = load(v, i)
            change = share / h * _taken(move, i) + share * h * state.gravity[k]
            store(v, i, select(free, vi + change, vi))
    wait(state.team)
