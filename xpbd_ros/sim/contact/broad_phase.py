"""
Broad phase: candidates, the pairs of particle and collider that may touch in a substep.

They are in the order of the colliders, and of the slots for each of them.
"""

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import any_lane, bits, lowest_bit
from xpbd_ros.sim.backend.simd_wide import (
    load_wide,
    store_columns,
    store_integers,
    store_wide,
    WIDTH,
)
from xpbd_ros.sim.backend.threads import is_on_device
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
    if is_on_device(state[state.fields.index('team')]):
        return lambda contacts, bounce, state, substep: search_by_all(
            contacts.marks, contacts, bounce, state, substep)
    return lambda contacts, bounce, state, substep: search(contacts, bounce, state, substep)


@jit
def search(contacts, bounce, state, substep):
    """Do so on one thread of a CPU."""
    near = contacts.near
    contacts.count[0] = contacts.count[3] = 0
    count = contacts.colliders.count[0]
    if count > 0:
        update_near_blocks(near, contacts, state)
    for c in range(count):
        contacts.first[c] = contacts.count[0]
        listed = near.end[c] != ALL
        begin, end = near.begin[c], near.end[c]
        if not listed:
            begin, end = 0, len(state.inv_mass) // WIDTH
        for n in range(begin, end):
            check_block(contacts, bounce, state, substep, c,
                        near.block[n] if listed else n * WIDTH)
        contacts.first[c + 1] = contacts.count[0]


@jit(inline=True)
def check_block(contacts, bounce, state, substep, c, q):
    """Make the pairs of collider c and the particles of block q candidates that are in reach."""
    thickness, near, several = contacts.thickness[0], contacts.near, contacts.first[c] > 0
    most = load_wide(near.margin, q) + ((1.0 + UP) * thickness + near.budget[c])
    close = in_reach(contacts, state, c, q, most)
    if not any_lane(close):
        return
    start, limit, gap, overlap = distances_to_keep(contacts, state, c, q, substep.h)
    begin, chosen = contacts.count[0], bits(close)
    store_wide(contacts.push, begin, 0.0)
    store_columns(contacts.slip, begin, 0.0, 0.0, 0.0)
    store_integers(contacts.collider, begin, c, 0)
    store_integers(contacts.earlier, begin, -1, 0)
    store_integers(contacts.crossed, begin, 0, 0)
    if chosen & (chosen + 1) == 0 and begin + WIDTH <= room_of(contacts):    # the first lanes
        store_wide(contacts.gap, begin, gap)
        store_wide(contacts.overlap, begin, overlap)
        store_integers(contacts.particle, begin, q, 1)
        contacts.count[0] = begin + lowest_bit(chosen + 1)
        if several:
            for k in range(begin, contacts.count[0]):
                link(contacts, k, q + k - begin)
        else:
            store_integers(contacts.latest, q, begin, 1)
    else:
        choose_lanes(contacts, q, chosen, gap, overlap, several)
    begin_pads(contacts.pads, contacts, begin, q, start, limit)
    for k in range(begin, contacts.count[0] if bounce is not None else 0):
        note_approach(bounce, contacts, k, state, substep)


@jit
def choose_lanes(contacts, q, chosen, gap, overlap, several):
    """Add some lanes of the block q, the bits of ``chosen``, to the candidates."""
    store_wide(contacts.scratch, 0, gap)
    store_wide(contacts.scratch, WIDTH, overlap)
    k, room = contacts.count[0], room_of(contacts)
    while chosen != 0:
        l = lowest_bit(chosen)
        chosen &= chosen - 1
        if k == room:
            contacts.count[1] += 1
            continue
        contacts.gap[k], contacts.overlap[k] = contacts.scratch[0, l], contacts.scratch[1, l]
        contacts.particle[k] = q + l
        if several:
            link(contacts, k, q + l)
        else:
            contacts.latest[q + l] = k
        k += 1
    contacts.count[0] = k


@jit(inline=True)
def link(contacts, k, i):
    """Link candidate k to the previous one of particle i."""
    earlier = contacts.latest[i]
    if earlier < k and contacts.particle[earlier] == i:
        contacts.earlier[k] = earlier
        contacts.count[3] = 1
    contacts.latest[i] = k


@jit
def begin_pads(pads, contacts, begin, q, start, limit):
    """Prepare candidates from ``begin`` on for pads; ``start``, ``limit``: of the block q."""
    if pads is not None:
        store_wide(contacts.scratch, 0, start)
        store_wide(contacts.scratch, WIDTH, limit)
        for k in range(begin, contacts.count[0]):
            l = contacts.particle[k] - q
            begin_pad(pads, contacts, k, contacts.scratch[0, l], contacts.scratch[1, l])
