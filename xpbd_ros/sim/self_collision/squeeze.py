"""
Squeeze: normal forces and friction of layers of cloth between a pad and another collider.

Pair contacts and contacts alternate, and one turn transmits only about 1 / κ of the force between
pads (κ: ``contact.pads``). So the pairs between them (``self_collision.stacks``) and the contacts
of their particles with colliders are solved together, with inertia. With y where a particle would
be without these pushes and their friction, m its mobility and a the axis of the stack, the mean of
the normals of the colliders that back it from both sides, x = y + a u minimises

    E(u) = Σ u² / (2 m) + Σ κ / (2 m) max(0, r - φ(x))² + Σ k / (2 W) max(0, -C)²

over particles, their contacts, and pairs. d = κ max(0, r - φ) and d = -k C are the pushes. The
stiffness of pairs, k = STIFFER (1 + κ), is that of the cloth's thickness; n layers so yield up to
about n / (4 STIFFER) more than two pads alone, n / (2 STIFFER) more than one. Rigid colliders have
RIGID (1 + κ) for κ, that of the pad behind; more would take many steps. Newton's method starts
where the colliders carried the particles from the substep's start, with the pairs that touch
there. φ and C are linearised there too, and see no motion across the axis: elastic forces may
displace particles out of the grip in a sweep, but the pads hold them.

Friction (``squeeze_friction``) follows with these pushes.

The residual of Newton's method, and the components of pushes across the axis, as at the edges of
fingers, move no particle: the colliders take them as an impulse. Pads do not press these particles
again in this turn: without the pushes of pairs, that would move them. Rigid colliders off the axis
are projected after this.

Limit: normals that differ by more than 25° are not of one stack.
"""

import copy
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.contacts import Contacts
from xpbd_ros.sim.contact.corners import add_later
from xpbd_ros.sim.contact.pads import must_solve, without_pushes
from xpbd_ros.sim.particles.history import weights_before
from xpbd_ros.sim.self_collision.neighbour_list import INV_MASS, load_move, store_move
from xpbd_ros.sim.self_collision.springs import (
    activate,
    add_force,
    begin_residual,
    conjugate_gradients,
    constrain,
    dot,
    elongation,
    halve_step,
    new_springs,
    Springs,
)
from xpbd_ros.sim.self_collision.squeeze_friction import (
    add_friction,
    FrictionalContacts,
    new_frictional_contacts,
    set_slip,
    slip_of,
)
from xpbd_ros.sim.self_collision.stacks import (
    carried,
    last_candidate,
    mobility_of_pair,
    new_stack,
    pair_of,
    PARALLEL,
    Stack,
)

STIFFER = 40.0
"""stiffness of a pair, relative to that of the stiffest pad that backs it"""
RIGID = 400.0
"""κ of a rigid collider, relative to that of the pad behind"""
STIFFEST = 1e7
"""largest κ that counts"""
STEPS, FULL = 60, 30
"""most steps of Newton's method, and those before it halves a step that raises E"""
SMALL = 1e-8
"""squared norm of the residual at convergence, relative to that of the forces of contacts"""
INEXACT = 1e-4
"""that after a linear solve, relative to that before"""
TOUCH = 0.02
"""distance up to which pairs touch in the first step, relative to the thickness"""


class Squeeze(NamedTuple):
    """Layers between a pad and another collider."""

    contacts: Contacts
    """contacts with colliders, with pads"""
    stack: Stack
    springs: Springs
    """those of contacts first, in the order of particles and candidates, then those of pairs"""
    deficit: np.ndarray
    """r - φ or -C at y [m], shape (springs,)"""
    y: np.ndarray
    """displacement without pushes and friction [m], shape (particles, 3)"""
    u: np.ndarray
    """displacement along the axis due to all pushes [m], shape (particles,)"""
    start: np.ndarray
    """displacement if the particle moves with the colliders [m], shape (particles, 3)"""
    given: np.ndarray
    """sum of the displacements by pushes, Σ d n and Σ w b n d / W [m], likewise"""
    moved: np.ndarray
    """y + a u, with friction in the end [m], likewise"""
    frictional: FrictionalContacts
    friction: tuple | None
    """data of ``effects.friction``; None in a scene without friction"""
    again: np.ndarray
    """True in the further turn of an iteration, shape (1,)"""

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
    stack = new_stack(particles, pairs, len(contacts.colliders.shape))
    return Squeeze(contacts, stack, new_springs(springs, particles),
                   np.zeros(springs), vectors(), np.zeros(particles), vectors(), vectors(),
                   vectors(), new_frictional_contacts(springs), None, np.zeros(1, np.bool_))


@jit
def solve_squeeze(squeeze, near, pairs, state):
    """Solve one island of the stack and its contacts; by one thread."""
    stack, springs = squeeze.stack, squeeze.springs
    springs.count[0] = 0
    for q in range(stack.count[1]):
        load_move(near, state, stack.particles[q])
        set_axis(squeeze, near, state, q)
        add_colliders(squeeze, near, state, q)
    for n in range(stack.count[0]):
        replace_pair(squeeze, near, pairs, stack.pairs[n])
    begin_steps(squeeze, stack.count[1])
    for n in range(stack.count[0]):
        add_pair_spring(squeeze, near, pairs, pair_of(stack, n))
    minimise(squeeze, stack.count[1])
    store_pushes(squeeze, near, pairs)
    add_friction(squeeze, near, pairs, state)
    store_moves(squeeze, near, state)


@jit(inline=True)
def replace_pair(squeeze, near, pairs, m):
    """Remove the push and the friction of close pair m from y; place it at the substep's start."""
    close = squeeze.stack.close
    k = close.number[m]
    if pairs.push[k] > 0.0:
        add_pair_pushes(squeeze.y, near, pairs, squeeze.stack.place, k, -1.0)
    for a in range(3):
        pairs.normal[a, k] = close.normal[a, m]
    for p in range(4):
        pairs.weight[p, k] = close.weight[p, m]
    pairs.deficit[k] = close.deficit[m]
    pairs.overlap[k] = max(0.0, close.deficit[m])


@jit(inline=True)
def add_pair_pushes(displacement, near, pairs, place, k, sign):
    """Add ± w b (n d + s) / W of pair k to displacements of its particles, by place."""
    d, n, (x, y, z) = pairs.push[k], pairs.normal, slip_of(pairs.friction, k)
    per = sign / mobility_of_pair(near, pairs, k)
    x, y, z = per * (d * n[0, k] + x), per * (d * n[1, k] + y), per * (d * n[2, k] + z)
    for p in range(4):
        i = pairs.particles[p, k]
        if i < len(near.slot) and pairs.weight[p, k] != 0.0:
            q, share = place[i], near.precise_move[i, INV_MASS] * pairs.weight[p, k]
            displacement[q, 0] += share * x
            displacement[q, 1] += share * y
            displacement[q, 2] += share * z


@jit
def add_colliders(squeeze, near, state, q):
    """
    Write y of a particle, still with what pairs displaced it by, and add its contacts' springs.

    Their deficits are those where the colliders carried it.
    """
    contacts, springs, i = squeeze.contacts, squeeze.springs, squeeze.stack.particles[q]
    start, move, k = squeeze.start[q], near.precise_move[i], last_candidate(contacts, near.slot[i])
    x, y, z = move[0], move[1], move[2]
    if k >= 0:
        x, y, z = without_pushes(contacts.pads, contacts, k, (x, y, z))
    while k >= 0:
        (wx, wy, wz), phi, n = carried(contacts, k, state)
        phi += (n[0] * (start[0] + near.step[0] - wx) + n[1] * (start[1] + near.step[1] - wy)
                + n[2] * (start[2] + near.step[2] - wz))
        t, along, s = springs.count[0], along_axis(springs, q, n), contacts.slip[k]
        springs.count[0] += 1
        for p in range(4):
            springs.ends[t, p], springs.weight[t, p] = q, 0.0
        springs.weight[t, 0], springs.stiffness[t] = along, 0.0
        if abs(along) > PARALLEL:    # other pads push in the first turn alone
            springs.stiffness[t] = springs.mass[q] * ratio_of(squeeze, k, i)
        squeeze.deficit[t] = contacts.gap[k] - phi
        contacts.normal[k, 0], contacts.normal[k, 1], contacts.normal[k, 2] = n
        x, y, z = x - s[0], y - s[1], z - s[2]
        k = contacts.earlier[k]
    squeeze.y[q, 0], squeeze.y[q, 1], squeeze.y[q, 2] = x, y, z


@jit(inline=True)
def along_axis(springs, q, n):
    """Return n · a of a particle."""
    return n[0] * springs.axis[q, 0] + n[1] * springs.axis[q, 1] + n[2] * springs.axis[q, 2]


@jit(inline=True)
def set_axis(squeeze, near, state, q):
    """Write mass, axis and start of a particle."""
    contacts, stack, springs = squeeze.contacts, squeeze.stack, squeeze.springs
    i = stack.particles[q]
    move = near.precise_move[i]
    springs.mass[q] = 1.0 / move[INV_MASS] if move[INV_MASS] > 0.0 else 0.0
    ax = ay = az = x = y = z = 0.0
    sides = 0
    for side in range(2):
        k, sign = stack.behind[i, side], 1.0 - 2.0 * side
        if k >= 0:
            way, _, n = carried(contacts, k, state)
            ax, ay, az = ax + sign * n[0], ay + sign * n[1], az + sign * n[2]
            x, y, z, sides = x + way[0], y + way[1], z + way[2], sides + 1
    size, share = sqrt(ax * ax + ay * ay + az * az), 1.0 / max(1, sides)
    if size > 0.0:
        ax, ay, az = ax / size, ay / size, az / size
    x, y, z = share * x - near.step[0], share * y - near.step[1], share * z - near.step[2]
    if springs.mass[q] == 0.0 or sides == 0:
        x, y, z = move[0], move[1], move[2]
    springs.axis[q, 0], springs.axis[q, 1], springs.axis[q, 2] = ax, ay, az
    squeeze.start[q, 0], squeeze.start[q, 1], squeeze.start[q, 2] = x, y, z


@jit
def begin_steps(squeeze, count):
    """Write u where the colliders carried the particles, and the deficits of contacts at y."""
    springs = squeeze.springs
    for q in range(count):
        y, start = squeeze.y[q], squeeze.start[q]
        springs.x[q] = along_axis(
            springs, q, (start[0] - y[0], start[1] - y[1], start[2] - y[2]))
    for t in range(springs.count[0]):
        squeeze.deficit[t] += springs.weight[t, 0] * springs.x[springs.ends[t, 0]]


@jit(inline=True)
def ratio_of(squeeze, k, i):
    """Return κ of candidate k of particle i."""
    pads = squeeze.contacts.pads
    return min(pads.ratio[k], STIFFEST) if pads.soft[k] else RIGID * (
        1.0 + stiffest_behind(squeeze, i))


@jit(inline=True)
def add_pair_spring(squeeze, near, pairs, k):
    """Add the spring of pair k."""
    stack, springs = squeeze.stack, squeeze.springs
    n, t, ratio, deficit = pairs.normal, springs.count[0], 0.0, float(pairs.deficit[k])
    springs.count[0] += 1
    for p in range(4):
        i, b = pairs.particles[p, k], float(pairs.weight[p, k])
        springs.ends[t, p], springs.weight[t, p] = 0, 0.0
        if i < len(near.slot) and b != 0.0:
            q = stack.place[i]
            start, axis = squeeze.start[q], springs.axis[q]
            along = b * (n[0, k] * axis[0] + n[1, k] * axis[1] + n[2, k] * axis[2])
            deficit += along * springs.x[q] - b * (
                n[0, k] * start[0] + n[1, k] * start[1] + n[2, k] * start[2])
            springs.ends[t, p] = q
            springs.weight[t, p] = along
            ratio = max(ratio, stiffest_behind(squeeze, i))
    springs.stiffness[t] = STIFFER * (1.0 + ratio) / mobility_of_pair(near, pairs, k)
    squeeze.deficit[t] = deficit


@jit(inline=True)
def stiffest_behind(squeeze, i):
    """Return the largest κ of the pads that back particle i."""
    contacts, stack, most = squeeze.contacts, squeeze.stack, 0.0
    for side in range(2):
        k = stack.behind[i, side]
        if k >= 0 and contacts.pads.soft[k]:
            most = max(most, min(contacts.pads.ratio[k], STIFFEST))
    return most


@jit
def minimise(squeeze, count):
    """Minimise E by Newton's method."""
    springs = squeeze.springs
    energy, size = update_residual(squeeze, count, TOUCH * squeeze.contacts.thickness[0])
    for n in range(STEPS):
        now = dot(springs.residual, springs.residual, count)
        if now <= SMALL * size:
            break
        conjugate_gradients(springs, count, 1, max(INEXACT * now, 0.1 * SMALL * size))
        before, (energy, size) = energy, update_residual(squeeze, count, 0.0)
        while n >= FULL and energy > before and dot(springs.step, springs.step, count) > 0.0:
            halve_step(springs, count)
            energy, size = update_residual(squeeze, count, 0.0)


@jit
def update_residual(squeeze, count, touch):
    """
    Write the residual and the active springs; return E and the squared norm of contact forces.

    Springs with a deficit above -``touch`` are active; those with a negative one pull.
    """
    springs, energy, size = squeeze.springs, 0.0, 0.0
    begin_residual(springs, count, 1)
    for q in range(count):
        springs.residual[q] = -springs.mass[q] * springs.x[q]
        energy += 0.5 * springs.mass[q] * springs.x[q]**2
    for t in range(springs.count[0]):
        k = springs.stiffness[t]
        deficit = squeeze.deficit[t] - elongation(springs, t, springs.x, 0)
        if deficit > -touch and k > 0.0:
            activate(springs, t)
            add_force(springs, t, k * deficit, springs.residual, 0)
            energy += 0.5 * k * deficit * deficit
            if t < springs.count[0] - squeeze.stack.count[0]:
                size += (k * deficit)**2
    constrain(springs, springs.residual, count, 1)
    return energy, size


@jit
def store_pushes(squeeze, near, pairs):
    """Write the pushes, the displacements by them, and y + a u; there is no friction yet."""
    contacts, stack, springs = squeeze.contacts, squeeze.stack, squeeze.springs
    pads, given, t = contacts.pads, squeeze.given, 0
    for q in range(stack.count[1]):
        last = last_candidate(contacts, near.slot[stack.particles[q]])
        k, x, y, z = last, 0.0, 0.0, 0.0
        while k >= 0:
            n, d = contacts.normal[k], 0.0
            if springs.mass[q] > 0.0:
                d = push_of(squeeze, t) / springs.mass[q]
            contacts.push[k] = pads.given[k] = d
            x, y, z, t = x + d * n[0], y + d * n[1], z + d * n[2], t + 1
            k = contacts.earlier[k]
        if last >= 0:
            pads.shift[last, 0], pads.shift[last, 1], pads.shift[last, 2] = x, y, z
        given[q, 0], given[q, 1], given[q, 2] = x, y, z
        for a in range(3):
            squeeze.moved[q, a] = squeeze.y[q, a] + springs.x[q] * springs.axis[q, a]
        squeeze.u[q] = springs.x[q]
    for m in range(stack.count[0]):
        k = pair_of(stack, m)
        pairs.push[k] = push_of(squeeze, t + m) * mobility_of_pair(near, pairs, k)
        set_slip(pairs.friction, k, (0.0, 0.0, 0.0))
        add_pair_pushes(given, near, pairs, stack.place, k, 1.0)


@jit(inline=True)
def push_of(squeeze, t):
    """Return the force of spring t."""
    return squeeze.springs.stiffness[t] * max(
        0.0, squeeze.deficit[t] - elongation(squeeze.springs, t, squeeze.springs.x, 0))


@jit
def store_moves(squeeze, near, state):
    """Write displacements, and what the colliders keep."""
    stack = squeeze.stack
    for q in range(stack.count[1]):
        i, moved = stack.particles[q], squeeze.moved[q]
        if squeeze.springs.mass[q] > 0.0:
            j = near.slot[i]
            for e in range(3):
                near.precise_move[i, e] = near.move[i, e] = moved[e]
            store_move(near, state, i)
            keep_pushes(squeeze, i, j, state)


@jit
def press_colliders(squeeze, near, state, h):
    """Let the colliders take a u less what pushes displaced as an impulse; by one thread."""
    stack, contacts, springs = squeeze.stack, squeeze.contacts, squeeze.springs
    for q in range(stack.count[1]):
        if springs.mass[q] > 0.0:
            i, given, a, u = stack.particles[q], squeeze.given[q], springs.axis[q], squeeze.u[q]
            j = near.slot[i]
            per = h * weights_before(state.history, j)[0]**2 / state.mobility[j]
            add_reactions(stack, contacts, i, per * (u * a[0] - given[0]),
                          per * (u * a[1] - given[1]), per * (u * a[2] - given[2]))
    contacts.count[5] = 1


@jit(inline=True)
def keep_pushes(squeeze, i, j, state):
    """Store the forces on particle i, in slot j, which is solved in this turn."""
    contacts, pads = squeeze.contacts, squeeze.contacts.pads
    last = k = last_candidate(contacts, j)
    while k >= 0:
        ratio = ratio_of(squeeze, k, i)
        pads.force[k] = contacts.push[k] / state.mobility[j]
        pads.lost[k] = ratio / (1.0 + ratio)
        k = contacts.earlier[k]
    if last >= 0:
        pads.solved[last] = 1
        must_solve(pads, last)


@jit(inline=True)
def add_reactions(stack, contacts, i, x, y, z):
    """Add an impulse on particle i to the reactions of the colliders that back it [N s]."""
    behind = stack.behind[i]
    share = 0.5 if behind[0] >= 0 and behind[1] >= 0 else 1.0
    for side in range(2):
        if behind[side] >= 0:
            add_later(contacts, behind[side], share * x, share * y, share * z)
