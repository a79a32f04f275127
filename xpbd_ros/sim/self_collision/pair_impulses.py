"""
What pair contacts give at a substep's end: velocities without depenetration, forces on pins.

Depenetration of an earlier overlap must not become velocity, nor must the friction that only this
part of the push allowed:

    a = min(h n · Σ b v, overlap, d),   v -= w b (a n + max(0, 1 - μ (d - a) / |s|) s) / (W h)
"""

from math import sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import bits, both, lanes, load
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import alone_on_device, turns_on_device, wait_on_device
from xpbd_ros.sim.self_collision.inverse_mass import inverse_mass
from xpbd_ros.sim.self_collision.neighbour_list import next_marked
from xpbd_ros.sim.self_collision.pair_contacts import coefficients


@jit
def mobility_of_pair(pairs, k, near, state):
    """Return W = Σ w b² of pair k [1/kg], w by ``inverse_mass``."""
    total = 0.0
    for p in range(4):
        i = pairs.particles[p, k]
        if i < len(near.slot):
            total += inverse_mass(near.h, state, near.slot[i]) * pairs.weight[p, k]**2
    return total


@jit
def remove_depenetration_velocity(pairs, near, state, substep):
    """Remove the normal velocity that results from depenetration of earlier overlaps."""
    mark_pushed(state.team, pairs, near, pairs.overlap)
    if alone_on_device(state.team):
        k = next_marked(near.hits, 0, pairs.end[0])
        while k < pairs.end[0]:
            calm_pair(pairs, k, near, state, substep)
            k = next_marked(near.hits, k + 1, pairs.end[0])


@jit
def mark_pushed(team, pairs, near, numbers):
    """Set ``hits`` for the pairs in groups that push and whose number is positive."""
    begin, end, turn = turns_on_device(team, pairs.end[0] // PACK)
    for pack in range(begin, end, turn):
        found = 0
        for q in range(PACK * pack, PACK * (pack + 1), lanes(pairs.push)):
            found |= bits(both(load(numbers, q) > 0.0, load(pairs.push, q) > 0.0)) << (
                q - PACK * pack)
        near.hits[pack] = found
    wait_on_device(team)


@jit(inline=True)
def calm_pair(pairs, k, near, state, substep):
    """Remove the normal velocity from depenetration of pair k, and the friction of that push."""
    apart = undone(pairs, k, substep.h * parting(pairs, k, near, state.v))
    if apart <= 0.0:
        return
    excess = excess_slip(pairs.friction, k, pairs.push[k] - apart)
    per = 1.0 / (substep.h * mobility_of_pair(pairs, k, near, state))
    rest = 0.0
    for p in range(3, -1, -1):
        b = float(pairs.weight[p, k]) if p > 0 else -rest
        rest += b
        i = pairs.particles[p, k]
        if i < len(near.slot):
            j = near.slot[i]
            share = inverse_mass(near.h, state, j) * b * per
            for a in range(3):
                state.v[a, j] -= share * (apart * pairs.normal[a, k] + excess[a])


@jit(inline=True)
def excess_slip(friction, k, load):
    """Return what the displacement by friction of pair k has beyond the cone of a load [m]."""
    if friction is None:
        return 0.0, 0.0, 0.0
    else:    # Numba prunes the branch that is not taken
        s = friction.slip
        size = sqrt(s[0, k] * s[0, k] + s[1, k] * s[1, k] + s[2, k] * s[2, k])
        most = coefficients(friction.coefficient, friction.slides)[k] * load
        part = 1.0 - most / size if size > most else 0.0
        return part * s[0, k], part * s[1, k], part * s[2, k]


@jit(inline=True)
def parting(pairs, k, near, v):
    """Return n · Σ b v of pair k, for velocities or positions v of the slots."""
    n, total, rest = pairs.normal, 0.0, 0.0
    for p in range(3, -1, -1):
        b = float(pairs.weight[p, k]) if p > 0 else -rest
        rest += b
        i = pairs.particles[p, k]
        if i < len(near.slot):
            j = near.slot[i]
            total += b * (n[0, k] * v[0, j] + n[1, k] * v[1, j] + n[2, k] * v[2, j])
    return total


@jit(inline=True)
def undone(pairs, k, parted):
    """Return the part of the push of pair k by which it has parted from an old overlap."""
    return max(0.0, min(parted, min(pairs.overlap[k], pairs.push[k])))


@jit
def press(pairs, near, state, substep):
    """Add the forces on pinned particles, b (n d + s) / (W h²), to the mean over the frame."""
    part = (substep.end - substep.begin) / substep.h**2
    mark_pushed(state.team, pairs, near, pairs.push)
    if alone_on_device(state.team):
        k = next_marked(near.hits, 0, pairs.end[0])
        while k < pairs.end[0]:
            press_by_pair(pairs, k, near, state, part)
            k = next_marked(near.hits, k + 1, pairs.end[0])


@jit(inline=True)
def press_by_pair(pairs, k, near, state, part):
    """Add those of pair k, without what leaves no velocity."""
    scale = part / mobility_of_pair(pairs, k, near, state)
    load = pairs.push[k] - undone(pairs, k, parting(pairs, k, near, state.x) - parting(
        pairs, k, near, state.x_prev))
    excess = excess_slip(pairs.friction, k, load)
    for p in range(4):
        i = pairs.particles[p, k]
        if i == len(near.slot) or state.inv_mass[near.slot[i]] > 0.0:
            continue
        for a in range(3):
            along = pairs.normal[a, k] * load + slip_of(pairs.friction, k, a) - excess[a]
            state.reaction[a, near.slot[i]] += scale * pairs.weight[p, k] * along


@jit(inline=True)
def slip_of(friction, k, a):
    """Return component a of the displacement by friction of pair k [m]; 0 without friction."""
    if friction is None:
        return 0.0
    else:    # Numba prunes the branch that is not taken
        return friction.slip[a, k]
