"""
Particle updates from accumulated displacements: the Jacobi sum, and the explicit leapfrog.

The leapfrog's velocities are half a substep behind its positions (doc/numerics.md 2.3).
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import load, select, store
from xpbd_ros.sim.backend.threads import wait
from xpbd_ros.sim.particles.accumulators import moves
from xpbd_ros.sim.particles.integration import own
from xpbd_ros.sim.particles.rounding import store_sum
from xpbd_ros.sim.particles.state import State


@jit
def accumulating(state):
    """Return the state without ``rounding``: the accumulator's sums are not compensated."""
    return State(state.x, state.x_prev, state.v, state.mass, state.inv_mass, state.mobility,
                 state.gravity, state.reaction, state.history, state.apart, state.team,
                 state.gap, None, state.clock)


@jit
def at_start(state):
    """Return such a state with x = x_prev: constraints are evaluated at the substep's start."""
    return State(state.x_prev, state.x_prev, state.v, state.mass, state.inv_mass, state.mobility,
                 state.gravity, state.reaction, state.history, state.apart, state.team,
                 state.gap, None, state.clock)


@jit(inline=True)
def _load_and_clear(move, i):
    """Return the vector of displacements from index i on, and set it to zero."""
    found = load(move, i)
    store(move, i, 0.0)
    return found


@jit
def add_moves(state):
    """x += accumulated displacements."""
    x, move, slots = state.x, state.apart.move, len(state.inv_mass)
    first, last, step = own(state)
    for k in range(3):
        for i in range(k * slots + first, k * slots + last, step):
            store_sum(x, moves(state.rounding), i, load(x, i), _load_and_clear(move, i))
    wait(state.team)


@jit
def apply_leapfrog_kick(state, substep):
    """
    v += h F / m from the accumulated h² F / m, then x = x_prev + h v.

    A sum x + h² F / m would lose the displacement's bits below the last one of x, and so would a v
    computed from it. A displacement of x since the prediction (soft pins) is kept.
    """
    w, v, move, slots = state.inv_mass, state.v, state.apart.move, len(state.inv_mass)
    h = substep.h
    first, last, step = own(state)
    for q in range(first, last, step):
        free = load(w, q) > 0.0
        for k in range(3):
            i = k * slots + q
            xi, start, vi = load(state.x, i), load(state.x_prev, i), load(v, i)
            moved = xi - (start + h * vi)
            vi = vi + _load_and_clear(move, i) * (1.0 / h)
            store(v, i, select(free, vi, load(v, i)))
            store(state.x, i, select(free, start + h * vi + moved, xi))
    wait(state.team)


@jit(inline=True)
def half_of(substep):
    """Return the part of a substep by which ``half_kick`` goes: back where a frame begins."""
    return 0.5 if substep.end > substep.begin else -0.5


@jit(inline=True)
def stay(state, i, h):
    """Let the next ``half_kick`` leave the velocity of particle i unchanged."""
    for k in range(3):
        state.apart.move[k, i] = -h * h * state.gravity[k]


@jit(inline=True)
def displacement_before(state, i, k, h):
    """Return h v_n-1/2 of particle i [m] in the half kick where a frame begins."""
    if state.inv_mass[i] == 0.0:
        return h * state.v[k, i]
    return h * state.v[k, i] - 0.5 * (state.apart.move[k, i] + h * h * state.gravity[k])


@jit(inline=True)
def newmark(m, alpha):
    """
    Return γ and β of a spring with a compliance between particles of mobility m together.

    It acts at x_n + γ u + β (x_n+1 - x_n - u), u the displacement before. γ = 0 and β = 1/4 are
    Newmark's mean of x_n-1, 2 x_n and x_n+1, γ = β = 1 are backward Euler. As m / α, the square of
    frequency and substep, goes from 1 to 2, the one becomes the other.
    """
    late = 1.0 if alpha == 0.0 else min(1.0, max(0.0, m / alpha - 1.0))
    return late, 0.25 + 0.75 * late


@jit
def half_kick(state, h, share):
    """v += share h (F / m + g) from the accumulated h² F / m; pinned particles keep v."""
    v, w, move, slots = state.v, state.inv_mass, state.apart.move, len(state.inv_mass)
    first, last, step = own(state)
    for q in range(first, last, step):
        free = load(w, q) > 0.0
        for k in range(3):
            i = k * slots + q
            vi = load(v, i)
            change = share / h * _load_and_clear(move, i) + share * h * state.gravity[k]
            store(v, i, select(free, vi + change, vi))
    wait(state.team)
