"""
Velocities of contacts: old overlaps, Newton's law of restitution, and the recovery of pads.

The last two are compiled only if a collider of the scene has a coefficient, or a pad.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import any_lane, smaller
from xpbd_ros.sim.backend.simd_wide import load_wide, WIDTH
from xpbd_ros.sim.backend.threads import turns_on_device, wait, worker, workers
from xpbd_ros.sim.contact.collider_motion import surface_motion
from xpbd_ros.sim.contact.colliders import is_on_pad
from xpbd_ros.sim.contact.contacts import wait_for_others
from xpbd_ros.sim.contact.corners import add_extra, add_later, note_extra
from xpbd_ros.sim.contact.pieces import candidate, rounds
from xpbd_ros.sim.contact.wrenches import add_reaction
from xpbd_ros.sim.geometry.closest_points import dot


class Bounce(NamedTuple):
    """Data of restitution."""

    restitution: np.ndarray
    """e of each collider, shape (capacity,)"""
    start: np.ndarray
    """velocities at the substep's start [m/s], shape (3, slots)"""
    approach: np.ndarray
    """those of the candidates, shape (candidates, 3)"""


def new_bounce(capacity: int, room: int, slots: int) -> Bounce:
    """Return room for ``capacity`` colliders and ``room`` candidates."""
    return Bounce(np.zeros(capacity), np.zeros((3, slots)), np.zeros((room, 3)))


@jit
def note_start(bounce, state, h):
    """Store v_n, which no force has changed; x is still that of the first prediction."""
    begin, end, turn = turns_on_device(state.team, len(state.inv_mass))
    for i in range(begin, end, turn):
        for a in range(3):
            bounce.start[a, i] = start_velocity(state.history, state, a, i, h)


@jit(inline=True)
def start_velocity(history, state, a, i, h):
    """Return component a of v_n of slot i."""
    if history is None:    # x = x_n + h (v_n + h g)
        return (np.float64(state.x[a, i]) - state.x_prev[a, i]) / h - h * state.gravity[a]
    else:    # Numba prunes the branch that is not taken
        return history.v[a, i]


@jit
def note_approach(bounce, contacts, k):
    """Store the velocity of approach of candidate k."""
    if bounce is not None:
        for a in range(3):
            bounce.approach[k, a] = bounce.start[a, contacts.particle[k]]


@jit(inline=True)
def speed_away(contacts, k, state, substep):
    """Return the normal speed of the particle of contact k away from the surface [m/s]."""
    i, v, n, h = contacts.particle[k], state.v, contacts.normal, substep.h
    ux, uy, uz = surface_motion(contacts, k, state)
    return ((v[0, i] - ux / h) * n[k, 0] + (v[1, i] - uy / h) * n[k, 1]
            + (v[2, i] - uz / h) * n[k, 2])


@jit(inline=True)
def drive_away(contacts, k, state, speed):
    """Add ``speed`` along the normal to the velocity of the particle of contact k [m/s]."""
    i, n = contacts.particle[k], contacts.normal
    for a in range(3):
        state.v[a, i] += speed * n[k, a]
    gained = state.mass[i] * speed
    add_reaction(contacts, k, state, i, gained * n[k, 0], gained * n[k, 1], gained * n[k, 2])


@jit(inline=True)
def calm_overlaps(contacts, state, substep):
    """Remove the velocity that came from separating old overlaps."""
    team = state.team
    for c in range(contacts.colliders.count[0] if contacts.count[0] > 0 else 0):
        begin, last = contacts.first[c], contacts.first[c + 1]
        for n in range(rounds(team, begin, last)):
            k = candidate(team, n, begin)
            if k + WIDTH > last or any_lane(smaller(
                    load_wide(contacts.push, k), load_wide(contacts.overlap, k)) > 0.0):
                for j in range(k, min(k + WIDTH, last)):
                    calm_overlap(contacts, j, state, substep)
        wait_for_others(contacts, team)


@jit(inline=True)
def calm_overlap(contacts, k, state, substep):
    """Do so for one candidate."""
    still = min(contacts.overlap[k], contacts.push[k])
    if still > 0.0:
        excess = min(speed_away(contacts, k, state, substep), still / substep.h)
        if excess > 0.0:
            drive_away(contacts, k, state, -excess)


@jit
def rebound(bounce, contacts, state, substep):
    """
    Apply v_n = -e v_n⁻ to all contacts, with v_n⁻ the relative normal velocity of approach.

    Approaches slower than 2 |g| h do not bounce: gravity alone causes them in a resting contact.
    """
    if bounce is not None:
        g, h = state.gravity, substep.h
        least = 2.0 * sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2]) * h
        for c in range(contacts.colliders.count[0] if contacts.count[0] > 0 else 0):
            begin, last = contacts.first[c], contacts.first[c + 1]
            for n in range(rounds(state.team, begin, last)):
                first = candidate(state.team, n, begin)
                for k in range(first, min(first + WIDTH, last)):
                    rebound_candidate(bounce, contacts, k, state, substep, least)
            wait_for_others(contacts, state.team)


@jit(inline=True)
def rebound_candidate(bounce, contacts, k, state, substep, least):
    """Do so for one candidate; ``least`` is the speed from which it bounces [m/s]."""
    e, h = bounce.restitution[contacts.collider[k]], substep.h
    if e == 0.0 or contacts.push[k] == 0.0:
        return
    ux, uy, uz = surface_motion(contacts, k, state)
    w, n = bounce.approach[k], contacts.normal[k]
    before = (w[0] - ux / h) * n[0] + (w[1] - uy / h) * n[1] + (w[2] - uz / h) * n[2]
    if before < -least:
        missing = -e * before - speed_away(contacts, k, state, substep)
        if missing > 0.0:
            drive_away(contacts, k, state, missing)


@jit
def calm_pads(pads, contacts, state, substep):
    """
    Reduce the speed at which pads push particles off (see ``contact.pads``).

    It is that along the sum u of all pushes, so where two pads balance there is none.
    """
    if pads is not None:
        wait(state.team)
        found = 0
        for k in range(worker(state.team), contacts.count[0], workers(state.team)):
            if contacts.latest[contacts.particle[k]] == k:
                found |= calm_particle(pads, contacts, k, state, substep)
        note_extra(contacts, state.team, found)
        wait(state.team)
        add_extra(contacts, state)


@jit
def calm_particle(pads, contacts, last, state, substep):
    """Reduce the speed relative to the pad that pushes most; return whether it changes."""
    n, v, i, j = contacts.normal, state.v, contacts.particle[last], contacts.earlier[last]
    u = (pads.shift[last, 0], pads.shift[last, 1], pads.shift[last, 2])
    if pads.clamped[last]:    # across the clamp, friction bears what pushes give
        a = (n[last, 0] - n[j, 0], n[last, 1] - n[j, 1], n[last, 2] - n[j, 2])
        share = dot(u, a) / dot(a, a)
        u = (share * a[0], share * a[1], share * a[2])
    size = sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    most, strongest, k = 0.0, -1, last
    while k >= 0:
        along = pads.given[k] * (u[0] * n[k, 0] + u[1] * n[k, 1] + u[2] * n[k, 2])
        if along > most and is_on_pad(pads, k):
            most, strongest = along, k
        k = contacts.earlier[k]
    if strongest >= 0:
        wx, wy, wz = surface_motion(contacts, strongest, state)
        h = substep.h
        off = min((v[0, i] - wx / h) * u[0] + (v[1, i] - wy / h) * u[1]
                  + (v[2, i] - wz / h) * u[2], size * size / h) / size
        if off > 0.0:
            for a in range(3):
                v[a, i] -= off * pads.lost[strongest] * u[a] / size
            lost = state.mass[i] * off * pads.lost[strongest] / size
            add_later(contacts, strongest, -lost * u[0], -lost * u[1], -lost * u[2])
            return True
    return False
