"""
Pair contacts: two points of cloths, weighted means of particles, that keep a gap along a normal.

C = n · Σ b x - r ≥ 0, with weights b > 0 on one side and b < 0 on the other, ∇C = b n; then
Coulomb friction for motion perpendicular to n (as in ``effects.friction``, with W = Σ w b²), also
for what is left of the motion in earlier substeps (``self_collision.creep``):

    Δd = max(-C, -d),   d += Δd,   x += w b n Δd / W        (d ≥ 0: the push so far, never a pull)

Pairs stand in groups of PACK, and those of a round of a group share no particle
(``self_collision.near_pairs``), so they are projected side by side, in the lanes of vectors.

What follows of them at the substep's end is in ``self_collision.pair_impulses``.
"""

from math import ceil
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    absolute,
    any_lane,
    bits,
    both,
    either,
    fma,
    lanes,
    larger,
    load,
    lowest_bit,
    root,
    select,
    smaller,
    store,
)
from xpbd_ros.sim.backend.simd_records import load_records, PACK
from xpbd_ros.sim.backend.threads import (
    in_block,
    wait_in_block,
)
from xpbd_ros.sim.geometry.closest_points_simd import dot, minus
from xpbd_ros.sim.self_collision.neighbour_list import INV_MASS, spacing_of

NEVER = -1e30
"""-C of pairs that are no contacts in a substep [m]"""
ROOM, MOST_ROOM = 24, 1000
"""usual number of pairs that may touch, per particle, and the largest"""


class PairFriction(NamedTuple):
    """Friction data of pair contacts."""

    kinetic: np.ndarray
    """μ_k of each pair of cloths, shape (cloths, cloths)"""
    static: np.ndarray | None
    """μ_s of each pair of cloths, shape (cloths, cloths); None where all are μ_k"""
    slides: np.ndarray
    """μ_k of each pair, shape (capacity,)"""
    coefficient: np.ndarray | None
    """μ of each pair in this substep, shape (capacity,); None where all are μ_k"""
    unloaded: np.ndarray
    """part of the push that undoes a deep overlap, and loads no friction [m], (capacity,)"""
    slip: np.ndarray
    """displacement s by friction, accumulated in this substep [m], shape (3, capacity)"""
    creep: np.ndarray
    """slip e of earlier substeps that friction has yet to undo [m], shape (3, capacity)"""


class PairContacts(NamedTuple):
    """Near pairs of a substep, in groups; those with push > 0 are in contact."""

    end: np.ndarray
    """end of the pairs, a multiple of PACK; shape (1,)"""
    kind: np.ndarray
    """kind of the pairs of each group, shape (capacity / PACK,)"""
    rounds: np.ndarray
    """number of rounds of each group, shape (capacity / PACK,)"""
    turn: np.ndarray
    """round in which a pair is projected, from 0; shape (capacity,)"""
    count: np.ndarray
    """1 if they are those of this substep; pairs beyond the capacity in this frame; shape (2,)"""
    particles: np.ndarray
    """particles in natural order, one side first, unused ones a dummy, shape (4, capacity)"""
    keep: np.ndarray
    """distance to be kept by surfaces [m], or NEVER in empty places; shape (capacity,)"""
    weight: np.ndarray
    """b, shape (4, capacity)"""
    normal: np.ndarray
    """n, constant in the substep, shape (3, capacity)"""
    deficit: np.ndarray
    """-C at the substep's start, r - n · Σ b x [m], or NEVER; shape (capacity,)"""
    overlap: np.ndarray
    """part of the push that must not become velocity [m], shape (capacity,)"""
    push: np.ndarray
    """d, accumulated in this substep [m], shape (capacity,)"""
    seen: np.ndarray
    """positions when the groups were last found complete, less U then [m], (particles, 3)"""
    margin: np.ndarray
    """motion of each particle for which they stay so [m], shape (particles,)"""
    found: np.ndarray
    """scratch: particles of near pairs of one kind, in the list's order, shape (capacity, 4)"""
    found_keep: np.ndarray
    """scratch: distances that these have to keep [m], shape (capacity,)"""
    touched: np.ndarray
    """
    scratch: the first place of the last group that has a particle, plus the number of rounds up to
    it, by thread of a CPU, shape (threads, particles + 1)
    """
    impulse: np.ndarray
    """scratch: impulse of a vector of pairs, of one pair for each thread of a GPU; (3, PACK)"""
    friction: PairFriction | None
    """None in a scene without friction"""


def usual_room(thickness: float, cloths) -> int:
    """Return the pairs that may touch, per particle: as many as a disc of the thickness has."""
    spacing = spacing_of(cloths)
    return ROOM if thickness <= spacing or spacing == 0.0 else min(
        MOST_ROOM, ceil(ROOM * (thickness / spacing)**2))


def new_pair_contacts(room: int, particles: int, threads: int) -> PairContacts:
    """Return no pairs, with the capacity of ``room``; as many threads of a CPU group them."""
    room = (room + 4 * PACK - 1) // PACK * PACK    # the last group of each kind may not be full

    def rows(*shape):
        return np.zeros((*shape, room), np.float32)
    return PairContacts(
        np.zeros(1, np.int64), np.zeros(room // PACK, np.int64), np.zeros(room // PACK, np.int64),
        rows(), np.zeros(2, np.int64), np.zeros((4, room), np.int32), rows(), rows(4), rows(3),
        rows(), rows(), rows(), np.zeros((particles, 3)), np.zeros(particles),
        np.zeros((room, 4), np.int32), rows(),
        np.zeros((threads, particles + 1), np.int32), np.zeros((3, PACK), np.float32), None)


def new_pair_friction(pairs: PairContacts, kinetic: np.ndarray,
                      static: np.ndarray | None) -> PairFriction:
    """Return the friction data of pair contacts, with μ_k and μ_s by pair of cloths."""
    return PairFriction(kinetic, static, np.zeros_like(pairs.push),
                        None if static is None else np.zeros_like(pairs.push),
                        np.zeros_like(pairs.push), np.zeros_like(pairs.normal),
                        np.zeros_like(pairs.normal))


@jit(inline=True)
def weighted(b, p, q, r, s):
    """Return Σ b x of four points, relative to the first: Σ b = 0."""
    q, r, s = minus(q, p), minus(r, p), minus(s, p)
    return (fma(b[1], q[0], fma(b[2], r[0], b[3] * s[0])),
            fma(b[1], q[1], fma(b[2], r[1], b[3] * s[1])),
            fma(b[1], q[2], fma(b[2], r[2], b[3] * s[2])))


@jit(inline=True)
def load_corners(records, particles, q):
    """Return the records of the four particles of a vector of pairs."""
    return (load_records(records, particles[0], q), load_records(records, particles[1], q),
            load_records(records, particles[2], q), load_records(records, particles[3], q))


@jit(inline=True)
def load_weights(pairs, q):
    """Return b of a vector of pairs."""
    return (load(pairs.weight[0], q), load(pairs.weight[1], q), load(pairs.weight[2], q),
            load(pairs.weight[3], q))


@jit(inline=True)
def load_vector(rows, q):
    """Return rows x, y, z of a vector of pairs."""
    return load(rows[0], q), load(rows[1], q), load(rows[2], q)


@jit(inline=True)
def store_vector(rows, q, v):
    """Write rows x, y, z of a vector of pairs."""
    store(rows[0], q, v[0])
    store(rows[1], q, v[1])
    store(rows[2], q, v[2])


@jit(inline=True)
def mobility_of(b, p, q, r, s):
    """Return W = Σ w b² [1/kg]."""
    return fma(p[3], b[0] * b[0], fma(q[3], b[1] * b[1], fma(r[3], b[2] * b[2],
                                                             s[3] * (b[3] * b[3]))))


@jit(inline=True)
def displace(near, pairs, q, active, me):
    """Add w b v to the displacements of the pairs q + k of all bits k; v is ``pairs.impulse``."""
    move, v = near.precise_move, pairs.impulse
    while active:
        lane = lowest_bit(active)
        active &= active - 1
        k, rest = q + lane, 0.0
        for p in range(3, -1, -1):
            i = pairs.particles[p, k]
            if i == len(near.slot):
                continue
            b = float(pairs.weight[p, k]) if p > 0 else -rest    # Σ b = 0
            rest += b
            share = move[i, INV_MASS] * b
            for a in range(3):
                move[i, a] += share * v[a, me + lane]
                near.move[i, a] = move[i, a]


@jit(inline=True)
def store_weights(pairs, q, b):
    """Write b of a vector of pairs."""
    store(pairs.weight[0], q, b[0])
    store(pairs.weight[1], q, b[1])
    store(pairs.weight[2], q, b[2])
    store(pairs.weight[3], q, b[3])


@jit
def project_pairs(team, near, pairs):
    """
    Project C ≥ 0 and the friction of all pairs once, by the formulas of the module.

    On a GPU the threads of the first block share the pairs of a round.
    """
    me, threads = in_block(team)
    width = lanes(near.move)
    for group in range(0, pairs.end[0], PACK):
        for turn in range(pairs.rounds[group // PACK]):
            for q in range(group + me * width, group + PACK, threads * width):
                project_round(near, pairs, q, float(turn), me)
            wait_in_block(team)


@jit(inline=True)
def project_round(near, pairs, q, turn, me):
    """Project those of a vector of pairs that are contacts, and that belong to a round."""
    now, deficit = load(pairs.turn, q), load(pairs.deficit, q)
    mine = both(deficit > NEVER, both(now >= turn, now <= turn))
    if any_lane(mine):
        project_some(near, pairs, q, mine, load_corners(near.move, pairs.particles, q),
                     load_vector(pairs.normal, q), load_weights(pairs, q), deficit, me)


@jit(inline=True)
def project_some(near, pairs, q, mine, moves, n, weight, deficit, me):
    """
    Project a vector of pairs.

    Parameters
    ----------
    near : neighbour list, with the records of the displacements in this substep
    pairs, q, mine : the pairs are those of the mask ``mine`` in q to q + lanes
    moves : records of the displacements of their particles
    n, weight, deficit : normals, weights and -C at the substep's start [m]
    me : number of the thread in its block

    """
    p, r, s, t = moves
    friction = pairs.friction
    way = weighted(weight, p, r, s, t)
    total = mobility_of(weight, p, r, s, t)
    along, before = dot(n, way), load(pairs.push, q)
    push = larger(deficit - along, -before)
    there = both(mine, total > 0.0)
    push = select(there, push, 0.0)
    slip = load_slip(friction, q, push)
    active = bits(both(mine, either(absolute(push) > 0.0,
                                    either(before > 0.0, dot(slip, slip) > 0.0))))
    if active == 0:
        return
    store(pairs.push, q, before + push)
    way = slip_to_undo(friction, q, way)
    along = dot(n, way)
    rub = rub_of(friction, pairs, q, before + push, slip, there,
                 (fma(-along, n[0], way[0]), fma(-along, n[1], way[1]),
                  fma(-along, n[2], way[2])))
    per = select(total > 0.0, 1.0 / select(total > 0.0, total, 1.0), 0.0)
    store_vector(pairs.impulse, me, (
        per * fma(push, n[0], rub[0]), per * fma(push, n[1], rub[1]),
        per * fma(push, n[2], rub[2])))
    displace(near, pairs, q, active, me)


@jit(inline=True)
def load_slip(friction, q, zero):
    """Return the displacement by friction so far, of no length without friction."""
    if friction is None:
        zero = zero - zero
        return zero, zero, zero
    else:    # Numba prunes the branch that is not taken
        return load_vector(friction.slip, q)


@jit(inline=True)
def slip_to_undo(friction, q, way):
    """Return the displacement in this substep and what is left of earlier slips."""
    if friction is None:
        return way
    else:    # Numba prunes the branch that is not taken
        e = load_vector(friction.creep, q)
        return way[0] + e[0], way[1] + e[1], way[2] + e[2]


@jit(inline=True)
def rub_of(friction, pairs, q, push, slip, part, way):
    """Return the further displacement by friction, within the friction cone |s| ≤ μ d [m]."""
    if friction is None:
        return slip
    else:    # Numba prunes the branch that is not taken
        sx, sy, sz = slip[0] - way[0], slip[1] - way[1], slip[2] - way[2]
        size = root(dot((sx, sy, sz), (sx, sy, sz)))
        most = load(coefficients(friction.coefficient, friction.slides), q) * (
            push - smaller(load(friction.unloaded, q), push))
        scale = select(size > most, most / select(size > 0.0, size, 1.0), 1.0)
        there = either(push > 0.0, dot(slip, slip) > 0.0)
        sx, sy, sz = (select(there, scale * sx, 0.0), select(there, scale * sy, 0.0),
                      select(there, scale * sz, 0.0))
        sx, sy, sz = (select(part, sx, slip[0]), select(part, sy, slip[1]),
                      select(part, sz, slip[2]))
        store_vector(friction.slip, q, (sx, sy, sz))
        return sx - slip[0], sy - slip[1], sz - slip[2]


@jit(inline=True)
def coefficients(chosen, kinetic):
    """Return μ of all pairs in this substep."""
    if chosen is None:
        return kinetic
    else:    # Numba prunes the branch that is not taken
        return chosen
