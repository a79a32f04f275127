"""
Creep: the slip of sticking pairs that one sweep leaves, and friction undoes in the next substep.

Pair contacts and contacts alternate. Friction between layers moves the lower one, which its
collider moves back, so layers on a slope would go on slipping. Friction therefore opposes the slip
of a substep and, as a tangential spring does (P. A. Cundall, O. D. L. Strack, "A discrete
numerical model for granular assemblies", 1979), what is left of earlier slips:

    e += u - (n · u) n,   u = Σ b (x - x_n)

while |s| < μ d. Other pairs may hold a particle of a pair at that limit, which therefore keeps e,
and adds u where u opposes e. But if u exceeds e, the pair slides. e is reset to 0 when a pair
slides or loses contact, and for all pairs whenever they are regrouped.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import any_lane, both, either, lanes, load, select, smaller
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import turns_on_device, wait_on_device
from xpbd_ros.sim.geometry.closest_points_simd import dot, minus
from xpbd_ros.sim.self_collision.pair_contacts import (
    coefficients,
    load_corners,
    load_vector,
    load_weights,
    store_vector,
    weighted,
)

BELOW = 0.999
"""largest |s| of a pair below the limit, relative to μ d"""


@jit
def note_creep(friction, pairs, near, state):
    """Update e of all pairs at the end of a substep."""
    if friction is not None:
        load_displacements(near, state)
        begin, end, turn = turns_on_device(state.team, pairs.end[0] // PACK)
        for pack in range(begin, end, turn):
            for q in range(PACK * pack, PACK * (pack + 1), lanes(near.move)):
                note_creep_of(friction, pairs, near, q)
        wait_on_device(state.team)


@jit(inline=True)
def load_displacements(near, state):
    """Copy the displacements in this substep to the records ``near.move``."""
    x, before, step, move = state.x, state.x_prev, near.step, near.move
    begin, end, turn = turns_on_device(state.team, len(near.slot))
    for i in range(begin, end, turn):
        j = near.slot[i]
        for a in range(3):
            move[i, a] = x[a, j] - before[a, j] - step[a]
    wait_on_device(state.team)


@jit(inline=True)
def note_creep_of(friction, pairs, near, q):
    """Update e of a vector of pairs; it is 0 of those that slide."""
    push, e = load(pairs.push, q), load_vector(friction.creep, q)
    touches = push > 0.0
    if any_lane(touches):
        n, s = load_vector(pairs.normal, q), load_vector(friction.slip, q)
        u = across(n, weighted(load_weights(pairs, q), *load_corners(
            near.move, pairs.particles, q)))
        limit = BELOW * load(coefficients(friction.coefficient, friction.slides), q) * (
            push - smaller(load(friction.unloaded, q), push))
        below = dot(s, s) < limit * limit
        sticks = either(below, dot(u, u) <= dot(e, e))
        touches, adds = both(touches, sticks), either(below, dot(u, e) < 0.0)
        e = (select(adds, e[0] + u[0], e[0]), select(adds, e[1] + u[1], e[1]),
             select(adds, e[2] + u[2], e[2]))
    store_vector(friction.creep, q, (select(touches, e[0], 0.0), select(touches, e[1], 0.0),
                                     select(touches, e[2], 0.0)))


@jit(inline=True)
def across(n, v):
    """Return v without its component along n."""
    along = dot(n, v)
    return minus(v, (along * n[0], along * n[1], along * n[2]))
