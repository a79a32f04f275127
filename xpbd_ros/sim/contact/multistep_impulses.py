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
from xpbd_ros.sim.backend.simd import any_lane, both, either, select
from xpbd_ros.sim.backend.simd_wide import load_wide, WIDTH
from xpbd_ros.sim.backend.threads import (
    alone,
    count_up,
    is_on_device,
    share,
    turns,
    wait,
    worker,
)
from xpbd_ros.sim.contact.particle_lanes import block, numbers
from xpbd_ros.sim.contact.pieces import add_lanes, LANES, over_lanes
from xpbd_ros.sim.particles.history import (
    fullest,
    later,
    NONE,
    TOUCHED,
    weights_before,
    weights_of,
)

FREE, NEW = -1, -2
"""owner of a particle that is not marked; of one that collider c has just marked: NEW - c"""
PART, CHAINS = 64, 64
"""slots of a part, whose sums are in LANES; parts whose sums are added up side by side"""
OWN, CHANGE, NOW, ENDED, ENDED_BEFORE, USUAL, COLUMNS = 0, 6, 12, 18, 24, 30, 36
"""columns of a part's sums, six each: Σ h f; Σ m (v - v_n - g h) less the collider's impulse;
Σ J_n; what particles whose mark ends (+) or begins (-) have of J_n and J_{n-1}; what is in both of
the first, of particles in contact"""


class Multistep(NamedTuple):
    """Marked particles, and the impulses that still act; 6 columns: linear, angular."""

    owner: np.ndarray
    """collider whose contact marked each slot, FREE, or NEW - c; float64, shape (slots,)"""
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
    """sums of a part for each thread, of every part on a GPU, shape (…, COLUMNS, LANES)"""
    chains: np.ndarray
    """sums of every CHAINS-th part, shape (CHAINS, USUAL)"""


def new_multistep(capacity: int, slots: int, threads: int, *, on_device: bool) -> Multistep:
    """Return a state without marks."""
    def sums():
        return np.zeros((capacity, 6))

    return Multistep(np.full(slots, float(FREE)), np.zeros(capacity, np.int64),
                     np.zeros(capacity, np.int64), sums(), sums(), sums(), np.full(1, NONE),
                     np.zeros((-(-slots // PART) if on_device else threads, COLUMNS, LANES)),
                     np.zeros((CHAINS, USUAL)))


def begin_multistep(multistep: Multistep) -> None:
    """Begin without a history of any particle, and without marks."""
    multistep.owner[:] = FREE
    multistep.marked[:] = 0
    multistep.last[:] = multistep.older[:] = 0.0
    multistep.fresh[0] = NONE


@jit
def spread_impulses(history, contacts, state, h):
    """Add -R to each collider's sum, which has the impulses of the substep."""
    spread, colliders, team = contacts.wrenches.multistep, contacts.colliders.count[0], state.team
    for c in range(colliders):
        active = spread.marked[c] > 0
        if active:
            sum_parts(history, contacts, c, state, h)
        begin, end, step = turns(team, 6)
        for k in range(begin, end, step):
            finish_sums(history, contacts, c, k, active)
        if active:    # the next one takes the same chains
            wait(team)
    wait(team)
    begin, end, step = turns(team, colliders)
    for c in range(begin, end, step):
        spread.marked[c] -= spread.unmarked[c]
        spread.unmarked[c] = 0
    if alone(team):
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


@jit(inline=True)
def mark_pack(history, contacts, c, k, state, active):
    """Mark the particles of the contacts k, k + 1, … in the lanes of the mask."""
    if history is None:
        return
    else:    # Numba prunes the branch that is not taken
        owner = numbers(contacts.wrenches.multistep.owner, contacts.particle, k)
        if any_lane(both(active, is_equal(owner, FREE))):
            for j in range(k, k + WIDTH):
                mark(history, contacts, c, j, state)


@jit
def mark(history, contacts, c, k, state):
    """Mark the particle of candidate k of collider c if it is a contact and is not marked."""
    if history is None:
        return
    else:    # Numba prunes the branch that is not taken
        i, spread = contacts.particle[k], contacts.wrenches.multistep
        if spread.owner[i] == FREE and history.fresh[i] >= TOUCHED and touches(contacts, k):
            spread.owner[i] = NEW - c
            count_up(state.team, spread.marked, c, 1)


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
    return lambda history, contacts, c, state, h: sum_by_lanes(history, contacts, c, state, h)


@jit
def sum_by_lanes(history, contacts, c, state, h):
    """Do so on a CPU, where each thread has some of the chains."""
    spread, team = contacts.wrenches.multistep, state.team
    first, last = share(team, CHAINS)
    spread.chains[first:last] = 0.0
    parts = (len(spread.owner) + PART - 1) // PART
    for begin in range(0, parts, CHAINS):
        for part in range(begin + first, min(begin + last, parts)):
            sum_part(history, contacts, spread.parts[worker(team)], part, c, state, h)
    wait(team)


@jit(inline=True)
def sum_part(history, contacts, sums, part, c, state, h):
    """Add the sums of a part, with ``sums`` to do so in, to its chain."""
    spread, found, rare = contacts.wrenches.multistep, False, False
    end = min((part + 1) * PART, len(spread.owner))
    for q in range(part * PART, end, WIDTH):
        owner = load_wide(spread.owner, q)
        mine, new = is_equal(owner, c), is_equal(owner, NEW - c)
        if any_lane(either(mine, new)):
            if not found:
                sums[USUAL:] = 0.0
            found = True
            if any_lane(new) or not add_usual(history, contacts, sums, c, mine, q, state, h):
                if not rare:
                    sums[:USUAL] = 0.0
                rare = True
                for i in range(q, q + WIDTH):
                    add_particle(history, contacts, sums, c, i, state, h)
    if found:
        chain = spread.chains[part % CHAINS]
        for k in range(USUAL if rare else NOW):
            chain[k] += sum_of(sums, k, rare)


@jit(inline=True)
def is_equal(a, number):
    """Return the mask of the lanes that are a number."""
    return both(a >= float(number), a <= float(number))


@jit(inline=True)
def sum_of(sums, k, rare):
    """Return column k of a part: the sum of its lanes, and for the first of what is usual."""
    found = over_lanes(sums[k]) if rare else 0.0
    return found + over_lanes(sums[USUAL + k % 6]) if k < NOW else found


@jit
def sum_by_all(history, contacts, c, state, h):
    """Do so on a GPU: a lane of a part is one thread's, and then a column of a chain."""
    spread, team = contacts.wrenches.multistep, state.team
    begin, end, step = turns(team, LANES * len(spread.parts))
    for n in range(begin, end, step):
        part, lane = n // LANES, n % LANES
        for k in range(COLUMNS):
            spread.parts[part, k, lane] = 0.0
        for i in range(part * PART + lane, min((part + 1) * PART, len(spread.owner)), LANES):
            add_particle(history, contacts, spread.parts[part], c, i, state, h)
    wait(team)
    begin, end, step = turns(team, CHAINS * USUAL)
    for n in range(begin, end, step):
        chain, k, found = n // USUAL, n % USUAL, 0.0
        for part in range(chain, len(spread.parts), CHAINS):
            found += sum_of(spread.parts[part], k, True)
        spread.chains[chain, k] = found
    wait(team)


@jit(inline=True)
def add_usual(history, contacts, sums, c, mine, q, state, h):
    """
    Add m (v - v_n - g h) of the particles q, q + 1, … in the lanes of the mask to what is usual.

    Return False if one of them is not in contact, or had a history before.
    """
    fresh, pinned = load_wide(history.fresh, q), load_wide(state.inv_mass, q) <= 0.0
    if any_lane(both(mine, either(fresh < TOUCHED + NONE, pinned))):
        return False
    slots, g, p, per = len(state.inv_mass), state.gravity, contacts.after, 1.0 / h
    m = load_wide(state.mass, q)
    x, y, z = block(state.x, slots, q)
    x0, y0, z0 = block(state.x_prev, slots, q)
    vx, vy, vz = block(history.v, slots, q)
    px = select(mine, m * ((x - x0) * per - vx - h * g[0]), 0.0)
    py = select(mine, m * ((y - y0) * per - vy - h * g[1]), 0.0)
    pz = select(mine, m * ((z - z0) * per - vz - h * g[2]), 0.0)
    rx, ry, rz = x - p[c, 0], y - p[c, 1], z - p[c, 2]
    add_lanes(sums, USUAL * LANES + q % LANES, rx, ry, rz, px, py, pz)
    return True


@jit(inline=True)
def gained(history, state, k, i, h):
    """Return m (v - v_n - g h) of a particle along axis k, in float64 as by lanes."""
    v = (np.float64(state.x[k, i]) - state.x_prev[k, i]) * (1.0 / h)
    return state.mass[i] * (v - history.v[k, i] - h * state.gravity[k])


@jit
def add_particle(history, contacts, sums, c, i, state, h):
    """Add what particle i has, if it is marked by collider c; its mark may end."""
    spread, lane = contacts.wrenches.multistep, i % LANES
    owner = spread.owner[i]
    if owner != c and owner != NEW - c:
        return
    spread.owner[i] = c
    if history.fresh[i] >= TOUCHED + NONE and state.inv_mass[i] > 0.0:
        p = contacts.after
        px, py, pz = (gained(history, state, 0, i, h), gained(history, state, 1, i, h),
                      gained(history, state, 2, i, h))
        rx, ry, rz = state.x[0, i] - p[c, 0], state.x[1, i] - p[c, 1], state.x[2, i] - p[c, 2]
        sums[USUAL, lane] += px
        sums[USUAL + 1, lane] += py
        sums[USUAL + 2, lane] += pz
        sums[USUAL + 3, lane] += ry * pz - rz * py
        sums[USUAL + 4, lane] += rz * px - rx * pz
        sums[USUAL + 5, lane] += rx * py - ry * px
    elif not _add(history, contacts, sums, lane, c, state, i, owner != c, h):
        spread.owner[i] = FREE
        count_up(state.team, spread.unmarked, c, 1)


@jit
def _add(history, contacts, sums, lane, c, state, i, new, h):
    """Add the part of a marked particle whose contact begins or has ended; tell if it stays so."""
    if state.inv_mass[i] == 0.0:
        return False    # it is pinned now
    fresh, m, p = history.fresh[i], state.mass[i], contacts.after[c]
    ends = fresh <= fullest(history)
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
        _put(sums, CHANGE, lane, p, k, i, state, part + own)
        _put(sums, OWN, lane, p, k, i, state, own)
        if new:
            _put(sums, NOW, lane, p, k, i, state, part)
            _put(sums, ENDED_BEFORE, lane, p, k, i, state,
                 -_before(history.older_v, history, m, i, k, fall))
        else:
            _put(sums, OWN, lane, p, k, i, state, m * (free - state.v[k, i]) / ratio)
        if ends:
            _put(sums, ENDED, lane, p, k, i, state, part)
            _put(sums, ENDED_BEFORE, lane, p, k, i, state,
                 _before(history.older_v, history, m, i, k, fall))
    return not ends


@jit(inline=True)
def _put(sums, column, lane, p, k, i, state, part):
    """Add an impulse along axis k at particle i, and its moment about the position p."""
    u, v = (k + 1) % 3, (k + 2) % 3
    sums[column + k, lane] += part
    sums[column + 3 + u, lane] += (state.x[v, i] - p[v]) * part
    sums[column + 3 + v, lane] -= (state.x[u, i] - p[u]) * part


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
    return a * (start - before) - older_part(history.older_x, k, i, before, b)


@jit(inline=True)
def _before(older, history, m, i, k, fall):
    """Return m (v_n - v_{n-1} - g h) along axis k; with BDF2, which needs none, 0 [N s]."""
    if older is None:
        return 0.0
    else:    # Numba prunes the branch that is not taken
        return m * (history.v[k, i] - older[k, i] - fall)


@jit(inline=True)
def older_part(older, k, i, before, b):
    """Return b (x_{n-1} - x_{n-2}) along axis k [m]; ``older`` is None with BDF2."""
    if older is None:
        return 0.0
    else:    # Numba prunes the branch that is not taken
        return b * (before - older[k, i])
