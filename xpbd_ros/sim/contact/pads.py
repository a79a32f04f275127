"""
Pads: elastic foundations on colliders, so that a squeeze has a force.

The pressure of a pad is its foundation modulus K [Pa/m] times its indentation. A particle with the
rest area A is pressed out by

    f = max(0, -C) / α,   C = φ(x) - r,   α = 1 / (K A)

with φ the signed distance to the undeformed surface and r the thickness. The force is implicit. A
particle between several colliders feels them in one solve, since one after the other they would
need about m / α iterations (m = w H², its mobility). With x* its position without pushes,
b = r - φ(x*), κ = m / α, and the sum over the colliders that touch,

    (I + Σ κ n nᵀ) u = Σ κ b n,   x = x* + u,   d = m f = κ (b - n·u)        (d > 0 if it touches)

which meets C + α f = 0 exactly for flat surfaces, whatever the order of the colliders; curved ones
are linearised up to ROUNDS times. A particle that has not moved since is not solved again. A rigid
collider beside a pad takes part with κ = RIGID, and is projected again afterwards. So where a
squeeze is at rest, f depends on indentation and area alone, not on substeps, method or masses.
Friction takes d for the load, as that of rigid contact.

A particle between several colliders that would be pressed deeper into one than ``Colliders.depth``
(half of the way to its middle) passes through it, one way or the other; where neighbours part,
cloth is caught and torn along. So all colliders of such a particle act as rigid ones in that
substep, which let it out on the same side as its neighbours.

A pad recovers at no more than DEPENETRATION, so particles that a collider was put over come out
slowly, and keep no speed. Before a further turn with ``self_collision`` it recovers as it would
freely, which is what layers that press on it are solved with. Otherwise particles keep 1 / (1 + κ)
of the speed that it gives them: all of it where the substep resolves the pad, and where it does
not as little as from a rigid collider.

Limits: a foundation has no thickness, so a soft one lets particles through. Layers of cloth
that pads press on are solved together with these in a further turn (``self_collision.squeeze``).
κ counts as at most RIGID. A particle without area, inside a body, does not feel a pad.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import worker, workers
from xpbd_ros.sim.contact.continuous_detection import detect_crossing
from xpbd_ros.sim.contact.corners import contact_distance
from xpbd_ros.sim.geometry.mesh import cross, length, Mesh
from xpbd_ros.sim.particles.history import invalidate_history

RIGID = 1e8
"""κ of a rigid collider beside a pad, and the largest of a pad"""
ROUNDS = 3
"""most linearisations at curved surfaces"""
TURNS = 8
"""most changes of the set of colliders that touch"""
FLAT = 1e-12
"""change of a normal, squared, up to which a surface is flat"""
OPPOSITE = -0.99
"""largest cosine of the angle between the normals of colliders that clamp a particle"""


class Pads(NamedTuple):
    """The candidates' part in the solve."""

    area: np.ndarray
    """rest area of each particle [m²], shape (slots,)"""
    soft: np.ndarray
    """1 if a pad presses it, int32, shape (candidates,)"""
    start: np.ndarray
    """φ at the substep's start [m], shape (candidates,)"""
    limit: np.ndarray
    """φ up to which a pad pushes in this substep [m], shape (candidates,)"""
    ratio: np.ndarray
    """κ, shape (candidates,)"""
    deficit: np.ndarray
    """b [m], shape (candidates,)"""
    touches: np.ndarray
    """1 if it touches, likewise"""
    given: np.ndarray
    """d of the last solve [m], shape (candidates,)"""
    shift: np.ndarray
    """u of the last solve, at a particle's last candidate [m], shape (candidates, 3)"""
    lost: np.ndarray
    """part of the speed that a pad gives and that the particle does not keep, shape
    (candidates,)"""
    force: np.ndarray
    """f [N], shape (candidates,)"""
    clamped: np.ndarray
    """1 if the friction of two candidates has been solved at once, likewise"""
    solved: np.ndarray
    """1 at a particle's last candidate if ``self_collision.squeeze`` has just solved it"""
    left: np.ndarray
    """
    where a solve left the particle, at its last candidate [m]; infinite: it must be solved again;
    shape (candidates, 3)
    """
    again: np.ndarray
    """True while the inequalities are projected again in this iteration, shape (1,)"""


def new_pads(room: int, area: np.ndarray) -> Pads:
    """Return storage for ``room`` candidates; ``area`` is that of the particles, by slot."""
    return Pads(area, np.zeros(room, np.int32), np.zeros(room), np.zeros(room), np.zeros(room),
                np.zeros(room), np.zeros(room, np.int32), np.zeros(room), np.zeros((room, 3)),
                np.zeros(room), np.zeros(room), np.zeros(room, np.int32), np.zeros(room, np.int32),
                np.zeros((room, 3)), np.zeros(1, np.bool_))


def surface_area(mesh: Mesh) -> np.ndarray:
    """Return the area of the surface that each particle stands for [m²], shape (particles,)."""
    if not len(mesh.tetrahedra):
        return mesh.area
    a, b, c = (mesh.positions[mesh.triangles[:, k]] for k in range(3))
    return np.bincount(mesh.triangles.ravel(), np.repeat(length(cross(b - a, c - a)) / 6.0, 3),
                       len(mesh.positions))


def areas(world) -> np.ndarray:
    """Return the rest area of each particle of a scene [m²], shape (slots,)."""
    found = np.zeros(world.slots)
    for cloth in world.cloths:
        found[cloth.slots] = surface_area(cloth.mesh)
    return found


def pad_forces(contacts, placed) -> dict[str, float]:
    """Return the normal force of each pad in the last substep [N]; ``placed``: all colliders."""
    if contacts.pads is None:
        return {}
    found = max(0, contacts.count[0])
    forces = np.bincount(contacts.collider[:found], contacts.pads.force[:found],
                         len(contacts.colliders.shape))
    return {f'pad_force_{name}_n': float(force)
            for (name, each), force in zip(placed.items(), forces) if each.entry.pad is not None}


@jit
def begin_pad(pads, contacts, k, start, limit):
    """Prepare a candidate: a pad keeps the whole thickness, and all of its push is a load."""
    if pads is not None:
        pads.start[k], pads.limit[k] = start, limit
        pads.given[k] = pads.force[k] = 0.0
        for a in range(3):
            pads.shift[k, a] = 0.0
        must_solve(pads, k)
        pads.soft[k] = contacts.colliders.stiffness[contacts.collider[k]] > 0.0
        if pads.soft[k]:
            contacts.gap[k] = contacts.thickness[0]
            contacts.overlap[k] = 0.0


@jit
def press_pads(pads, contacts, state):
    """Solve all particles that have a candidate with a pad, and moved since they were solved."""
    if pads is not None:
        for k in range(worker(state.team), contacts.count[0], workers(state.team)):
            i = contacts.particle[k]
            if pads.solved[k]:
                pads.solved[k] = 0
            elif (contacts.latest[i] == k and pads.area[i] > 0.0 and meets_pad(pads, contacts, k)
                  and not stays(pads, k, i, state)):
                press(pads, contacts, k, i, state)


@jit(inline=True)
def stays(pads, last, i, state):
    """Return True if particle i is where its solve left it."""
    left, x = pads.left[last], state.x
    return left[0] == x[0, i] and left[1] == x[1, i] and left[2] == x[2, i]


@jit(inline=True)
def note_solved(pads, last, i, state):
    """Note where a solve leaves particle i: unless it moves, it need not be solved again."""
    for a in range(3):
        pads.left[last, a] = state.x[a, i]


@jit(inline=True)
def must_solve(pads, last):
    """Let the next turn solve a particle wherever it is."""
    for a in range(3):
        pads.left[last, a] = np.inf


@jit(inline=True)
def meets_pad(pads, contacts, k):
    """Return True if a pad presses the particle whose last candidate is k."""
    while k >= 0:
        if pads.soft[k]:
            return True
        k = contacts.earlier[k]
    return False


@jit
def partner(pads, contacts, k):
    """
    Return the candidate that clamps a particle together with its last candidate k; -1: none.

    The two push from opposite sides, at least one has a pad, and there is no third.
    """
    j, n = contacts.earlier[k], contacts.normal
    if (j >= 0 and contacts.latest[contacts.particle[k]] == k and contacts.earlier[j] < 0
            and contacts.push[j] > 0.0 and contacts.push[k] > 0.0 and meets_pad(pads, contacts, k)
            and n[j, 0] * n[k, 0] + n[j, 1] * n[k, 1] + n[j, 2] * n[k, 2] < OPPOSITE):
        return j
    return -1


@jit(inline=True)
def is_clamped(pads, k):
    """Return True if the friction of candidate k has been solved together with another's."""
    if pads is None:
        return False
    else:    # Numba prunes the branch that is not taken
        return pads.clamped[k]


@jit(inline=True)
def press(pads, contacts, last, i, state):
    """Solve particle i, whose last candidate is ``last``, for all its colliders."""
    x, m = state.x, state.mobility[i]
    if not m > 0.0:
        return
    must_solve(pads, last)
    free = without_pushes(pads, contacts, last, (x[0, i], x[1, i], x[2, i]))
    at, u = free, (0.0, 0.0, 0.0)
    for _ in range(ROUNDS):
        linearise(pads, contacts, last, i, state, free, at, m)
        if is_free(pads, contacts, last):
            note_solved(pads, last, i, state)
            return
        u = solve(pads, contacts, last)
        at = (free[0] + u[0], free[1] + u[1], free[2] + u[2])
        if is_flat(contacts, last, at):
            break
    if is_squeezed_out(pads, contacts, last, at):
        become_rigid(pads, contacts, last, i, state, free)
        return
    share = 1.0 if pads.again[0] else recovered(pads, contacts, last, u)
    k, moved = last, False
    while k >= 0:
        d = share * push_of(pads, contacts, k, u)
        moved |= d > 0.0 or pads.given[k] > 0.0
        contacts.push[k] = pads.given[k] = d
        pads.force[k] = d / m
        pads.lost[k] = pads.ratio[k] / (1.0 + pads.ratio[k]) if share == 1.0 else 1.0
        k = contacts.earlier[k]
    for a in range(3):
        pads.shift[last, a] = share * u[a]
        x[a, i] = free[a] + share * u[a]
    if moved:
        invalidate_history(state.history, i)
    if not pads.again[0]:
        note_solved(pads, last, i, state)


@jit(inline=True)
def is_free(pads, contacts, last):
    """Return True if no collider touches a particle, or has pushed it so far."""
    k = last
    while k >= 0:
        if pads.touches[k] or contacts.push[k] > 0.0 or pads.given[k] > 0.0:
            return False
        k = contacts.earlier[k]
    return True


@jit(inline=True)
def is_squeezed_out(pads, contacts, last, at):
    """Return True if a particle between several colliders would be too deep in a pad."""
    k, depth = last, contacts.colliders.depth
    if contacts.earlier[last] < 0:
        return False
    while k >= 0:
        if pads.soft[k] and contact_distance(
                contacts, k, at[0], at[1], at[2])[0] < -depth[contacts.collider[k]]:
            return True
        k = contacts.earlier[k]
    return False


@jit
def become_rigid(pads, contacts, last, i, state, free):
    """Let the rest of the substep take a particle's pads for rigid; it returns to ``free``."""
    k = last
    while k >= 0:
        contacts.push[k] = pads.given[k] = pads.force[k] = 0.0
        if pads.soft[k]:
            pads.soft[k] = 0
            contacts.gap[k] = min(contacts.thickness[0], pads.limit[k])
            contacts.overlap[k] = max(0.0, contacts.gap[k] - pads.start[k])
        k = contacts.earlier[k]
    for a in range(3):
        pads.shift[last, a] = 0.0
        state.x[a, i] = free[a]
    invalidate_history(state.history, i)


@jit(inline=True)
def without_pushes(pads, contacts, last, x):
    """Return x*: the particle's position without the pushes of its contacts."""
    n, u, k = contacts.normal, pads.shift[last], last
    x, y, z = x[0] - u[0], x[1] - u[1], x[2] - u[2]
    while k >= 0:
        rest = contacts.push[k] - pads.given[k]    # of a rigid collider, after the last solve
        if rest != 0.0:
            x, y, z = x - rest * n[k, 0], y - rest * n[k, 1], z - rest * n[k, 2]
        k = contacts.earlier[k]
    return x, y, z


@jit(inline=True)
def linearise(pads, contacts, last, i, state, free, at, m):
    """
    Write normal, b and κ of each candidate of a particle, linearised at a point.

    Parameters
    ----------
    last, i : the particle's last candidate, its slot
    free, at : x*, the point [m]
    m : mobility [m/N]

    """
    k, before, (x, y, z), n = last, state.x_prev, at, contacts.normal
    while k >= 0:
        c = contacts.collider[k]
        for px, py, pz in (free, at):    # neither x* nor a push may lead through the collider
            step = (px - before[0, i])**2 + (py - before[1, i])**2 + (pz - before[2, i])**2
            if not contacts.crossed[k] and step >= contacts.slack[c]**2:
                detect_crossing(contacts, k, before[0, i], before[1, i], before[2, i],
                                px, py, pz, contacts.thickness[0])
        phi, (nx, ny, nz) = contact_distance(contacts, k, x, y, z)
        n[k, 0], n[k, 1], n[k, 2] = nx, ny, nz
        pads.deficit[k] = contacts.gap[k] - phi - (
            nx * (free[0] - x) + ny * (free[1] - y) + nz * (free[2] - z))
        pads.touches[k] = pads.deficit[k] > 0.0
        pads.ratio[k] = RIGID
        if pads.soft[k]:
            pads.ratio[k] = min(m * pads.area[i] * contacts.colliders.stiffness[c], RIGID)
        k = contacts.earlier[k]


@jit(inline=True)
def is_flat(contacts, k, at):
    """Return True if the normals of a particle's candidates are those at a point."""
    n = contacts.normal
    while k >= 0:
        _, (x, y, z) = contact_distance(contacts, k, at[0], at[1], at[2])
        if (x - n[k, 0])**2 + (y - n[k, 1])**2 + (z - n[k, 2])**2 > FLAT:
            return False
        k = contacts.earlier[k]
    return True


@jit(inline=True)
def push_of(pads, contacts, k, u):
    """Return d of a candidate after the displacement u [m]."""
    n = contacts.normal
    return max(0.0, pads.ratio[k] * (
        pads.deficit[k] - n[k, 0] * u[0] - n[k, 1] * u[1] - n[k, 2] * u[2]))


@jit(inline=True)
def solve(pads, contacts, last):
    """Return u: solve (I + Σ κ n nᵀ) u = Σ κ b n, and again until the same colliders touch."""
    n, u = contacts.normal, (0.0, 0.0, 0.0)
    if contacts.earlier[last] < 0:
        d = max(0.0, pads.ratio[last] / (1.0 + pads.ratio[last]) * pads.deficit[last])
        return d * n[last, 0], d * n[last, 1], d * n[last, 2]
    for _ in range(TURNS):
        xx, yy, zz, yz, zx, xy = 1.0, 1.0, 1.0, 0.0, 0.0, 0.0
        rx, ry, rz, k = 0.0, 0.0, 0.0, last
        while k >= 0:
            if pads.touches[k]:
                kappa, b = pads.ratio[k], pads.deficit[k]
                x, y, z = n[k, 0], n[k, 1], n[k, 2]
                xx, yy, zz = xx + kappa * x * x, yy + kappa * y * y, zz + kappa * z * z
                yz, zx, xy = yz + kappa * y * z, zx + kappa * z * x, xy + kappa * x * y
                rx, ry, rz = rx + kappa * b * x, ry + kappa * b * y, rz + kappa * b * z
            k = contacts.earlier[k]
        u = solved(xx, yy, zz, yz, zx, xy, rx, ry, rz)
        k, changed = last, False
        while k >= 0:
            touches = pads.deficit[k] - n[k, 0] * u[0] - n[k, 1] * u[1] - n[k, 2] * u[2] > 0.0
            changed |= touches != pads.touches[k]
            pads.touches[k] = touches
            k = contacts.earlier[k]
        if not changed:
            break
    return u


@jit(inline=True)
def solved(xx, yy, zz, yz, zx, xy, rx, ry, rz):
    """Return the solution of a symmetric positive definite 3 × 3 system, by Cholesky's factors."""
    a = sqrt(xx)
    b, c = xy / a, zx / a
    d = sqrt(yy - b * b)
    e = (yz - b * c) / d
    f = sqrt(zz - c * c - e * e)
    x = rx / a
    y = (ry - b * x) / d
    z = (rz - c * x - e * y) / f / f
    y = (y - e * z) / d
    return (x - b * y - c * z) / a, y, z


@jit(inline=True)
def recovered(pads, contacts, last, u):
    """
    Return the part of u that a particle makes, so that no pad recovers too fast.

    Nor is it pressed further out of a wedge than it is too deep in all its colliders together.
    """
    k, share, n = last, 1.0, contacts.normal
    size, most = sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]), 0.0
    while k >= 0:
        along = n[k, 0] * u[0] + n[k, 1] * u[1] + n[k, 2] * u[2]
        if pads.soft[k] and along > 0.0 and pads.deficit[k] > along:
            free = contacts.gap[k] - pads.deficit[k]
            share = min(share, max(0.0, pads.limit[k] - free) / along)
        if pads.touches[k]:
            most += max(0.0, pads.limit[k] - contacts.gap[k] + pads.deficit[k])
        k = contacts.earlier[k]
    return share if size <= most else min(share, most / size)
