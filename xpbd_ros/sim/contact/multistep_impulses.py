"""
Impulses on colliders where the integrator has a history (BDF2, NDF2).

A force f on a particle with a history acts on its velocity over several substeps: its impulse is

    J_n = H f + a J_{n-1} - b J_{n-2}

(``particles.history``), and so it is for a pin (doc/numerics.md 6.3). A particle that touches a
collider takes backward Euler steps: the forces of its neighbours act on it at once, while theirs
act on the neighbours over several substeps. The momentum Σ m v then lacks what is still to come,
h f / 2 for a force that has just begun. As the collider takes that part of the momentum, it is
given the impulse on the particle's neighbours in the same substep, Σ J_n instead of Σ h f:

    R = Σ m (v - v_n - g h) - Σ J_n,   J_n = H f + a J_{n-1} - b J_{n-2}

over the particles marked as the collider's, where h f = m (v - v_n - g h) less the collider's own
impulse. A particle is marked when it comes into contact, and brings m (v_n - v_{n-1} - g h) as
J_{n-1}; it takes the present one away once its steps have a full history again. In between, after
the contact, it takes a backward Euler step and (NDF2) one of BDF2. Where no particle has a
history, all take these steps.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.particles.history import FULL, later, NONE, TOUCHED, weights_before, weights_of

FREE = -1
"""owner of a particle that is not marked"""


class Multistep(NamedTuple):
    """Marked particles, and the impulses that still act; 6 columns: linear, angular."""

    count: np.ndarray
    """number of marked particles, shape (1,)"""
    particle: np.ndarray
    """their slots, shape (slots,)"""
    owner: np.ndarray
    """collider whose contact marked each slot, or FREE; shape (slots,)"""
    before: np.ndarray
    """sums of the wrenches at the substep's start [N s, N m s], shape (capacity, 6)"""
    last: np.ndarray
    """Σ J_{n-1} [N s, N m s], shape (capacity, 6)"""
    older: np.ndarray
    """Σ J_{n-2}, shape (capacity, 6)"""
    fresh: np.ndarray
    """``History.fresh`` of particles that have touched nothing, shape (1,)"""
    now: np.ndarray
    """Σ J_n, shape (capacity, 6)"""
    forces: np.ndarray
    """Σ h f, shape (capacity, 6)"""
    change: np.ndarray
    """Σ m (v - v_n - g h) less the collider's impulse, shape (capacity, 6)"""
    ended: np.ndarray
    """parts of J_n and J_{n-1} that marked particles bring (-) or take away (+), shape
    (2, capacity, 6)"""


def new_multistep(capacity: int, slots: int) -> Multistep:
    """Return an empty list."""
    def sums():
        return np.zeros((capacity, 6))

    return Multistep(np.zeros(1, np.int64), np.zeros(slots, np.int64), np.full(slots, FREE),
                     sums(), sums(), sums(), np.full(1, NONE), sums(), sums(), sums(),
                     np.zeros((2, capacity, 6)))


def forget_multistep(multistep: Multistep) -> None:
    """Unmark all particles."""
    multistep.count[0] = 0
    multistep.owner[:] = FREE
    multistep.last[:] = multistep.older[:] = 0.0


def begin_multistep(multistep: Multistep) -> None:
    """Begin without a history of any particle."""
    forget_multistep(multistep)
    multistep.fresh[0] = NONE


@jit
def spread_impulses(contacts, state, substep):
    """Add -R to each collider's sum, which has the impulses of the substep."""
    _spread(state.history, contacts, state, substep.h)


@jit
def _spread(history, contacts, state, h):
    if history is None:
        return
    else:    # Numba prunes the branch that is not taken
        _spread_all(history, contacts, state, h)


@jit
def _spread_all(history, contacts, state, h):
    spread, colliders = contacts.wrenches.multistep, contacts.colliders.count[0]
    total = contacts.wrenches.impulse
    for c in range(colliders):
        for k in range(6):
            own = total[c, k] - spread.before[c, k]    # - the collider's impulse on the cloth
            spread.forces[c, k] = spread.change[c, k] = own
            spread.now[c, k] = spread.ended[0, c, k] = spread.ended[1, c, k] = 0.0
    known = spread.count[0]
    _mark(history, contacts, spread)
    x, before, v, after = state.x, state.x_prev, history.v, contacts.after
    per, (gx, gy, gz) = 1.0 / h, (h * state.gravity[0], h * state.gravity[1], h * state.gravity[2])
    kept, c, fx, fy, fz, tx, ty, tz = 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(spread.count[0]):
        i = spread.particle[n]
        if history.fresh[i] >= TOUCHED + NONE and state.inv_mass[i] > 0.0:
            # in contact, and without a history before: most particles, summed up in registers
            if spread.owner[i] != c:
                _put_sums(spread, c, fx, fy, fz, tx, ty, tz)
                c, fx, fy, fz, tx, ty, tz = spread.owner[i], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            m, a, b, d = state.mass[i], x[0, i], x[1, i], x[2, i]
            px = m * ((a - before[0, i]) * per - v[0, i] - gx)
            py = m * ((b - before[1, i]) * per - v[1, i] - gy)
            pz = m * ((d - before[2, i]) * per - v[2, i] - gz)
            rx, ry, rz = a - after[c, 0], b - after[c, 1], d - after[c, 2]
            fx, fy, fz = fx + px, fy + py, fz + pz
            tx += ry * pz - rz * py
            ty += rz * px - rx * pz
            tz += rx * py - ry * px
        elif not _add(history, contacts, spread, state, i, n >= known, h):
            spread.owner[i] = FREE
            continue
        spread.particle[kept] = i
        kept += 1
    _put_sums(spread, c, fx, fy, fz, tx, ty, tz)
    spread.count[0] = kept
    share, a, b = weights_of(history, spread.fresh[0])
    spread.fresh[0] = later(history, spread.fresh[0])
    for c in range(colliders):
        for k in range(6):
            last = spread.last[c, k]
            now = (spread.now[c, k] + share * spread.forces[c, k]
                   + a * last - b * spread.older[c, k])
            total[c, k] -= spread.change[c, k] - now
            spread.last[c, k] = now - spread.ended[0, c, k]
            spread.older[c, k] = last - spread.ended[1, c, k]


@jit(inline=True)
def _put_sums(spread, c, fx, fy, fz, tx, ty, tz):
    """Add sums of m (v - v_n - g h) and of their moments to those of collider c."""
    for k, part in enumerate((fx, fy, fz, tx, ty, tz)):
        spread.forces[c, k] += part
        spread.change[c, k] += part


@jit
def _mark(history, contacts, spread):
    """Mark the particles of all contacts that are not marked."""
    slip = contacts.slip
    for k in range(max(0, contacts.count[0])):
        i = contacts.particle[k]
        if spread.owner[i] == FREE and history.fresh[i] >= TOUCHED and (
                contacts.push[k] > 0.0 or slip[k, 0] != 0.0 or slip[k, 1] != 0.0
                or slip[k, 2] != 0.0):
            spread.owner[i] = contacts.collider[k]
            spread.particle[spread.count[0]] = i
            spread.count[0] += 1


@jit
def _add(history, contacts, spread, state, i, new, h):
    """Add the part of a marked particle whose contact begins or has ended; tell if it stays so."""
    if state.inv_mass[i] == 0.0:
        return False    # it is pinned now
    c, fresh, m = spread.owner[i], history.fresh[i], state.mass[i]
    ratio, a, b = weights_before(history, i)
    for k in range(3):
        d, fall = _displacement(contacts, i, k), h * state.gravity[k]
        start = state.x_prev[k, i]
        moved = state.x[k, i] - d - start
        free = (moved - _gone(history, i, k, start, a, b)) / (ratio * h)    # v without contact
        own = 0.0
        if fresh >= TOUCHED:    # the collider's impulse
            own = m * ((state.x[k, i] - start) / h - free)
        part = m * (free - history.v[k, i] - fall)
        _put(contacts, spread.change, c, k, i, state, part + own)
        _put(contacts, spread.forces, c, k, i, state, own)
        if new:
            _put(contacts, spread.now, c, k, i, state, part)
            _put(contacts, spread.ended[1], c, k, i, state,
                 -_before(history.older_v, history, m, i, k, fall))
        else:
            _put(contacts, spread.forces, c, k, i, state,
                 m * (free - state.v[k, i]) / ratio)
        if fresh == FULL:
            _put(contacts, spread.ended[0], c, k, i, state, part)
            _put(contacts, spread.ended[1], c, k, i, state,
                 _before(history.older_v, history, m, i, k, fall))
    return fresh != FULL


@jit(inline=True)
def _put(contacts, sums, c, k, i, state, part):
    """Add an impulse along axis k at particle i, and its moment about collider c's position."""
    p, u, v = contacts.after[c], (k + 1) % 3, (k + 2) % 3
    sums[c, k] += part
    sums[c, 3 + u] += (state.x[v, i] - p[v]) * part
    sums[c, 3 + v] -= (state.x[u, i] - p[u]) * part


@jit(inline=True)
def _displacement(contacts, i, k):
    """Return D of all contacts of particle i along axis k [m]."""
    found, j = 0.0, contacts.latest[i]
    while 0 <= j < contacts.count[0] and contacts.particle[j] == i:
        found += contacts.push[j] * contacts.normal[j, k] + contacts.slip[j, k]
        j = contacts.earlier[j]
    return found


@jit(inline=True)
def _gone(history, i, k, start, a, b):
    """Return x̄ - x_n = a (x_n - x_{n-1}) - b (x_{n-1} - x_{n-2}) along axis k [m]."""
    before = history.x[k, i]
    return a * (start - before) - _older(history.older_x, i, k, before, b)


@jit(inline=True)
def _before(older, history, m, i, k, fall):
    """Return m (v_n - v_{n-1} - g h) along axis k; with BDF2, which needs none, 0 [N s]."""
    if older is None:
        return 0.0
    else:    # Numba prunes the branch that is not taken
        return m * (history.v[k, i] - older[k, i] - fall)


@jit(inline=True)
def _older(older, i, k, before, b):
    if older is None:
        return 0.0
    else:    # Numba prunes the branch that is not taken
        return b * (before - older[k, i])
