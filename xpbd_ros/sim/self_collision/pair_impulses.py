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
def remove_depenetration_velocity(pairs, near, state, substep):
    """Remove the normal velocity that results from depenetration of earlier overlaps."""
    mark_pushed(state.team, pairs, near, pairs.overlap)
    if alone_on_device(state.team):
        k = next_marked(near.hits, 0, pairs.end[0])
        while k < pairs.end[0]:
            calm_pair(pairs, k, near, state, substep.h)
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
def calm_pair(pairs, k, near, state, h):
    """Remove the normal velocity from depenetration of pair k, and the friction of that push."""
    v, n, four = state.v, normal_of(pairs, k), corners(pairs, k, near, state)
    apart = undone(pairs, k, h * parting(four, n, v))
    if apart <= 0.0:
        return
    beyond = share_beyond(pairs.friction, k, pairs.push[k] - apart)
    per = 1.0 / (h * mobility(four))
    for j, b, w in four:
        for a in range(3):
            v[a, j] -= w * b * per * (apart * n[a] + beyond * slip_of(pairs.friction, k, a))


@jit(inline=True)
def normal_of(pairs, k):
    """Return n of pair k."""
    return pairs.normal[0, k], pairs.normal[1, k], pairs.normal[2, k]


@jit(inline=True)
def corners(pairs, k, near, state):
    """Return slot, b and w (``inverse_mass``) of the four particles of pair k; Σ b = 0 exactly."""
    q, r, s = (corner(pairs, k, near, state, 1), corner(pairs, k, near, state, 2),
               corner(pairs, k, near, state, 3))
    j, _, w = corner(pairs, k, near, state, 0)
    return (j, -(s[1] + r[1] + q[1]), w), q, r, s


@jit(inline=True)
def corner(pairs, k, near, state, p):
    """Return those of particle p; where it is unused, b = w = 0."""
    i = pairs.particles[p, k]
    if i == len(near.slot):
        return near.slot[0], 0.0, 0.0
    return near.slot[i], float(pairs.weight[p, k]), inverse_mass(near.h, state, near.slot[i])


@jit(inline=True)
def mobility(four):
    """Return W = Σ w b² [1/kg]."""
    total = 0.0
    for _, b, w in four:
        total += w * b * b
    return total


@jit(inline=True)
def parting(four, n, v):
    """Return n · Σ b v, for velocities or positions v of the slots."""
    total = 0.0
    for j, b, _ in four:
        total += b * (n[0] * v[0, j] + n[1] * v[1, j] + n[2] * v[2, j])
    return total


@jit(inline=True)
def share_beyond(friction, k, load):
    """Return the share of the friction of pair k beyond the cone of a load [m]."""
    if friction is None:
        return 0.0
    else:    # Numba prunes the branch that is not taken
        s = friction.slip
        size = sqrt(s[0, k] * s[0, k] + s[1, k] * s[1, k] + s[2, k] * s[2, k])
        most = coefficients(friction.coefficient, friction.slides)[k] * load
        return 1.0 - most / size if size > most else 0.0


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
    n, four = normal_of(pairs, k), corners(pairs, k, near, state)
    load = pairs.push[k] - undone(pairs, k, parting(four, n, state.x) - parting(
        four, n, state.x_prev))
    within, per = 1.0 - share_beyond(pairs.friction, k, load), part / mobility(four)
    for j, b, _ in four:
        if state.inv_mass[j] == 0.0:
            for a in range(3):
                state.reaction[a, j] += per * b * (
                    load * n[a] + within * slip_of(pairs.friction, k, a))


@jit(inline=True)
def slip_of(friction, k, a):
    """Return component a of the displacement by friction of pair k [m]; 0 without friction."""
    if friction is None:
        return 0.0
    else:    # Numba prunes the branch that is not taken
        return friction.slip[a, k]
