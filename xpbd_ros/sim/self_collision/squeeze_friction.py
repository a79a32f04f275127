"""
Friction of layers between pads (``squeeze``), with the pushes d of pairs and colliders.

With v the displacements in a substep across the axis of the stack, y those without friction, and
Δ the tangential motion Σ b v of a pair, or v less that of the collider's surface, all contacts
stick at first: v minimises

    Σ |v - y|² / (2 m) + Σ STICK |Δ|² / (2 W)        (for a collider W is m)

and s = -STICK Δ. Then s is shortened to the friction cone, and the contacts are projected one
after the other until they hold, or slide with what they bear:

    s <- s - Δ, shortened to μ d,   x += w b (change of s) / W

So layers that stick need one linear solve, however many they are.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.collider_motion import surface_motion
from xpbd_ros.sim.contact.contacts import shortened
from xpbd_ros.sim.self_collision.backing import last_candidate
from xpbd_ros.sim.self_collision.springs import (
    add_force,
    begin_balance,
    free,
    let_act,
    step_towards_balance,
)
from xpbd_ros.sim.self_collision.stacks import mobility_of_pair

STICK = 1e5
"""displacement by friction, relative to the motion of a contact that sticks"""
SMALL = 1e-6
"""sum of the squares of the missing forces, relative to that of the forces without friction"""
SWEEPS = 40
"""most projections of all contacts"""
SETTLED = 1e-9
"""sum of the squares of changes of s at which they end, relative to that of s"""
TINY = 1e-14
"""both, relative to the most that the contacts hold"""


class ColliderFriction(NamedTuple):
    """Coefficients of contacts with colliders (``effects.friction``)."""

    cloth: np.ndarray
    """index of each particle's cloth, shape (slots,)"""
    kinetic: np.ndarray
    """μ_k by cloth and collider, shape (cloths, capacity)"""
    static: np.ndarray | None
    """μ_s likewise; None where it is μ_k everywhere"""


class Sticks(NamedTuple):
    """What holds at contacts, by spring."""

    holds: np.ndarray
    """largest s at which it sticks [m], shape (springs,)"""
    slides: np.ndarray
    """s at which it slides [m], shape (springs,)"""
    normal: np.ndarray
    """n, shape (springs, 3)"""
    carried: np.ndarray
    """motion of the collider's surface [m], shape (springs, 3)"""
    slip: np.ndarray
    """s [m], shape (springs, 3)"""


def new_sticks(springs: int) -> Sticks:
    """Return storage for so many springs."""
    def vectors():
        return np.zeros((springs, 3))
    return Sticks(np.zeros(springs), np.zeros(springs), vectors(), vectors(), vectors())


@jit
def rub(squeeze, near, pairs, state):
    """Add the displacements by friction to ``moved``, and write them."""
    springs, sticks, count = squeeze.springs, squeeze.sticks, squeeze.stack.count[1]
    load_sticks(squeeze, near, pairs, state)
    size, most = stick(squeeze, count)
    step_towards_balance(springs, count, 3, SMALL * size + TINY * most)
    for a in range(3):
        for q in range(count):
            squeeze.start[q, a] = springs.x[a, q]
    for t in range(springs.count[0]):
        x, y, z = slipped(springs, sticks, squeeze.start, t)
        sticks.slip[t, 0], sticks.slip[t, 1], sticks.slip[t, 2] = shortened(
            -STICK * x, -STICK * y, -STICK * z, sticks.holds[t], sticks.slides[t])
    for t in range(springs.count[0]):
        s = sticks.slip[t]
        slide(springs, squeeze.moved, t, (s[0], s[1], s[2]))
    for sweep in range(SWEEPS):
        changed = total = 0.0
        for n in range(springs.count[0]):
            t = n if sweep % 2 else springs.count[0] - 1 - n
            change, size = project(springs, sticks, squeeze.moved, t)
            changed, total = changed + change, total + size
        if changed <= SETTLED * total + TINY * most:
            break
    store_slips(squeeze, near, pairs)


@jit(inline=True)
def project(springs, sticks, v, t):
    """Project one contact of displacements v; return the squares of the change of s and of s."""
    if sticks.holds[t] <= 0.0:
        return 0.0, 0.0
    s, (x, y, z) = sticks.slip[t], slipped(springs, sticks, v, t)
    x, y, z = shortened(s[0] - x, s[1] - y, s[2] - z, sticks.holds[t], sticks.slides[t])
    dx, dy, dz = x - s[0], y - s[1], z - s[2]
    s[0], s[1], s[2] = x, y, z
    slide(springs, v, t, (dx, dy, dz))
    return dx * dx + dy * dy + dz * dz, x * x + y * y + z * z


@jit(inline=True)
def slide(springs, v, t, s):
    """Add w b s / W to the displacements v of the particles of a contact."""
    i, w, per = springs.ends[t], springs.weight[t], springs.stiffness[t] / STICK
    for e in range(4):
        mass = springs.mass[i[e]]
        share = per * w[e] / mass if mass > 0.0 else 0.0
        for a in range(3):
            v[i[e], a] += share * s[a]


@jit
def load_sticks(squeeze, near, pairs, state):
    """Replace the springs by the contacts that push, in order; others have no friction."""
    contacts, stack, springs = squeeze.contacts, squeeze.stack, squeeze.springs
    springs.count[0] = 0
    for q in range(stack.count[1]):
        k = last_candidate(contacts, near.slot[stack.particles[q]])
        while k >= 0:
            n, way, t = contacts.normal[k], surface_motion(contacts, k, state), springs.count[0]
            contacts.slip[k, 0] = contacts.slip[k, 1] = contacts.slip[k, 2] = 0.0
            if contacts.push[k] > 0.0:
                for p in range(4):
                    springs.ends[t, p], springs.weight[t, p] = q, 0.0
                springs.weight[t, 0] = 1.0
                holds, slides = of_collider(squeeze.friction, contacts, k)
                add_stick(squeeze, springs.mass[q], contacts.push[k], holds, slides,
                          (n[0], n[1], n[2]), (way[0] - near.step[0], way[1] - near.step[1],
                                               way[2] - near.step[2]))
            k = contacts.earlier[k]
    for m in range(stack.count[0]):
        k, n, t = stack.pairs[m], pairs.normal, springs.count[0]
        if pairs.push[k] > 0.0:
            for p in range(4):
                i = pairs.particles[p, k]
                used = i < len(near.slot) and pairs.weight[p, k] != 0.0
                springs.ends[t, p] = stack.place[i] if used else 0
                springs.weight[t, p] = pairs.weight[p, k] if used else 0.0
            mu = of_pair(pairs.friction, k)
            add_stick(squeeze, 1.0 / mobility_of_pair(near, pairs, k), pairs.push[k], mu, mu,
                      (n[0, k], n[1, k], n[2, k]), (0.0, 0.0, 0.0))


@jit(inline=True)
def add_stick(squeeze, per, push, holds, slides, n, carried):
    """Add that of one contact; ``per`` is 1 / W."""
    springs, sticks, t = squeeze.springs, squeeze.sticks, squeeze.springs.count[0]
    springs.count[0] += 1
    springs.stiffness[t] = STICK * per
    sticks.holds[t], sticks.slides[t] = holds * push, slides * push
    for a in range(3):
        sticks.normal[t, a], sticks.carried[t, a] = n[a], carried[a]


@jit(inline=True)
def of_collider(friction, contacts, k):
    """Return μ_s and μ_k of candidate k; 0 without friction."""
    if friction is None:
        return 0.0, 0.0
    else:    # Numba prunes the branch that is not taken
        a, c = friction.cloth[contacts.particle[k]], contacts.collider[k]
        return static_of(friction.static, friction.kinetic, a, c), friction.kinetic[a, c]


@jit(inline=True)
def static_of(static, kinetic, a, c):
    """Return μ_s of cloth a and collider c."""
    if static is None:
        return kinetic[a, c]
    else:    # Numba prunes the branch that is not taken
        return static[a, c]


@jit(inline=True)
def of_pair(friction, k):
    """Return μ of pair k in this substep; 0 without friction."""
    if friction is None:
        return 0.0
    else:    # Numba prunes the branch that is not taken
        return chosen_of(friction.coefficient, friction.slides, k)


@jit(inline=True)
def chosen_of(chosen, kinetic, k):
    """Return μ_s or μ_k of pair k."""
    if chosen is None:
        return float(kinetic[k])
    else:    # Numba prunes the branch that is not taken
        return float(chosen[k])


@jit
def stick(squeeze, count):
    """
    Let all contacts stick, and write the missing forces.

    Return the sums of squares of the forces without friction, and of what the contacts hold.
    """
    springs, sticks, size, most = squeeze.springs, squeeze.sticks, 0.0, 0.0
    begin_balance(springs, count, 3)
    for q in range(count):
        for a in range(3):
            springs.x[a, q] = squeeze.start[q, a]
            force = springs.mass[q] * (squeeze.moved[q, a] - springs.x[a, q])
            springs.missing[a, q] = force
            size += force * force
    for t in range(springs.count[0]):
        if sticks.holds[t] > 0.0:
            let_act(springs, t)
            k, (x, y, z) = springs.stiffness[t], slipped(springs, sticks, squeeze.start, t)
            add_force(springs, t, -k * x, springs.missing[0])
            add_force(springs, t, -k * y, springs.missing[1])
            add_force(springs, t, -k * z, springs.missing[2])
            most += sticks.holds[t]**2
    free(springs, springs.missing, count, 3)
    return size, most


@jit(inline=True)
def slipped(springs, sticks, v, t):
    """Return Δ of a contact at displacements v [m]."""
    n, way, i, w = sticks.normal[t], sticks.carried[t], springs.ends[t], springs.weight[t]
    p, q, r, s = v[i[0]], v[i[1]], v[i[2]], v[i[3]]
    x = w[0] * p[0] + w[1] * q[0] + w[2] * r[0] + w[3] * s[0] - way[0]
    y = w[0] * p[1] + w[1] * q[1] + w[2] * r[1] + w[3] * s[1] - way[1]
    z = w[0] * p[2] + w[1] * q[2] + w[2] * r[2] + w[3] * s[2] - way[2]
    along = n[0] * x + n[1] * y + n[2] * z
    return x - along * n[0], y - along * n[1], z - along * n[2]


@jit
def store_slips(squeeze, near, pairs):
    """Write the displacements by friction."""
    contacts, stack, slip, t = squeeze.contacts, squeeze.stack, squeeze.sticks.slip, 0
    for q in range(stack.count[1]):
        k = last_candidate(contacts, near.slot[stack.particles[q]])
        while k >= 0:
            if contacts.push[k] > 0.0:
                for a in range(3):
                    contacts.slip[k, a] = slip[t, a]
                t += 1
            k = contacts.earlier[k]
    for m in range(stack.count[0]):
        if pairs.push[stack.pairs[m]] > 0.0:
            set_slip(pairs.friction, stack.pairs[m], (slip[t, 0], slip[t, 1], slip[t, 2]))
            t += 1


@jit(inline=True)
def set_slip(friction, k, s):
    """Write s of pair k."""
    if friction is not None:
        friction.slip[0, k], friction.slip[1, k], friction.slip[2, k] = s


@jit(inline=True)
def slip_of(friction, k):
    """Return s of pair k [m]; 0 without friction."""
    if friction is None:
        return 0.0, 0.0, 0.0
    else:    # Numba prunes the branch that is not taken
        s = friction.slip
        return float(s[0, k]), float(s[1, k]), float(s[2, k])
