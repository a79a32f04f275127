"""
Impulses of the contacts of a substep, from the displacements that they caused.

A displacement D of a particle with the mobility m is the work of a force D / m, so its impulse is

    J = (H² / h) D / m,   D = d n + s

with d the push along the normal n and s the displacement by friction. H is h but for a particle
that comes into contact: its positions were predicted with a history, and its velocity becomes that
of backward Euler (``particles.history``). So without contact it would have had another velocity,
and the collider gives

    J = m (v - v_free),   v = (x - x_n) / h,   v_free = (x - D - x̄) / H

which is the J above plus mass ((x - D - x_n) / h - v_free). The cloth's momentum is then the sum
of all impulses on it (doc/numerics.md 7.8). Pads whose friction was solved with their pushes have
a displacement u that differs from Σ d n across the clamp; both colliders bear half of that.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import any_lane, both, either
from xpbd_ros.sim.backend.simd_wide import load_columns, load_wide, WIDTH
from xpbd_ros.sim.backend.threads import wait, worker, workers
from xpbd_ros.sim.contact.contacts import wait_for_others
from xpbd_ros.sim.contact.corners import add_extra, add_later, note_extra
from xpbd_ros.sim.contact.multistep_impulses import mark, mark_pack, older_part, spread_impulses
from xpbd_ros.sim.contact.particle_lanes import numbers, positions
from xpbd_ros.sim.contact.pieces import add_lanes, candidate, CHUNK, LANES, rounds
from xpbd_ros.sim.contact.wrenches import add_reaction, first_chunk, sum_up
from xpbd_ros.sim.particles.history import NONE, TOUCHED, weights_before


@jit
def add_impulses(contacts, state, substep):
    """Add the reactions to the impulses of all contacts of this substep to the wrenches."""
    if contacts.count[0] > 0:
        for c in range(contacts.colliders.count[0]):
            if contacts.first[c] < contacts.first[c + 1]:
                add_collider(contacts, c, state, substep)
        add_rest_of_pads(contacts.pads, contacts, state, substep)
        add_extra(contacts, state)
    sum_up_and_spread(state.history, contacts, state, substep.h)


@jit
def sum_up_and_spread(history, contacts, state, h):
    """Do what an integrator with a history needs; ``contact.restitution`` adds to the sums."""
    if history is not None:
        wait(state.team)
        sum_up(contacts, state.team)
        spread_impulses(history, contacts, state, h)


@jit(inline=True)
def add_collider(contacts, c, state, substep):
    """Add the impulses of the candidates of collider c to the partial sums."""
    team, begin, last = state.team, contacts.first[c], contacts.first[c + 1]
    for n in range(rounds(team, begin, last)):
        k = candidate(team, n, begin)
        if not (WIDTH > 1 and k + WIDTH <= last and add_pack(contacts, c, k, state, substep.h)):
            for j in range(k, min(k + WIDTH, last)):
                add_candidate(contacts, j, state, substep.h)
                mark(state.history, contacts, c, j, state)
    wait_for_others(contacts, team)    # the first collider marks a particle


@jit(inline=True)
def add_pack(contacts, c, k, state, h):
    """
    Add the impulses of the candidates k, k + 1, … of collider c by lanes.

    Return False if one of them has just come into contact.
    """
    index, partial, p = contacts.particle, contacts.wrenches.partial, contacts.after[c]
    push, (sx, sy, sz) = load_wide(contacts.push, k), load_columns(contacts.slip, k)
    active = either(push > 0.0, sx * sx + sy * sy + sz * sz > 0.0)
    if not any_lane(active):
        return True
    if begins(state.history, index, k, active):
        return False
    nx, ny, nz = load_columns(contacts.normal, k)
    per = h / numbers(state.mobility, index, k)
    fx, fy, fz = per * (push * nx + sx), per * (push * ny + sy), per * (push * nz + sz)
    x, y, z = positions(state.x, index, k)
    rx, ry, rz = x - p[0], y - p[1], z - p[2]
    mark_pack(state.history, contacts, c, k, state, active)
    n = k - contacts.first[c]
    begin = (first_chunk(contacts, c) + n // CHUNK) * 6 * LANES + n % LANES
    add_lanes(partial, begin, rx, ry, rz, fx, fy, fz)
    return True


@jit(inline=True)
def begins(history, index, k, active):
    """Return True if a particle index[k], … in the lanes of the mask had a history."""
    if history is None:
        return False
    else:    # Numba prunes the branch that is not taken
        return any_lane(both(active, numbers(history.fresh, index, k) < TOUCHED + NONE))


@jit(inline=True)
def displacement(contacts, k):
    """Return D of candidate k, and whether it is a contact."""
    d, n, s = contacts.push[k], contacts.normal, contacts.slip
    x, y, z = s[k, 0], s[k, 1], s[k, 2]
    touches = d > 0.0 or x * x + y * y + z * z > 0.0
    return (d * n[k, 0] + x, d * n[k, 1] + y, d * n[k, 2] + z), touches


@jit
def add_candidate(contacts, k, state, h):
    """Add the impulse of candidate k."""
    i = contacts.particle[k]
    (x, y, z), touches = displacement(contacts, k)
    if touches:
        ratio = weights_before(state.history, i)[0]
        per = h * ratio * ratio / state.mobility[i]
        gx, gy, gz = change_of_integrator(state.history, contacts, k, state, h)
        add_reaction(contacts, k, state, i, per * x + gx, per * y + gy, per * z + gz)


@jit
def change_of_integrator(history, contacts, k, state, h):
    """
    Return mass ((x - D - x_n) / h - v_free) of a particle that comes into contact [N s].

    It goes to the first collider that the particle touches; others get 0.
    """
    if history is None:
        return 0.0, 0.0, 0.0
    else:    # Numba prunes the branch that is not taken
        return _change_of_integrator(history, contacts, k, state, h)


@jit
def _change_of_integrator(history, contacts, k, state, h):
    i = contacts.particle[k]
    ratio, a, b = weights_before(history, i)
    dx, dy, dz, first, j = 0.0, 0.0, 0.0, k, contacts.latest[i]
    while j >= 0:
        (x, y, z), touches = displacement(contacts, j)
        dx, dy, dz = dx + x, dy + y, dz + z
        if touches:
            first = j
        j = contacts.earlier[j]
    if ratio == 1.0 or first != k:
        return 0.0, 0.0, 0.0
    m = state.mass[i] / h
    return (m * difference(state, history.older_x, i, 0, dx, ratio, a, b),
            m * difference(state, history.older_x, i, 1, dy, ratio, a, b),
            m * difference(state, history.older_x, i, 2, dz, ratio, a, b))


@jit(inline=True)
def difference(state, older, i, axis, d, ratio, a, b):
    """Return (x - D - x_n) - h v_free along one axis [m]."""
    start, before = state.x_prev[axis, i], state.history.x[axis, i]
    moved, gone = state.x[axis, i] - d - start, a * (start - before)
    return moved - (moved - gone + older_part(older, axis, i, before, b)) / ratio


@jit
def add_rest_of_pads(pads, contacts, state, substep):
    """Add the impulses of u - Σ d n of clamped particles, half to each of both colliders."""
    if pads is not None:
        n, d, found = contacts.normal, pads.given, 0
        for k in range(worker(state.team), contacts.count[0], workers(state.team)):
            i, j = contacts.particle[k], contacts.earlier[k]
            if pads.clamped[k] and contacts.latest[i] == k and j >= 0:
                ratio = weights_before(state.history, i)[0]
                share = 0.5 * substep.h * ratio * ratio / state.mobility[i]
                u = pads.shift[k]
                x = share * (u[0] - d[j] * n[j, 0] - d[k] * n[k, 0])
                y = share * (u[1] - d[j] * n[j, 1] - d[k] * n[k, 1])
                z = share * (u[2] - d[j] * n[j, 2] - d[k] * n[k, 2])
                add_later(contacts, j, x, y, z)
                add_later(contacts, k, x, y, z)
                found = 1
        note_extra(contacts, state.team, found)
        wait(state.team)
