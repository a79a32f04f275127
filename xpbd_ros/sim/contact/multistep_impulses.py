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

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd_wide import WIDTH
from xpbd_ros.sim.backend.threads import (
    alone_on_device,
    count_up,
    is_on_device,
    turns,
    turns_on_device,
    wait,
    wait_on_device,
)
from xpbd_ros.sim.contact.pieces import piece, pieces
from xpbd_ros.sim.particles.history import FULL, later, NONE, TOUCHED, weights_before, weights_of

FREE, NEW = -1, -2
"""owner of a particle that is not marked; of one that collider c has just marked: NEW - c"""
PART, CHAINS = 16, 64
"""slots whose sums are added up one after another; sums of such parts, likewise"""
OWN, CHANGE, NOW, ENDED, ENDED_BEFORE, COLUMNS = 0, 6, 12, 18, 24, 30
"""columns of a part's sums, six each: Σ h f; Σ m (v - v_n - g h) less the collider's impulse;
Σ J_n; what particles whose mark ends (+) or begins (-) have of J_n and J_{n-1}"""


class Multistep(NamedTuple):
    """Marked particles, and the impulses that still act; 6 columns: linear, angular."""

    owner: np.ndarray
    """collider whose contact marked each slot, FREE, or NEW - c; shape (slots,)"""
    marked: np.ndarray
    """number of particles marked by each collider, shape (capacity,)"""
    unmarked: np.ndarray
    """number of those whose mark ends in this substep, shape (capacity,)"""
    before: np.ndarray
    """sums of the wrenches at the substep's start [N s, N m s], shape (capacity, 6)"""
    last: np.ndarray
    """Σ J_{n-1} [N s, N m s], shape (capacity, 6)"""
    older: np.ndarray
    """Σ J_{n-2}, shape (capacity, 6)"""
    fresh: np.ndarray
    """``History.fresh`` of particles that have touched nothing, shape (1,)"""
    parts: np.ndarray
    """sums of a part, of every one on a GPU, shape (…, COLUMNS)"""
    chains: np.ndarray
    """sums of every CHAINS-th part, shape (CHAINS, COLUMNS)"""


def new_multistep(capacity: int, slots: int, *, on_device: bool = False) -> Multistep:
    """Return a state without marks."""
    def sums():
        return np.zeros((capacity, 6))

    return Multistep(np.full(slots, FREE), np.zeros(capacity, np.int64),
                     np.zeros(capacity, np.int64), sums(), sums(), sums(), np.full(1, NONE),
                     np.zeros((-(-slots // PART) if on_device else 1, COLUMNS)),
                     np.zeros((CHAINS, COLUMNS)))


def forget_multistep(multistep: Multistep) -> None:
    """Unmark all particles."""
    multistep.owner[:] = FREE
    multistep.marked[:] = 0
    multistep.last[:] = multistep.older[:] = 0.0


def begin_multistep(multistep: Multistep) -> None:
    """Begin without a history of any particle."""
    forget_multistep(multistep)
    multistep.fresh[0] = NONE


@jit
def spread_impulses(history, contacts, state, h):
    """Add -R to each collider's sum, which has the impulses of the substep."""
    spread, colliders, team = contacts.wrenches.multistep, contacts.colliders.count[0], state.team
    mark_all(history, contacts, team)
    for c in range(colliders):
        active = spread.marked[c] > 0
        if active:
            sum_parts(history, contacts, c, state, h)
        begin, end, step = turns_on_device(team, 6)
        for k in range(begin, end, step):
            finish_sums(history, contacts, c, k, active)
        wait_on_device(team)
    begin, end, step = turns_on_device(team, colliders)
    for c in range(begin, end, step):
        spread.marked[c] -= spread.unmarked[c]
        spread.unmarked[c] = 0
    if alone_on_device(team):
        spread.fresh[0] = later(history, spread.fresh[0])


@jit(inline=True)
def finish_sums(history, contacts, c, k, active):
    """Add column k of -R of collider c; ``active``: some particle is marked."""
    spread, total = contacts.wrenches.multistep, contacts.wrenches.impulse
    own = total[c, k] - spread.before[c, k]    # - the collider's impulse on the cloth
    share, a, b = weights_of(history, spread.fresh[0])
    forces, change, begun, ended, ended_before = own, own, 0.0, 0.0, 0.0
    parts = (len(spread.owner) + PART - 1) // PART
    for chain in range(min(CHAINS, parts) if active else 0):
        row = spread.chains[chain]
        forces, change = forces + row[OWN + k], change + row[CHANGE + k]
        begun, ended = begun + row[NOW + k], ended + row[ENDED + k]
        ended_before += row[ENDED_BEFORE + k]
    last = spread.last[c, k]
    now = begun + share * forces + a * last - b * spread.older[c, k]
    total[c, k] -= change - now
    spread.last[c, k] = now - ended
    spread.older[c, k] = last - ended_before


@jit
def mark_all(history, contacts, team):
    """Mark the particles of all contacts that are not marked."""
    spread = contacts.wrenches.multistep
    for c in range(contacts.colliders.count[0] if contacts.count[0] > 0 else 0):
        begin, last = contacts.first[c], contacts.first[c + 1]
        own, count, turn = pieces(team, begin, last)
        found = 0
        for n in range(own, count, turn):
            first, end, step = piece(team, n, begin, last)
            for v in range(first, end, step):
                for k in range(v, min(v + WIDTH, end)):
                    i = contacts.particle[k]
                    if (spread.owner[i] == FREE and history.fresh[i] >= TOUCHED
                            and touches(contacts, k)):
                        spread.owner[i] = NEW - c
                        found += 1
        if found:
            count_up(team, spread.marked, c, found)
        if contacts.count[3]:
            wait_on_device(team)
    wait_on_device(team)


@jit(inline=True)
def touches(contacts, k):
    """Return True if candidate k is a contact."""
    slip = contacts.slip
    return (contacts.push[k] > 0.0 or slip[k, 0] != 0.0 or slip[k, 1] != 0.0
            or slip[k, 2] != 0.0)


def sum_parts(history, contacts, c, state, h):
    """Write the sums over the particles of collider c to ``chains``."""


@inline(sum_parts)
def _sum_parts(history, contacts, c, state, h):
    if is_on_device(state[state.fields.index('team')]):
        return lambda history, contacts, c, state, h: sum_by_all(history, contacts, c, state, h)
    return lambda history, contacts, c, state, h: sum_alone(history, contacts, c, state, h)


@jit
def sum_alone(history, contacts, c, state, h):
    """Do so on one thread of a CPU."""
    spread = contacts.wrenches.multistep
    spread.chains[:] = 0.0
    for part in range((len(spread.owner) + PART - 1) // PART):
        if sum_part(history, contacts, c, part, 0, state, h):
            chain = spread.chains[part % CHAINS]
            for k in range(COLUMNS):
                chain[k] += spread.parts[0, k]


@jit
def sum_by_all(history, contacts, c, state, h):
    """Do so on a GPU: a part is one thread's, and a column of a chain."""
    spread, team = contacts.wrenches.multistep, state.team
    begin, end, step = turns(team, len(spread.parts))
    for part in range(begin, end, step):
        sum_part(history, contacts, c, part, part, state, h)
    wait(team)
    begin, end, step = turns(team, CHAINS * COLUMNS)
    for n in range(begin, end, step):
        chain, k, found = n // COLUMNS, n % COLUMNS, 0.0
        for part in range(chain, len(spread.parts), CHAINS):
            found += spread.parts[part, k]
        spread.chains[chain, k] = found
    wait(team)


@jit(inline=True)
def sum_part(history, contacts, c, part, row, state, h):
    """Write the sums of a part to a row of ``parts``; return whether there is any particle."""
    spread, p = contacts.wrenches.multistep, contacts.after[c]
    sums, x, before, v = spread.parts[row], state.x, state.x_prev, history.v
    per, (gx, gy, gz) = 1.0 / h, (h * state.gravity[0], h * state.gravity[1], h * state.gravity[2])
    found, fx, fy, fz, tx, ty, tz = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(COLUMNS):
        sums[k] = 0.0
    for i in range(part * PART, min((part + 1) * PART, len(spread.owner))):
        owner = spread.owner[i]
        if owner != c and owner != NEW - c:
            continue
        found = 1
        spread.owner[i] = c
        if history.fresh[i] >= TOUCHED + NONE and state.inv_mass[i] > 0.0:
            # in contact, and without a history before: most particles, summed up in registers
            m, a, b, d = state.mass[i], x[0, i], x[1, i], x[2, i]
            px = m * ((a - before[0, i]) * per - v[0, i] - gx)
            py = m * ((b - before[1, i]) * per - v[1, i] - gy)
            pz = m * ((d - before[2, i]) * per - v[2, i] - gz)
            rx, ry, rz = a - p[0], b - p[1], d - p[2]
            fx, fy, fz = fx + px, fy + py, fz + pz
            tx += ry * pz - rz * py
            ty += rz * px - rx * pz
            tz += rx * py - ry * px
        elif not _add(history, contacts, sums, c, state, i, owner != c, h):
            spread.owner[i] = FREE
            count_up(state.team, spread.unmarked, c, 1)
    for k, part_sum in enumerate((fx, fy, fz, tx, ty, tz)):
        sums[OWN + k] += part_sum
        sums[CHANGE + k] += part_sum
    return found


@jit
def _add(history, contacts, sums, c, state, i, new, h):
    """Add the part of a marked particle whose contact begins or has ended; tell if it stays so."""
    if state.inv_mass[i] == 0.0:
        return False    # it is pinned now
    fresh, m, p = history.fresh[i], state.mass[i], contacts.after[c]
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
        _put(sums, CHANGE, p, k, i, state, part + own)
        _put(sums, OWN, p, k, i, state, own)
        if new:
            _put(sums, NOW, p, k, i, state, part)
            _put(sums, ENDED_BEFORE, p, k, i, state,
                 -_before(history.older_v, history, m, i, k, fall))
        else:
            _put(sums, OWN, p, k, i, state, m * (free - state.v[k, i]) / ratio)
        if fresh == FULL:
            _put(sums, ENDED, p, k, i, state, part)
            _put(sums, ENDED_BEFORE, p, k, i, state,
                 _before(history.older_v, history, m, i, k, fall))
    return fresh != FULL


@jit(inline=True)
def _put(sums, column, p, k, i, state, part):
    """Add an impulse along axis k at particle i, and its moment about the position p."""
    u, v = (k + 1) % 3, (k + 2) % 3
    sums[column + k] += part
    sums[column + 3 + u] += (state.x[v, i] - p[v]) * part
    sums[column + 3 + v] -= (state.x[u, i] - p[u]) * part


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
