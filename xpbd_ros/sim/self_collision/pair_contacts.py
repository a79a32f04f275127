"""
Pair contacts: two points of cloths, weighted means of particles, that keep a gap along a normal.

C = n · Σ b x - r ≥ 0, with weights b > 0 on one side and b < 0 on the other, ∇C = b n; then
Coulomb friction for motion perpendicular to n (as in ``effects.friction``, with W = Σ w b²):

    Δd = max(-C, -d),   d += Δd,   x += w b n Δd / W        (d ≥ 0: the push so far, never a pull)

Depenetration of an earlier overlap must not become velocity: that part is removed from v at the
substep's end.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.contacts import shortened
from xpbd_ros.sim.particles.history import invalidate_history


class PairFriction(NamedTuple):
    """Friction data of pair contacts."""

    cloth: np.ndarray
    """index of each particle's cloth, shape (slots,)"""
    kinetic: np.ndarray
    """μ_k of each pair of cloths, shape (cloths, cloths)"""
    static: np.ndarray
    """μ_s of each pair of cloths, shape (cloths, cloths)"""
    slip: np.ndarray
    """displacement s by friction, accumulated in this substep [m], shape (capacity, 3)"""


class PairContacts(NamedTuple):
    """The pairs that may touch in this substep; those with push > 0 are in contact."""

    count: np.ndarray
    """number of pairs; of pairs beyond the capacity in this frame; shape (2,)"""
    particles: np.ndarray
    """slots, one side first, shape (capacity, particles of a pair)"""
    weight: np.ndarray
    """b, shape (capacity, particles of a pair)"""
    normal: np.ndarray
    """n, constant in the substep, shape (capacity, 3)"""
    gap: np.ndarray
    """r, the distance to be kept [m], shape (capacity,)"""
    overlap: np.ndarray
    """part of the push that must not become velocity [m], shape (capacity,)"""
    push: np.ndarray
    """d, accumulated in this substep [m], shape (capacity,)"""
    rubbing: PairFriction | None
    """None in a scene without friction"""


def new_pair_contacts(room: int, particles: int) -> PairContacts:
    """Return an empty list with the capacity of ``room`` pairs of so many particles."""
    return PairContacts(np.zeros(2, np.int64), np.zeros((room, particles), np.int64),
                        np.zeros((room, particles)), np.zeros((room, 3)), np.zeros(room),
                        np.zeros(room), np.zeros(room), None)


@jit(inline=True)
def mobility_of(touches, k, state):
    """Return W = Σ w b² of pair k [1/kg]."""
    total = 0.0
    for p in range(touches.particles.shape[1]):
        total += state.inv_mass[touches.particles[k, p]] * touches.weight[k, p]**2
    return total


@jit
def push_apart(touches, state):
    """Project C ≥ 0 of all pairs once, by the formulas of the module."""
    x, n = state.x, touches.normal
    for k in range(touches.count[0]):
        distance = 0.0
        for p in range(touches.particles.shape[1]):
            i = touches.particles[k, p]
            distance += touches.weight[k, p] * (
                n[k, 0] * x[0, i] + n[k, 1] * x[1, i] + n[k, 2] * x[2, i])
        before = touches.push[k]
        push = max(touches.gap[k] - distance, -before)
        if push == 0.0:
            continue
        touches.push[k] = before + push
        push /= mobility_of(touches, k, state)
        for p in range(touches.particles.shape[1]):
            i = touches.particles[k, p]
            share = state.inv_mass[i] * touches.weight[k, p] * push
            if share != 0.0:
                for a in range(3):
                    x[a, i] += share * n[k, a]
                invalidate_history(state.history, i)


@jit
def rub(rubbing, touches, state):
    """Oppose motion perpendicular to the normals, within the friction cone |s| ≤ μ d."""
    if rubbing is not None:
        x, before, n, s = state.x, state.x_prev, touches.normal, rubbing.slip
        last = touches.particles.shape[1] - 1
        for k in range(touches.count[0]):
            if touches.push[k] == 0.0 and s[k, 0] == 0.0 and s[k, 1] == 0.0 and s[k, 2] == 0.0:
                continue
            px, py, pz = 0.0, 0.0, 0.0
            for p in range(last + 1):
                i, b = touches.particles[k, p], touches.weight[k, p]
                px += b * (x[0, i] - before[0, i])
                py += b * (x[1, i] - before[1, i])
                pz += b * (x[2, i] - before[2, i])
            pn = px * n[k, 0] + py * n[k, 1] + pz * n[k, 2]
            load = touches.push[k] - min(touches.overlap[k], touches.push[k])
            one = rubbing.cloth[touches.particles[k, 0]]
            other = rubbing.cloth[touches.particles[k, last]]
            sx, sy, sz = shortened(s[k, 0] - (px - pn * n[k, 0]), s[k, 1] - (py - pn * n[k, 1]),
                                   s[k, 2] - (pz - pn * n[k, 2]),
                                   rubbing.static[one, other] * load,
                                   rubbing.kinetic[one, other] * load)
            total = mobility_of(touches, k, state)
            for p in range(last + 1):
                i = touches.particles[k, p]
                share = state.inv_mass[i] * touches.weight[k, p] / total
                x[0, i] += share * (sx - s[k, 0])
                x[1, i] += share * (sy - s[k, 1])
                x[2, i] += share * (sz - s[k, 2])
            s[k, 0], s[k, 1], s[k, 2] = sx, sy, sz


@jit
def remove_depenetration_velocity(touches, state, substep):
    """Remove the normal velocity that results from depenetration of earlier overlaps."""
    v, n = state.v, touches.normal
    for k in range(touches.count[0]):
        still = min(touches.overlap[k], touches.push[k]) / substep.h
        if still <= 0.0:
            continue
        speed = 0.0
        for p in range(touches.particles.shape[1]):
            i = touches.particles[k, p]
            speed += touches.weight[k, p] * (
                n[k, 0] * v[0, i] + n[k, 1] * v[1, i] + n[k, 2] * v[2, i])
        excess = min(speed, still)
        if excess <= 0.0:
            continue
        excess /= mobility_of(touches, k, state)
        for p in range(touches.particles.shape[1]):
            i = touches.particles[k, p]
            share = state.inv_mass[i] * touches.weight[k, p] * excess
            for a in range(3):
                v[a, i] -= share * n[k, a]


@jit
def press(touches, state, substep):
    """Add the forces on pinned particles, b (n d + s) / (W h²), to the mean over the frame."""
    part = (substep.end - substep.begin) / substep.h**2
    for k in range(touches.count[0]):
        if touches.push[k] == 0.0:
            continue
        scale = part / mobility_of(touches, k, state)
        for p in range(touches.particles.shape[1]):
            i = touches.particles[k, p]
            if state.inv_mass[i] > 0.0:
                continue
            for a in range(3):
                along = touches.normal[k, a] * touches.push[k] + slip_of(touches.rubbing, k, a)
                state.reaction[a, i] += scale * touches.weight[k, p] * along


@jit(inline=True)
def slip_of(rubbing, k, a):
    """Return component a of the displacement by friction of pair k [m]; 0 without friction."""
    if rubbing is None:
        return 0.0
    else:    # Numba prunes the branch that is not taken
        return rubbing.slip[k, a]
