"""
Friction of squeezed layers (``squeeze``), with the pushes d of pairs and contacts.

With v the displacements in a substep across the axis of the stack, y those without friction, and
Δ the motion Σ b v of a pair across the axis, or v less that of a collider's surface, all contacts
stick at first: v minimises

    Σ |v - y|² / (2 m) + Σ STICK |Δ|² / (2 W)        (W = m for a contact with a pad)

and s = -STICK Δ. Then s is shortened to the friction cone, and Gauss-Seidel sweeps project the
contacts until they stick, or slide at the limit of friction:

    s <- s - Δ, shortened to μ d,   x += w b (change of s) / W

So layers that stick need one linear solve, however many they are. Friction does not act along the
axis: that of tilted contacts would move particles into the pads there, unopposed.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.collider_motion import surface_motion
from xpbd_ros.sim.contact.contacts import shortened
from xpbd_ros.sim.contact.friction_limits import limits
from xpbd_ros.sim.self_collision.pair_contacts import coefficients
from xpbd_ros.sim.self_collision.springs import (
    activate,
    add_force,
    begin_residual,
    conjugate_gradients,
    constrain,
)
from xpbd_ros.sim.self_collision.stacks import last_candidate, mobility_of_pair, pair_of

STICK = 1e5
"""displacement by friction of a contact that sticks, relative to its tangential motion"""
SMALL = 1e-6
"""squared norm of the residual of the linear solve, relative to that of the inertia forces"""
SWEEPS = 40
"""most Gauss-Seidel sweeps"""
SETTLED = 1e-9
"""squared norm of the change of s at convergence, relative to that of s"""
TINY = 1e-14
"""both, relative to the squared norm of the limits of friction"""


class FrictionalContacts(NamedTuple):
    """Limits and state of the friction of contacts, by spring."""

    holds: np.ndarray
    """μ_s d, the largest s at which a contact sticks [m], shape (springs,)"""
    slides: np.ndarray
    """μ_k d, s at which it slides [m], shape (springs,)"""
    axis: np.ndarray
    """axis of the stack at the contact, shape (springs, 3)"""
    carried: np.ndarray
    """motion of the pad's surface [m], shape (springs, 3)"""
    slip: np.ndarray
    """s, displacement by friction [m], shape (springs, 3)"""


def new_frictional_contacts(springs: int) -> FrictionalContacts:
    """Return storage for so many springs."""
    def vectors():
        return np.zeros((springs, 3))
    return FrictionalContacts(np.zeros(springs), np.zeros(springs), vectors(), vectors(),
                              vectors())


@jit
def add_friction(squeeze, near, pairs, state):
    """Solve friction; add the displacements by it to ``moved``, and store them."""
    springs, frictional, count = squeeze.springs, squeeze.frictional, squeeze.stack.count[1]
    load_sticks(squeeze, near, pairs, state)
    size, most = begin_sticking(squeeze, count)
    conjugate_gradients(springs, count, 3, SMALL * size + TINY * most)
    for a in range(3):
        for q in range(count):
            squeeze.start[q, a] = springs.x[a * count + q]
    for t in range(springs.count[0]):
        x, y, z = tangential_motion(springs, frictional, squeeze.start, t)
        frictional.slip[t, 0], frictional.slip[t, 1], frictional.slip[t, 2] = shortened(
            -STICK * x, -STICK * y, -STICK * z, frictional.holds[t], frictional.slides[t])
    for t in range(springs.count[0]):
        s = frictional.slip[t]
        add_slip(springs, squeeze.moved, t, (s[0], s[1], s[2]))
    for sweep in range(SWEEPS):
        changed = total = 0.0
        for n in range(springs.count[0]):
            t = n if sweep % 2 else springs.count[0] - 1 - n
            change, size = project(springs, frictional, squeeze.moved, t)
            changed, total = changed + change, total + size
        if changed <= SETTLED * total + TINY * most:
            break
    store_slips(squeeze, near, pairs)


@jit(inline=True)
def project(springs, frictional, v, t):
    """Project a contact at displacements v; return the squared norms of the change of s, of s."""
    if frictional.holds[t] <= 0.0:
        return 0.0, 0.0
    s, (x, y, z) = frictional.slip[t], tangential_motion(springs, frictional, v, t)
    x, y, z = shortened(s[0] - x, s[1] - y, s[2] - z, frictional.holds[t], frictional.slides[t])
    dx, dy, dz = x - s[0], y - s[1], z - s[2]
    s[0], s[1], s[2] = x, y, z
    add_slip(springs, v, t, (dx, dy, dz))
    return dx * dx + dy * dy + dz * dz, x * x + y * y + z * z


@jit(inline=True)
def add_slip(springs, v, t, s):
    """Add w b s / W, across their axes, to the displacements v of the particles of a contact."""
    i, w, per = springs.ends[t], springs.weight[t], springs.stiffness[t] / STICK
    for e in range(4):
        mass, axis = springs.mass[i[e]], springs.axis[i[e]]
        share = per * w[e] / mass if mass > 0.0 else 0.0
        along = s[0] * axis[0] + s[1] * axis[1] + s[2] * axis[2]
        for a in range(3):
            v[i[e], a] += share * (s[a] - along * axis[a])


@jit
def load_sticks(squeeze, near, pairs, state):
    """Replace the springs by those of the contacts and pairs that push."""
    contacts, stack, springs = squeeze.contacts, squeeze.stack, squeeze.springs
    springs.count[0] = 0
    for q in range(stack.count[1]):
        k = last_candidate(contacts, near.slot[stack.particles[q]])
        while k >= 0:
            way, t = surface_motion(contacts, k, state), springs.count[0]
            contacts.slip[k, 0] = contacts.slip[k, 1] = contacts.slip[k, 2] = 0.0
            if contacts.push[k] > 0.0:
                for p in range(4):
                    springs.ends[t, p], springs.weight[t, p] = q, 0.0
                springs.weight[t, 0] = 1.0
                add_contact(squeeze, springs.mass[q], limits_of(squeeze.friction, k), q,
                            (way[0] - near.step[0], way[1] - near.step[1],
                             way[2] - near.step[2]))
            k = contacts.earlier[k]
    for m in range(stack.count[0]):
        k, t, first = pair_of(stack, m), springs.count[0], 0
        if pairs.push[k] > 0.0:
            for p in range(4):
                i = pairs.particles[p, k]
                used = i < len(near.slot) and pairs.weight[p, k] != 0.0
                springs.ends[t, p] = stack.place[i] if used else 0
                springs.weight[t, p] = pairs.weight[p, k] if used else 0.0
                if abs(springs.weight[t, p]) > abs(springs.weight[t, first]):
                    first = p
            most = of_pair(pairs.friction, k) * pairs.push[k]
            add_contact(squeeze, 1.0 / mobility_of_pair(near, pairs, k), (most, most),
                        springs.ends[t, first], (0.0, 0.0, 0.0))


@jit(inline=True)
def add_contact(squeeze, per, most, q, carried):
    """
    Add the spring of one contact, across the axis of the particle in place q.

    ``per`` is 1 / W, and ``most`` are μ_s d and μ_k d.
    """
    springs, frictional, t = squeeze.springs, squeeze.frictional, squeeze.springs.count[0]
    springs.count[0] += 1
    springs.stiffness[t] = STICK * per
    frictional.holds[t], frictional.slides[t] = most
    for a in range(3):
        frictional.axis[t, a], frictional.carried[t, a] = springs.axis[q, a], carried[a]


@jit(inline=True)
def limits_of(friction, k):
    """Return μ_s d and μ_k d of candidate k [m]; 0 without friction."""
    if friction is None:
        return 0.0, 0.0
    else:    # Numba prunes the branch that is not taken
        return limits(friction, k)


@jit(inline=True)
def of_pair(friction, k):
    """Return μ of pair k in this substep; 0 without friction."""
    if friction is None:
        return 0.0
    else:    # Numba prunes the branch that is not taken
        return float(coefficients(friction.coefficient, friction.slides)[k])


@jit
def begin_sticking(squeeze, count):
    """
    Write the residual with springs in all contacts that have friction.

    Return the squared norms of the inertia forces, and of the limits of friction.
    """
    springs, frictional, size, most = squeeze.springs, squeeze.frictional, 0.0, 0.0
    begin_residual(springs, count, 3)
    for q in range(count):
        for a in range(3):
            springs.x[a * count + q] = squeeze.start[q, a]
            force = springs.mass[q] * (squeeze.moved[q, a] - springs.x[a * count + q])
            springs.residual[a * count + q] = force
            size += force * force
    for t in range(springs.count[0]):
        if frictional.holds[t] > 0.0:
            activate(springs, t)
            k = springs.stiffness[t]
            x, y, z = tangential_motion(springs, frictional, squeeze.start, t)
            add_force(springs, t, -k * x, springs.residual, 0)
            add_force(springs, t, -k * y, springs.residual, count)
            add_force(springs, t, -k * z, springs.residual, 2 * count)
            most += frictional.holds[t]**2
    constrain(springs, springs.residual, count, 3)
    return size, most


@jit(inline=True)
def tangential_motion(springs, frictional, v, t):
    """Return Δ of a contact at displacements v [m]."""
    a, way, i, w = frictional.axis[t], frictional.carried[t], springs.ends[t], springs.weight[t]
    p, q, r, s = v[i[0]], v[i[1]], v[i[2]], v[i[3]]
    x = w[0] * p[0] + w[1] * q[0] + w[2] * r[0] + w[3] * s[0] - way[0]
    y = w[0] * p[1] + w[1] * q[1] + w[2] * r[1] + w[3] * s[1] - way[1]
    z = w[0] * p[2] + w[1] * q[2] + w[2] * r[2] + w[3] * s[2] - way[2]
    along = a[0] * x + a[1] * y + a[2] * z
    return x - along * a[0], y - along * a[1], z - along * a[2]


@jit
def store_slips(squeeze, near, pairs):
    """Write the displacements by friction."""
    contacts, stack, slip, t = squeeze.contacts, squeeze.stack, squeeze.frictional.slip, 0
    for q in range(stack.count[1]):
        k = last_candidate(contacts, near.slot[stack.particles[q]])
        while k >= 0:
            if contacts.push[k] > 0.0:
                for a in range(3):
                    contacts.slip[k, a] = slip[t, a]
                t += 1
            k = contacts.earlier[k]
    for m in range(stack.count[0]):
        if pairs.push[pair_of(stack, m)] > 0.0:
            set_slip(pairs.friction, pair_of(stack, m), (slip[t, 0], slip[t, 1], slip[t, 2]))
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
