"""
Backing: colliders behind two layers of cloth, so that these press on one another through pads.

Pair contacts and contacts alternate, and one turn transmits only about 1 / κ of the force between
pads (κ: ``contact.pads``). So where pads press, the inequalities are projected TURNS times more,
and pairs with colliders behind both sides are solved together with these; in further turns only
those pairs of which one collider is a pad (``self_collision.clamped_pairs``). With sums over the
colliders that touch a particle, along the normal n of the stiffest of them: those that a push
along b n_p is towards, b n_p·n_k < 0, and those that it is away from,

    κ_t = Σ_t κ_k (n·n_k)²,   κ_a = Σ_a κ_k (n·n_k)²,   κ = κ_t + min(κ_a, κ_t)
    s = κ / (1 + κ),   M = w (I - s n nᵀ)

replaces the inverse mass w, so that a pair of C (``pair_contacts``) with the normal n_p gets

    Δd = max(-C W / W_b, -d),   W = Σ w b²,   W_b = Σ b² n_pᵀ M n_p,   x += M b n_p Δd / W

That is the Schur complement of the contacts: s w b (n·n_p) Δd / W, which x lacks along n, is the
change of their push. Colliders that a push is away from yield as much as they pressed, and do not
pull: without others κ is 0, or overlapping layers on one rigid collider would be thrown off it.

Limits: κ counts as at most STIFFEST, that of rigid colliders too. Colliders whose normals are not
parallel take part with what acts along that of the stiffest. The inner ones of three and more
layers have no collider behind them; between two pads, ``squeeze`` solves these.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import absolute, both, either, fma, load, select
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import alone, turns
from xpbd_ros.sim.contact.contacts import Contacts
from xpbd_ros.sim.geometry.closest_points_simd import dot
from xpbd_ros.sim.self_collision.neighbour_list import INV_MASS

STIFFEST = 1e3
"""largest κ: in single precision, more would leave no digits of 1 - s"""
TURNS = 2
"""further turns of pair contacts and contacts in an iteration"""
OPPOSITE = 3
"""last column of the records: √s for pushes along n, relative to that for pushes against n"""
BESIDE, BESIDE_PAD = 1, 2
"""bits that tell that a collider, and that a pad, is near a particle"""


class ClampedPairs(NamedTuple):
    """
    Pairs with colliders near both sides, one of them a pad (``self_collision.clamped_pairs``).

    They and their particles take part in further turns.
    """

    part: np.ndarray
    """1 for such pairs, else 0, in groups that may have some; float32, shape (pairs,)"""
    groups: np.ndarray
    """True for groups that may have some, shape (pairs / PACK,)"""
    near: np.ndarray
    """BESIDE for particles near a collider, BESIDE | BESIDE_PAD near a pad; uint8, shape
    (particles + 1,)"""
    particles: np.ndarray
    """those of such pairs, shape (particles,)"""
    count: np.ndarray
    """their number, shape (1,)"""
    listed: np.ndarray
    """True for them, shape (particles + 1,)"""


class Backing(NamedTuple):
    """The colliders' part in pair contacts, by particle in natural order."""

    contacts: Contacts
    """contacts with colliders, with pads"""
    axis: np.ndarray
    """
    records √s n for pushes against n, and OPPOSITE, shape (particles + 1, 4): zero for particles
    without colliders behind them
    """
    held: np.ndarray
    """
    Σ √s w b n·v over impulses v, for displacements that colliders prevented: by pairs that push
    against n, and along n; shape (particles, 2)
    """
    behind: np.ndarray
    """1 for particles with colliders behind them, int32, shape (particles + 1,)"""
    turn: np.ndarray
    """number of the present turn; 0: the first, of all pairs; shape (1,)"""
    clamped: ClampedPairs


def new_backing(contacts: Contacts, particles: int, pairs: int) -> Backing | None:
    """Return storage for numbers of particles and of pairs; None in a scene without pads."""
    if contacts.pads is None:
        return None
    clamped = ClampedPairs(
        np.zeros(pairs, np.float32), np.zeros(pairs // PACK, np.bool_),
        np.zeros(particles + 1, np.uint8), np.zeros(particles, np.int64), np.zeros(1, np.int64),
        np.zeros(particles + 1, np.bool_))
    return Backing(contacts, np.zeros((particles + 1, 4), np.float32), np.zeros((particles, 2)),
                   np.zeros(particles + 1, np.int32), np.zeros(1, np.int64), clamped)


@jit(inline=True)
def stiffness_ratio(contacts, k):
    """Return κ of candidate k; 0 if it does not touch."""
    if contacts.push[k] > 0.0:
        return min(contacts.pads.ratio[k], STIFFEST) if contacts.pads.soft[k] else STIFFEST
    return 0.0


@jit(inline=True)
def last_candidate(contacts, j):
    """Return the last candidate of the particle in slot j, -1: none."""
    k = contacts.latest[j]
    return k if k < contacts.count[0] and contacts.particle[k] == j else -1


@jit
def stiffest(contacts, last):
    """
    Return the stiffest collider that touches a particle, and κ_k along its normal n, summed.

    ``last`` is the particle's last candidate, or -1. The sums are those with n·n_k > 0, and the
    others. Without such a collider: -1, 0, 0.
    """
    best, most, front, back, k = -1, 0.0, 0.0, 0.0, last
    while k >= 0:
        ratio = stiffness_ratio(contacts, k)
        if ratio > most:
            best, most = k, ratio
        k = contacts.earlier[k]
    k = last
    while k >= 0 and best >= 0:
        part = along(contacts, k, best)
        if part > 0.0:
            front += stiffness_ratio(contacts, k) * part**2
        else:
            back += stiffness_ratio(contacts, k) * part**2
        k = contacts.earlier[k]
    return best, front, back


@jit(inline=True)
def along(contacts, k, best):
    """Return n·n_k."""
    n = contacts.normal
    return n[k, 0] * n[best, 0] + n[k, 1] * n[best, 1] + n[k, 2] * n[best, 2]


@jit
def load_backing(team, backing, slot):
    """Write the records of all particles, from the contacts of the last turn."""
    if backing is not None:
        if alone(team):
            backing.contacts.pads.again[0] = True
        first, end, step = turns(team, len(slot))
        for i in range(first, end, step):
            load_axis(backing, slot, i)


@jit(inline=True)
def load_axis(backing, slot, i):
    """Write the record of one particle."""
    axis, contacts = backing.axis, backing.contacts
    best, front, back, last = -1, 0.0, 0.0, last_candidate(contacts, slot[i])
    if last >= 0:
        best, front, back = stiffest(contacts, last)
    backing.held[i, 0] = backing.held[i, 1] = 0.0
    backing.behind[i] = best >= 0
    root = root_of(front, back)
    axis[i, OPPOSITE] = root_of(back, front) / root if best >= 0 else 0.0
    for a in range(3):
        axis[i, a] = root * contacts.normal[best, a] if best >= 0 else 0.0


@jit(inline=True)
def root_of(towards, away):
    """Return √s, where the sums κ_t and κ_a of a push are these."""
    ratio = towards + min(away, towards)
    return sqrt(ratio / (1.0 + ratio))


@jit
def store_backing(team, backing, near):
    """Add Δd, the displacement that the contacts prevented, to their pushes."""
    if backing is not None:
        first, end, step = turns(team, len(near.slot))
        for i in range(first, end, step):
            store_pushes(backing, near, i)


@jit(inline=True)
def store_pushes(backing, near, i):
    """Do so for one particle."""
    contacts, held = backing.contacts, backing.held
    if held[i, 0] != 0.0 or held[i, 1] != 0.0:
        last = last_candidate(contacts, near.slot[i])
        best, front, back = stiffest(contacts, last)
        add_pushes(contacts, last, best, held[i, 0], front, back, 1.0)
        add_pushes(contacts, last, best, held[i, 1], back, front, -1.0)


@jit(inline=True)
def add_pushes(contacts, last, best, held, towards, away, side):
    """Add to the pushes of a particle's colliders; ``side`` is 1 for pairs that push against n."""
    if held != 0.0:
        pads, k = contacts.pads, last
        change = -held * root_of(towards, away) / (towards + min(away, towards))
        while k >= 0:
            share = along(contacts, k, best)
            part = change * stiffness_ratio(contacts, k) * share
            if share * side <= 0.0 and away > towards:
                part *= towards / away
            contacts.push[k] += part
            if pads.soft[k]:
                pads.given[k] += part
                for a in range(3):
                    pads.shift[last, a] += part * contacts.normal[k, a]
            k = contacts.earlier[k]


@jit(inline=True)
def by_backing(backing, push, axes, n, b, moves, total):
    """
    Return the pushes W / W_b d of a vector of pairs, where d without colliders.

    W_b = Σ b² nᵀ M n; ``total`` is W = Σ b² w.
    """
    if backing is None:
        return push
    else:    # Numba prunes the branch that is not taken
        (p, q, r, s), (i, j, k, l) = axes, moves
        backed = fma(yielding(n, b[0], p), i[INV_MASS] * (b[0] * b[0]), fma(
            yielding(n, b[1], q), j[INV_MASS] * (b[1] * b[1]), fma(
                yielding(n, b[2], r), k[INV_MASS] * (b[2] * b[2]),
                yielding(n, b[3], s) * (l[INV_MASS] * (b[3] * b[3])))))
        return push * (total / select(backed > 0.0, backed, 1.0))


@jit(inline=True)
def yielding(n, b, axis):
    """Return nᵀ M n / w = 1 - s (n·n_k)²."""
    held = held_part(n, b, axis)
    return fma(-held, held, 1.0)


@jit(inline=True)
def held_part(n, b, axis):
    """Return √s n·n_k for a push along b n."""
    held = dot(n, axis)
    return select(b * held < 0.0, held, axis[OPPOSITE] * held)


@jit(inline=True)
def prevented(backing, n, k, i, share, x, y, z):
    """Return the part of share · (x, y, z), of pair k on particle i, that colliders prevent."""
    if backing is None:
        return 0.0, 0.0, 0.0
    else:    # Numba prunes the branch that is not taken
        axis, side = backing.axis, 0
        if not backing.behind[i]:
            return 0.0, 0.0, 0.0
        held = share * (axis[i, 0] * x + axis[i, 1] * y + axis[i, 2] * z)
        if share * (axis[i, 0] * n[0, k] + axis[i, 1] * n[1, k] + axis[i, 2] * n[2, k]) >= 0.0:
            side = 1
            held *= axis[i, OPPOSITE]
        backing.held[i, side] += held
        if side == 1:
            held *= axis[i, OPPOSITE]
        return held * axis[i, 0], held * axis[i, 1], held * axis[i, 2]


@jit(inline=True)
def take_part(backing, axes, n, b, movable):
    """
    Return the mask of the pairs that take part in this turn, ``movable`` in the first.

    In a further turn they have colliders behind both sides: where b > 0, and where b < 0.
    """
    if backing is None:
        return movable
    else:    # Numba prunes the branch that is not taken
        if is_further_turn(backing):
            return both(movable, is_clamped(axes, n, b))
        return movable


@jit(inline=True)
def in_turn(backing, q, mine):
    """Return the mask of those of a vector of pairs, ``mine``, that are ClampedPairs in a turn."""
    if backing is None:
        return mine
    else:    # Numba prunes the branch that is not taken
        if is_further_turn(backing):
            return both(mine, load(backing.clamped.part, q) > 0.0)
        return mine


@jit(inline=True)
def is_group_in_turn(backing, group):
    """Return False if no pair of a group takes part in this turn."""
    if backing is None:
        return True
    else:    # Numba prunes the branch that is not taken
        return not is_further_turn(backing) or backing.clamped.groups[group]


@jit(inline=True)
def is_clamped(axes, n, b):
    """Return the mask of the pairs with colliders that hold both sides."""
    p, q, r, s = axes
    p, q = is_held(n, b[0], p), is_held(n, b[1], q)
    r, s = is_held(n, b[2], r), is_held(n, b[3], s)
    return both(either(either(p[0], q[0]), either(r[0], s[0])),
                either(either(p[1], q[1]), either(r[1], s[1])))


@jit(inline=True)
def is_held(n, b, axis):
    """Return the masks of particles held by colliders: where b > 0, and where b < 0."""
    held = absolute(held_part(n, b, axis)) > 0.0
    return both(held, b > 0.0), both(held, b < 0.0)


@jit(inline=True)
def is_further_turn(backing):
    """Return True in a turn after the first: the contacts have moved particles in between."""
    if backing is None:
        return False
    else:    # Numba prunes the branch that is not taken
        return backing.turn[0] > 0


@jit
def begin_turn(backing, turn):
    """Begin a further turn if pads press; return False if there is none."""
    if backing is None:
        return False
    else:    # Numba prunes the branch that is not taken
        pads, contacts = backing.contacts.pads, backing.contacts
        if turn <= TURNS:
            for k in range(contacts.count[0]):
                if pads.soft[k] and contacts.push[k] > 0.0:
                    backing.turn[0] = turn
                    return True
        backing.turn[0] = 0    # all pairs take part again
        pads.again[0] = False
        return False
