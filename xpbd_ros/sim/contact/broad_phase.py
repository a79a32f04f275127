"""
Broad phase: candidates, the pairs of particle and collider that may touch in a substep.

They are in the order of the colliders, and of the slots for each of them.
"""

from numba import types

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import bits, count_bits, lowest_bit
from xpbd_ros.sim.backend.simd_wide import (
    load_wide,
    store_columns,
    store_integers,
    store_wide,
    WIDTH,
)
from xpbd_ros.sim.backend.threads import (
    alone,
    count_up,
    is_on_device,
    share,
    wait,
    worker,
    workers,
)
from xpbd_ros.sim.contact.contacts import room_of
from xpbd_ros.sim.contact.device_search import search_by_all
from xpbd_ros.sim.contact.near_blocks import ALL, UP, update_near_blocks
from xpbd_ros.sim.contact.pads import begin_pad
from xpbd_ros.sim.contact.reach import distances_to_keep, in_reach
from xpbd_ros.sim.contact.restitution import note_approach


def find_candidates(contacts, bounce, state, substep):
    """
    List the candidates of this substep, and the gap that each has to keep.

    ``bounce`` (``contact.restitution``, or None) receives their velocities of approach.
    """


@inline(find_candidates)
def _find_candidates(contacts, bounce, state, substep):
    team = state[state.fields.index('team')]
    if is_on_device(team):
        return lambda contacts, bounce, state, substep: search_by_all(
            contacts.marks, contacts, bounce, state, substep)
    if isinstance(team, types.NoneType):
        return lambda contacts, bounce, state, substep: search(contacts, bounce, state, substep)
    return lambda contacts, bounce, state, substep: search_together(
        contacts, bounce, state, substep)


@jit
def search(contacts, bounce, state, substep):
    """Do so on one thread."""
    near, k = contacts.near, 0
    begin_search(contacts, state)
    for c in range(contacts.colliders.count[0]):
        listed, begin, end = blocks_of(near, c, state)
        for n in range(begin, end):
            q = near.block[n] if listed else n * WIDTH
            chosen = chosen_of(contacts, state, c, q)
            if chosen:
                k = enter(contacts, bounce, state, substep, c, q, chosen, k, room_of(contacts))
        contacts.first[c + 1] = contacts.count[0] = k


@jit
def search_together(contacts, bounce, state, substep):
    """
    Do so on the threads of a CPU, of which each takes a part of the blocks.

    All count their candidates before they enter them, behind those of the threads before.
    """
    team, near = state.team, contacts.near
    wait(team)    # until all have read the count of candidates
    if alone(team):
        begin_search(contacts, state)
    wait(team)
    for c in range(contacts.colliders.count[0]):
        listed, begin, end = blocks_of(near, c, state)
        if begin == end:    # out of reach
            if alone(team):
                contacts.first[c + 1] = contacts.first[c]
            continue
        (first, last), found = share(team, end - begin), 0
        for n in range(first, last):
            q = near.block[begin + n] if listed else n * WIDTH
            near.chosen[n] = chosen_of(contacts, state, c, q)
            found += count_bits(near.chosen[n])
        near.found[worker(team)] = found
        wait(team)
        k = contacts.first[c]
        for other in range(worker(team)):
            k += near.found[other]
        k = min(k, room_of(contacts))
        limit = min(k + found, room_of(contacts))
        for n in range(first, last):
            if near.chosen[n]:
                q = near.block[begin + n] if listed else n * WIDTH
                k = enter(contacts, bounce, state, substep, c, q, near.chosen[n], k, limit)
        if worker(team) == workers(team) - 1:
            contacts.first[c + 1] = contacts.count[0] = k
        wait(team)
    wait(team)


@jit
def begin_search(contacts, state):
    """Begin an empty list of candidates, and bring the near blocks up to date."""
    contacts.first[0] = contacts.count[0] = contacts.count[3] = 0
    if contacts.colliders.count[0] > 0:
        update_near_blocks(contacts.near, contacts, state)


@jit(inline=True)
def blocks_of(near, c, state):
    """Return the blocks to be tested for collider c: whether they are in a list, begin, end."""
    if near.end[c] == ALL:
        return False, 0, len(state.inv_mass) // WIDTH
    return True, near.begin[c], near.end[c]


@jit(inline=True)
def chosen_of(contacts, state, c, q):
    """Return bits of the particles of block q that collider c may touch."""
    near = contacts.near
    most = load_wide(near.margin, q) + (
        (1.0 + UP) * contacts.thickness[0] + near.budget[c])
    return bits(in_reach(contacts, state, c, q, most))


@jit(inline=True)
def enter(contacts, bounce, state, substep, c, q, chosen, begin, limit):
    """
    Make pairs of collider c and particles of block q, the bits of ``chosen``, candidates.

    From ``begin`` on, and up to ``limit``; the others are counted. Returns their end.
    """
    several, fits = contacts.first[c] > 0, begin + WIDTH <= limit
    start, most, gap, overlap = distances_to_keep(contacts, state, c, q, substep.h)
    if fits:
        begin_pack(contacts, begin, c)
    else:
        for k in range(begin, min(begin + count_bits(chosen), limit)):
            begin_candidate(contacts, k, c)
    if fits and chosen & (chosen + 1) == 0:    # the first lanes
        end = begin + lowest_bit(chosen + 1)
        store_wide(contacts.gap, begin, gap)
        store_wide(contacts.overlap, begin, overlap)
        store_integers(contacts.particle, begin, q, 1)
        if several:
            for k in range(begin, end):
                link(contacts, c, k, q + k - begin)
        else:
            store_integers(contacts.latest, q, begin, 1)
    else:
        end = enter_lanes(contacts, state.team, c, q, chosen, gap, overlap, begin, limit)
    begin_pads(contacts.pads, contacts, state.team, begin, end, q, start, most)
    for k in range(begin, end if bounce is not None else begin):
        note_approach(bounce, contacts, k)
    return end


@jit(inline=True)
def begin_pack(contacts, k, c):
    """Begin the candidates k, k + 1, … of collider c."""
    store_wide(contacts.push, k, 0.0)
    store_columns(contacts.slip, k, 0.0, 0.0, 0.0)
    store_integers(contacts.collider, k, c, 0)
    store_integers(contacts.earlier, k, -1, 0)
    store_integers(contacts.crossed, k, 0, 0)


@jit(inline=True)
def begin_candidate(contacts, k, c):
    """Begin one candidate of collider c."""
    contacts.push[k] = contacts.slip[k, 0] = contacts.slip[k, 1] = contacts.slip[k, 2] = 0.0
    contacts.collider[k], contacts.earlier[k], contacts.crossed[k] = c, -1, 0


@jit
def enter_lanes(contacts, team, c, q, chosen, gap, overlap, k, limit):
    """Make some lanes of the block q candidates from k on; return their end."""
    scratch, several = contacts.scratch[worker(team)], contacts.first[c] > 0
    store_wide(scratch, 0, gap)
    store_wide(scratch, WIDTH, overlap)
    while chosen != 0:
        l = lowest_bit(chosen)
        chosen &= chosen - 1
        if k == limit:
            count_up(team, contacts.count, 1, 1)
            continue
        contacts.gap[k], contacts.overlap[k] = scratch[0, l], scratch[1, l]
        contacts.particle[k] = q + l
        if several:
            link(contacts, c, k, q + l)
        else:
            contacts.latest[q + l] = k
        k += 1
    return k


@jit(inline=True)
def link(contacts, c, k, i):
    """Link candidate k of collider c to that of particle i and an earlier collider."""
    earlier = contacts.latest[i]
    if earlier < contacts.first[c] and contacts.particle[earlier] == i:
        contacts.earlier[k] = earlier
        contacts.count[3] = 1
    contacts.latest[i] = k


@jit
def begin_pads(pads, contacts, team, begin, end, q, start, most):
    """Prepare the candidates begin, …, end - 1 for pads; ``start``, ``most``: of the block q."""
    if pads is not None:
        scratch = contacts.scratch[worker(team)]
        store_wide(scratch, 0, start)
        store_wide(scratch, WIDTH, most)
        for k in range(begin, end):
            l = contacts.particle[k] - q
            begin_pad(pads, contacts, k, scratch[0, l], scratch[1, l])
