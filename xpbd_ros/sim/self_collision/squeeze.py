"""
Squeeze: three and more layers of cloth between two pads press on one another, and rub.

Pair contacts and contacts alternate, and one turn transmits only about 1 / κ of the force between
pads (κ: ``contact.pads``). Two layers have the Schur complement of the pads
(``self_collision.backing``); the inner ones of more have no pad behind them. So with such, the
pairs between two pads (``self_collision.stacks``) and the colliders about them are solved
together, with inertia, after these turns. With y where a particle would be without their pushes
and friction, m its mobility and a the axis of the stack, the mean of the normals of the pads that
back it from both sides, x = y + a u minimises

    E(u) = Σ u² / (2 m) + Σ κ / (2 m) max(0, r - φ(x))² + Σ k / (2 W) max(0, -C)²

over particles, their colliders, and pairs. d = κ max(0, r - φ) and d = -k C are the pushes. The
stiffness of pairs, k = STIFFER (1 + κ), is that of the cloth's thickness; n layers so yield up to
about n / (4 STIFFER) more than the pads alone. Newton's method starts where the pads carried the
particles from the substep's start, with the pairs that touch there.

Friction (``squeeze_friction``) follows with these pushes.

What pushes do not balance moves no particle: pads bear it as an impulse. That is what Newton's
method leaves, and the part of pushes across the axis, at the edges of fingers. In the same turn,
pads do not press these particles again: alone, without the pushes of pairs, that would move them.

Limits: normals that differ by more than 25° are not of one stack. Layers between a pad and a rigid
collider are not solved so, nor stacks near one, since the solve has only contacts along its axis,
and none while cloth is so deep in a pad that it meets it as rigid.
"""

import copy
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.collider_motion import surface_motion
from xpbd_ros.sim.contact.contacts import Contacts
from xpbd_ros.sim.contact.corners import add_later, contact_distance
from xpbd_ros.sim.contact.pads import meets_pad, without_pushes
from xpbd_ros.sim.particles.history import weights_before
from xpbd_ros.sim.self_collision.backing import last_candidate, TURNS
from xpbd_ros.sim.self_collision.neighbour_list import INV_MASS, load_move, store_move
from xpbd_ros.sim.self_collision.springs import (
    add_force,
    begin_balance,
    dot,
    free,
    let_act,
    new_springs,
    Springs,
    step_towards_balance,
    stretch,
    take_back_half,
)
from xpbd_ros.sim.self_collision.squeeze_friction import (
    ColliderFriction,
    new_sticks,
    rub,
    set_slip,
    slip_of,
    Sticks,
)
from xpbd_ros.sim.self_collision.stacks import (
    list_stack,
    mobility_of_pair,
    new_stack,
    PARALLEL,
    Stack,
)

STIFFER = 40.0
"""stiffness of a pair, relative to that of the stiffest pad that backs it"""
STIFFEST = 1e5
"""largest κ, that of rigid colliders too: the contacts themselves are solved again"""
STEPS, FULL = 60, 30
"""most steps of Newton's method, and those before it halves a step that raises E"""
SMALL = 1e-8
"""sum of the squares of the missing forces, relative to that of the colliders' forces"""
INEXACT = 1e-4
"""that to which a linear solve reduces it, relative to that before"""
TOUCH = 0.02
"""distance up to which pairs touch in the first step, relative to the thickness"""


class Squeeze(NamedTuple):
    """Layers between pads."""

    contacts: Contacts
    """contacts with colliders, with pads"""
    stack: Stack
    springs: Springs
    """those of colliders first, in the order of particles and candidates, then those of pairs"""
    lack: np.ndarray
    """r - φ or -C at y [m], shape (springs,)"""
    y: np.ndarray
    """displacement without pushes and friction [m], by place; shape (particles, 3)"""
    u: np.ndarray
    """motion along the axis, with all pushes [m], shape (particles,)"""
    start: np.ndarray
    """displacement with the colliders [m], shape (particles, 3)"""
    given: np.ndarray
    """what pushes give of it, likewise"""
    moved: np.ndarray
    """displacement with pushes along the axis and friction, likewise"""
    sticks: Sticks
    friction: ColliderFriction | None
    """None in a scene without friction"""
    again: np.ndarray
    """True while stacks are solved, shape (1,)"""

    def in_use(self, other: 'Squeeze') -> tuple:
        """Return ``other`` without its working memory, which no substep leaves to the next."""
        return other.contacts, other.friction

    def __deepcopy__(self, memo: dict) -> 'Squeeze':
        """Return a copy; its working memory, which is large, is new."""
        made = new_squeeze(copy.deepcopy(self.contacts, memo), len(self.y),
                           len(self.stack.pairs))
        assert made is not None    # the colliders have pads
        return made._replace(friction=copy.deepcopy(self.friction, memo))


def new_squeeze(contacts: Contacts, particles: int, pairs: int) -> Squeeze | None:
    """Return storage for numbers of particles and of pairs; None in a scene without pads."""
    if contacts.pads is None:
        return None
    springs = pairs + len(contacts.push)

    def vectors():
        return np.zeros((particles, 3))
    return Squeeze(contacts, new_stack(particles, pairs), new_springs(springs, particles),
                   np.zeros(springs), vectors(), np.zeros(particles), vectors(), vectors(),
                   vectors(), new_sticks(springs), None, np.zeros(1, np.bool_))


@jit
def begin_squeeze(squeeze, near, pairs, thickness, turn):
    """List the stacks after the last turn of ``backing``; return True if there are any."""
    if squeeze is None:
        return False
    else:    # Numba prunes the branch that is not taken
        squeeze.again[0] = (turn == TURNS + 1 and not is_crushed(squeeze.contacts) and list_stack(
            squeeze.stack, squeeze.contacts, near, pairs, thickness)
            and not is_beside_rigid(squeeze, near))
        return squeeze.again[0]


@jit
def is_beside_rigid(squeeze, near):
    """Return True if a rigid collider is near a particle of a stack."""
    contacts, stack = squeeze.contacts, squeeze.stack
    for q in range(stack.count[1]):
        k = last_candidate(contacts, near.slot[stack.particles[q]])
        while k >= 0:
            if not contacts.pads.soft[k]:
                return True
            k = contacts.earlier[k]
    return False


@jit
def is_crushed(contacts):
    """Return True if a particle is so deep in a pad that it meets it as a rigid collider."""
    for k in range(contacts.count[0]):
        if (contacts.push[k] > 0.0 and not contacts.pads.soft[k]
                and contacts.colliders.stiffness[contacts.collider[k]] > 0.0):
            return True
    return False


@jit(inline=True)
def is_squeezed(squeeze):
    """Return True while stacks are solved."""
    if squeeze is None:
        return False
    else:    # Numba prunes the branch that is not taken
        return squeeze.again[0]


@jit
def solve_squeeze(squeeze, near, pairs, state, h):
    """Solve the stacks and the colliders about them; by one thread."""
    if squeeze is not None:
        stack, springs = squeeze.stack, squeeze.springs
        springs.count[0] = 0
        for q in range(stack.count[1]):
            load_move(near, state, stack.particles[q])
            release(squeeze, near, q)
        for m in range(stack.count[0]):
            add_pair(squeeze.y, stack, near, pairs, stack.pairs[m], -1.0)
        for q in range(stack.count[1]):
            add_colliders(squeeze, near, state, q)
        for m in range(stack.count[0]):
            add_pair_spring(squeeze, near, pairs, stack.pairs[m], state)
        minimise(squeeze, stack.count[1])
        store_pushes(squeeze, near, pairs)
        rub(squeeze, near, pairs, state)
        store_moves(squeeze, near, state, h)


@jit(inline=True)
def release(squeeze, near, q):
    """Write y of a particle, yet with what pairs give."""
    contacts, i = squeeze.contacts, squeeze.stack.particles[q]
    move, last = near.precise_move[i], last_candidate(contacts, near.slot[i])
    squeeze.springs.mass[q] = 1.0 / move[INV_MASS] if move[INV_MASS] > 0.0 else 0.0
    x, y, z = move[0], move[1], move[2]
    if last >= 0 and meets_pad(contacts.pads, contacts, last):
        x, y, z = without_pushes(contacts.pads, contacts, last, (x, y, z))
    k = last
    while k >= 0:
        d, n, s = contacts.push[k], contacts.normal[k], contacts.slip[k]
        if meets_pad(contacts.pads, contacts, last):
            d = 0.0
        x, y, z = x - d * n[0] - s[0], y - d * n[1] - s[1], z - d * n[2] - s[2]
        k = contacts.earlier[k]
    squeeze.y[q, 0], squeeze.y[q, 1], squeeze.y[q, 2] = x, y, z


@jit(inline=True)
def add_pair(ways, stack, near, pairs, k, sign):
    """Add ± w b (n d + s) / W of pair k to displacements of its particles, by place."""
    d, n, (x, y, z) = pairs.push[k], pairs.normal, slip_of(pairs.friction, k)
    per = sign / mobility_of_pair(near, pairs, k)
    x, y, z = per * (d * n[0, k] + x), per * (d * n[1, k] + y), per * (d * n[2, k] + z)
    for p in range(4):
        i = pairs.particles[p, k]
        if i < len(near.slot) and pairs.weight[p, k] != 0.0:
            q, share = stack.place[i], near.precise_move[i, INV_MASS] * pairs.weight[p, k]
            ways[q, 0] += share * x
            ways[q, 1] += share * y
            ways[q, 2] += share * z


@jit
def add_colliders(squeeze, near, state, q):
    """Write axis and start of a particle, and add the springs of its colliders."""
    contacts, springs, i = squeeze.contacts, squeeze.springs, squeeze.stack.particles[q]
    y, axis = squeeze.y[q], springs.axis[q]
    u = begin_particle(squeeze, near, state, q, i)
    at = (near.x[i, 0] + near.step[0] + y[0] + u * axis[0],
          near.x[i, 1] + near.step[1] + y[1] + u * axis[1],
          near.x[i, 2] + near.step[2] + y[2] + u * axis[2])
    k = last_candidate(contacts, near.slot[i])
    while k >= 0:
        phi, n = contact_distance(contacts, k, at[0], at[1], at[2])
        contacts.normal[k, 0], contacts.normal[k, 1], contacts.normal[k, 2] = n
        t, along = springs.count[0], n[0] * axis[0] + n[1] * axis[1] + n[2] * axis[2]
        springs.count[0] += 1
        for p in range(4):
            springs.ends[t, p], springs.weight[t, p] = q, 0.0
        springs.weight[t, 0] = along
        springs.stiffness[t] = 0.0
        if abs(along) > PARALLEL:    # others push it when it is solved alone again
            springs.stiffness[t] = springs.mass[q] * ratio_of(contacts, k, state)
        squeeze.lack[t] = contacts.gap[k] - phi + along * u
        k = contacts.earlier[k]


@jit(inline=True)
def begin_particle(squeeze, near, state, q, i):
    """Write axis and start of a particle; return u at the start."""
    contacts, stack, springs = squeeze.contacts, squeeze.stack, squeeze.springs
    ax = ay = az = x = y = z = 0.0
    sides = 0
    for side in range(2):
        k, sign = stack.behind[i, side], 1.0 - 2.0 * side
        if k >= 0:
            n, way = contacts.normal[k], surface_motion(contacts, k, state)
            ax, ay, az = ax + sign * n[0], ay + sign * n[1], az + sign * n[2]
            x, y, z, sides = x + way[0], y + way[1], z + way[2], sides + 1
    size, share = sqrt(ax * ax + ay * ay + az * az), 1.0 / max(1, sides)
    if size > 0.0:
        ax, ay, az = ax / size, ay / size, az / size
    x, y, z = share * x - near.step[0], share * y - near.step[1], share * z - near.step[2]
    if springs.mass[q] == 0.0:
        x, y, z = squeeze.y[q, 0], squeeze.y[q, 1], squeeze.y[q, 2]
    springs.axis[q, 0], springs.axis[q, 1], springs.axis[q, 2] = ax, ay, az
    squeeze.start[q, 0], squeeze.start[q, 1], squeeze.start[q, 2] = x, y, z
    free_y = squeeze.y[q]
    springs.x[0, q] = ax * (x - free_y[0]) + ay * (y - free_y[1]) + az * (z - free_y[2])
    return springs.x[0, q]


@jit(inline=True)
def ratio_of(contacts, k, state):
    """Return κ of candidate k."""
    c, i = contacts.collider[k], contacts.particle[k]
    if contacts.pads.soft[k]:
        return min(STIFFEST,
                   state.mobility[i] * contacts.pads.area[i] * contacts.colliders.stiffness[c])
    return STIFFEST


@jit(inline=True)
def add_pair_spring(squeeze, near, pairs, k, state):
    """Add the spring of pair k."""
    stack, springs = squeeze.stack, squeeze.springs
    n, t, ratio, lack = pairs.normal, springs.count[0], 0.0, float(pairs.deficit[k])
    springs.count[0] += 1
    for p in range(4):
        i, b = pairs.particles[p, k], float(pairs.weight[p, k])
        springs.ends[t, p], springs.weight[t, p] = 0, 0.0
        if i < len(near.slot) and b != 0.0:
            q = stack.place[i]
            y, axis = squeeze.y[q], springs.axis[q]
            lack -= b * (n[0, k] * y[0] + n[1, k] * y[1] + n[2, k] * y[2])
            springs.ends[t, p] = q
            springs.weight[t, p] = b * (n[0, k] * axis[0] + n[1, k] * axis[1] + n[2, k] * axis[2])
            ratio = max(ratio, stiffest_behind(squeeze, i, state))
    springs.stiffness[t] = STIFFER * (1.0 + ratio) / mobility_of_pair(near, pairs, k)
    squeeze.lack[t] = lack


@jit(inline=True)
def stiffest_behind(squeeze, i, state):
    """Return the largest κ of the pads that back particle i."""
    contacts, stack, most = squeeze.contacts, squeeze.stack, 0.0
    for side in range(2):
        k = stack.behind[i, side]
        if k >= 0:
            most = max(most, ratio_of(contacts, k, state))
    return most


@jit
def minimise(squeeze, count):
    """Minimise E by Newton's method."""
    springs = squeeze.springs
    energy, size = balance(squeeze, count, TOUCH * squeeze.contacts.thickness[0])
    for n in range(STEPS):
        missing = dot(springs.missing, springs.missing, count, 1)
        if missing <= SMALL * size:
            break
        step_towards_balance(springs, count, 1, max(INEXACT * missing, 0.1 * SMALL * size))
        before, (energy, size) = energy, balance(squeeze, count, 0.0)
        while n >= FULL and energy > before and dot(springs.step, springs.step, count, 1) > 0.0:
            take_back_half(springs, count)
            energy, size = balance(squeeze, count, 0.0)


@jit
def balance(squeeze, count, touch):
    """
    Write the missing forces and which springs act; return E and the squares of pads' forces.

    Springs act where they lack more than -touch; those that lack nothing then pull.
    """
    springs, energy, size = squeeze.springs, 0.0, 0.0
    begin_balance(springs, count, 1)
    for q in range(count):
        springs.missing[0, q] = -springs.mass[q] * springs.x[0, q]
        energy += 0.5 * springs.mass[q] * springs.x[0, q]**2
    for t in range(springs.count[0]):
        lack, k = squeeze.lack[t] - stretch(springs, t, springs.x[0]), springs.stiffness[t]
        if lack > -touch and k > 0.0:
            let_act(springs, t)
            add_force(springs, t, k * lack, springs.missing[0])
            energy += 0.5 * k * lack * lack
            if t < springs.count[0] - squeeze.stack.count[0]:
                size += (k * lack)**2
    free(springs, springs.missing, count, 1)
    return energy, size


@jit
def store_pushes(squeeze, near, pairs):
    """Write the pushes, what they give, and ``moved``, y + a u; there is no friction yet."""
    contacts, stack, springs = squeeze.contacts, squeeze.stack, squeeze.springs
    pads, given, t = contacts.pads, squeeze.given, 0
    for q in range(stack.count[1]):
        last = last_candidate(contacts, near.slot[stack.particles[q]])
        soft, k, x, y, z = last >= 0 and meets_pad(pads, contacts, last), last, 0.0, 0.0, 0.0
        while k >= 0:
            n, d = contacts.normal[k], 0.0
            if springs.mass[q] > 0.0:
                d = push_of(squeeze, t) / springs.mass[q]
            contacts.push[k] = d
            if soft:
                pads.given[k] = d
            x, y, z, t = x + d * n[0], y + d * n[1], z + d * n[2], t + 1
            k = contacts.earlier[k]
        if soft:
            pads.shift[last, 0], pads.shift[last, 1], pads.shift[last, 2] = x, y, z
        given[q, 0], given[q, 1], given[q, 2] = x, y, z
        for a in range(3):
            squeeze.moved[q, a] = squeeze.y[q, a] + springs.x[0, q] * springs.axis[q, a]
        squeeze.u[q] = springs.x[0, q]
    for m in range(stack.count[0]):
        k = stack.pairs[m]
        pairs.push[k] = push_of(squeeze, t + m) * mobility_of_pair(near, pairs, k)
        set_slip(pairs.friction, k, (0.0, 0.0, 0.0))
        add_pair(given, stack, near, pairs, k, 1.0)


@jit(inline=True)
def push_of(squeeze, t):
    """Return the force of spring t."""
    return squeeze.springs.stiffness[t] * max(
        0.0, squeeze.lack[t] - stretch(squeeze.springs, t, squeeze.springs.x[0]))


@jit
def store_moves(squeeze, near, state, h):
    """Write the displacements; colliders bear what pushes do not explain of y + a u."""
    stack, contacts, axis = squeeze.stack, squeeze.contacts, squeeze.springs.axis
    for q in range(stack.count[1]):
        i, moved, given = stack.particles[q], squeeze.moved[q], squeeze.given[q]
        if squeeze.springs.mass[q] > 0.0:
            j, a, u = near.slot[i], axis[q], squeeze.u[q]
            for e in range(3):
                near.precise_move[i, e] = near.move[i, e] = moved[e]
            per = h * weights_before(state.history, j)[0]**2 / state.mobility[j]
            book(stack, contacts, i, per * (u * a[0] - given[0]), per * (u * a[1] - given[1]),
                 per * (u * a[2] - given[2]))
            store_move(near, state, i)
            keep_pushes(contacts, last_candidate(contacts, j), state.mobility[j])
    contacts.count[5] = 1


@jit(inline=True)
def keep_pushes(contacts, last, m):
    """Let the pads of a particle of mobility m keep their pushes: they are solved."""
    pads, k = contacts.pads, last
    while k >= 0:
        pads.force[k] = contacts.push[k] / m
        pads.lost[k] = pads.ratio[k] / (1.0 + pads.ratio[k])
        k = contacts.earlier[k]
    if last >= 0 and meets_pad(pads, contacts, last):
        pads.solved[last] = 1


@jit(inline=True)
def book(stack, contacts, i, x, y, z):
    """Let the pads that back particle i bear an impulse on it [N s]."""
    behind = stack.behind[i]
    share = 0.5 if behind[0] >= 0 and behind[1] >= 0 else 1.0
    for side in range(2):
        if behind[side] >= 0:
            add_later(contacts, behind[side], share * x, share * y, share * z)
