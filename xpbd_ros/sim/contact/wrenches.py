"""
Wrenches of the cloth on colliders: sums of impulses over a frame.

The impulses of a collider's candidates are added up in chunks of CHUNK candidates, in each of them
as LANES partial sums; candidate n of a collider adds to sum n mod LANES of chunk n / CHUNK. So
lanes of a vector, and threads of a GPU, add side by side, and the order of all additions is the
same for each of them.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import any_lane, bits, both, lowest_bit
from xpbd_ros.sim.backend.simd_wide import load_columns, store_wide, WIDTH
from xpbd_ros.sim.backend.threads import turns, wait, worker
from xpbd_ros.sim.contact.multistep_impulses import Multistep, new_multistep
from xpbd_ros.sim.contact.pieces import candidate, CHUNK, LANES, over_lanes, rounds
from xpbd_ros.sim.geometry import quaternion
from xpbd_ros.sim.particles.explicit_updates import half_of, stay

TURNED = 1e-4
"""change of a contact's normal in a substep up to which its push is one displacement"""
CHAINS = 64
"""chunks whose sums are added up side by side"""


class Wrenches(NamedTuple):
    """Impulses that colliders got from the cloth."""

    impulse: np.ndarray
    """linear [N s] and angular about the collider's position, world axes [N m s]; sum over the
    frame; shape (capacity, 6)"""
    partial: np.ndarray
    """partial sums of the impulses on particles, 0 between the stages of a substep; a collider's
    chunks begin at ``first_chunk``; shape (chunks, 6, LANES)"""
    h: np.ndarray
    """length of the substep [s], shape (1,)"""
    multistep: Multistep
    """parts of forces that still act on velocities"""


def new_wrenches(capacity: int, slots: int, room: int, threads: int, *,
                 on_device: bool) -> Wrenches:
    """Return zero wrenches of ``capacity`` colliders, for ``room`` candidates."""
    return Wrenches(np.zeros((capacity, 6)), np.zeros((room // CHUNK + capacity + 1, 6, LANES)),
                    np.zeros(1), new_multistep(capacity, slots, threads, on_device=on_device))


@jit
def begin_wrenches(wrenches, substep):
    """Note the sums at a substep's start."""
    wrenches.h[0] = substep.h
    for c in range(len(wrenches.impulse)):
        for k in range(6):
            wrenches.multistep.before[c, k] = wrenches.impulse[c, k]


@jit(inline=True)
def first_chunk(contacts, c):
    """Return the first chunk of collider c: those before have room for their candidates."""
    return contacts.first[c] // CHUNK + c


@jit
def add_reaction(contacts, k, state, i, x, y, z):
    """Add the impulse (x, y, z) [N s] of candidate k on its particle i to the partial sums."""
    c = contacts.collider[k]
    n, p = k - contacts.first[c], contacts.after[c]
    sums, lane = contacts.wrenches.partial[first_chunk(contacts, c) + n // CHUNK], n % LANES
    rx, ry, rz = state.x[0, i] - p[0], state.x[1, i] - p[1], state.x[2, i] - p[2]
    sums[0, lane] += x
    sums[1, lane] += y
    sums[2, lane] += z
    sums[3, lane] += ry * z - rz * y
    sums[4, lane] += rz * x - rx * z
    sums[5, lane] += rx * y - ry * x


@jit
def sum_up(contacts, team):
    """Subtract the partial sums, which are 0 then, from the colliders' sums."""
    if contacts.count[0] <= 0:
        return
    partial, total = contacts.wrenches.partial, contacts.wrenches.impulse
    count = contacts.colliders.count[0]
    begin, end, step = turns(team, 6 * first_chunk(contacts, count))
    for n in range(begin, end, step):
        q = partial[n // 6, n % 6]
        q[0] = over_lanes(q)
        for lane in range(1, LANES):
            q[lane] = 0.0
    wait(team)
    for c in range(count):
        first, chunks = first_chunk(contacts, c), chunks_of(contacts, c)
        begin, end, step = turns(team, 6 * CHAINS if chunks > CHAINS else 0)
        for n in range(begin, end, step):
            a, chain = n % 6, first + n // 6
            for chunk in range(chain + CHAINS, first + chunks, CHAINS):
                partial[chain, a, 0] += partial[chunk, a, 0]
                partial[chunk, a, 0] = 0.0
    wait(team)
    for c in range(count):
        first = first_chunk(contacts, c)
        begin, end, step = turns(team, 6)
        for a in range(begin, end, step):
            found = 0.0
            for chunk in range(first, first + min(CHAINS, chunks_of(contacts, c))):
                found += partial[chunk, a, 0]
                partial[chunk, a, 0] = 0.0
            total[c, a] -= found
    wait(team)


@jit(inline=True)
def chunks_of(contacts, c):
    """Return the number of chunks of collider c."""
    return (contacts.first[c + 1] - contacts.first[c] + CHUNK - 1) // CHUNK


@jit
def bear_half_kick(contacts, state, substep):
    """
    Let particles in contact keep v in a half kick of the leapfrog; their colliders bear it.

    A push is an impulse in every substep, without a half at a frame's ends. What acts on a
    particle besides it, ±½ h F with F the weight and the sum of ``apart.move``, h² F / m, goes to
    its colliders, in proportion to their pushes.
    """
    team, push, count = state.team, contacts.push, contacts.colliders.count[0]
    for c in range(count if contacts.count[0] > 0 else 0):
        begin, last = contacts.first[c], contacts.first[c + 1]
        for n in range(rounds(team, begin, last)):
            first = candidate(team, n, begin)
            for k in range(first, min(first + WIDTH, last)):
                if push[k] > 0.0 and state.inv_mass[contacts.particle[k]] > 0.0:
                    bear(contacts, k, state, substep)
    wait(team)
    begin, end, step = turns(team, contacts.count[0])
    for k in range(begin, end, step):
        if contacts.latest[contacts.particle[k]] == k and is_pushed(contacts, k):
            stay(state, contacts.particle[k], substep.h)
    sum_up(contacts, team)


@jit(inline=True)
def is_pushed(contacts, k):
    """Return True if a collider pushes the particle whose last candidate is k."""
    while k >= 0:
        if contacts.push[k] > 0.0:
            return True
        k = contacts.earlier[k]
    return False


@jit(inline=True)
def bear(contacts, k, state, substep):
    """Add the part of candidate k's particle to the wrench on its collider."""
    i, d = contacts.particle[k], 0.0
    j = contacts.latest[i]
    while j >= 0:
        d += contacts.push[j]
        j = contacts.earlier[j]
    h, move, g = substep.h, state.apart.move, state.gravity
    share = -half_of(substep) * state.mass[i] * contacts.push[k] / d
    add_reaction(contacts, k, state, i, share * (move[0, i] / h + h * g[0]),
                 share * (move[1, i] / h + h * g[1]), share * (move[2, i] / h + h * g[2]))


def work_of_colliders(impulse, colliders, dt: float) -> float:
    """Return a bound of the work of moving colliders, by the impulses on them in a frame [J]."""
    moves = np.flatnonzero((colliders.moving | colliders.has_twist)[:colliders.count[0]])
    if not len(moves):
        return 0.0
    start, goal = colliders.start[moves], colliders.goal[moves]
    speed = np.abs(np.hstack([goal[:, :3] - start[:, :3],
                              quaternion.turns(start[:, 3:], goal[:, 3:])])) / dt
    given = colliders.has_twist[moves, None] * np.abs(colliders.twist[moves])
    return float((np.abs(impulse[moves]) * (speed + given)).sum())


@jit
def react_to_turns(contacts, k, state, again, nx, ny, nz):
    """Call ``react_to_turn`` for the lanes of the mask."""
    mx, my, mz = load_columns(contacts.normal, k)
    if any_lane(both(again, is_turned(mx - nx, my - ny, mz - nz))):
        scratch, chosen = contacts.scratch[worker(state.team)], bits(again)
        store_wide(scratch, 0, nx)
        store_wide(scratch, WIDTH, ny)
        store_wide(scratch, 2 * WIDTH, nz)
        while chosen != 0:
            l = lowest_bit(chosen)
            chosen &= chosen - 1
            react_to_turn(contacts, k + l, state, contacts.push[k + l], scratch[0, l],
                          scratch[1, l], scratch[2, l])


@jit
def react_to_turn(contacts, k, state, before, nx, ny, nz):
    """
    React to d (n - n'), where a candidate with a push d so far gets a new normal n'.

    The displacement d n then counts as d n' (``contact.impulses``).
    """
    i, n = contacts.particle[k], contacts.normal[k]
    x, y, z = n[0] - nx, n[1] - ny, n[2] - nz
    if is_turned(x, y, z):
        share = contacts.wrenches.h[0] / state.mobility[i] * before
        add_reaction(contacts, k, state, i, share * x, share * y, share * z)


@jit(inline=True)
def is_turned(x, y, z):
    """Return True if the difference (x, y, z) of two normals matters; also for vectors."""
    return x * x + y * y + z * z > TURNED**2
