"""
Broad phase: candidates, the pairs of particle and collider that may touch in a substep.

They are in the order of the colliders, and of the slots for each of them.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import any_lane, bits, both, larger, lowest_bit, root, smaller
from xpbd_ros.sim.backend.simd_wide import (
    load_wide,
    store_columns,
    store_integers,
    store_wide,
    WIDTH,
)
from xpbd_ros.sim.contact.colliders import BOX, vectors_to_local
from xpbd_ros.sim.contact.contacts import DEPENETRATION, room_of
from xpbd_ros.sim.contact.near_blocks import ALL, bounding_distance, UP, update_near_blocks
from xpbd_ros.sim.contact.pads import begin_pad
from xpbd_ros.sim.contact.signed_distance_simd import depths


@jit
def find_candidates(contacts, bounce, state, substep):
    """
    List the candidates of this substep, and the gap that each has to keep.

    ``bounce`` (``contact.restitution``, or None) receives their velocities of approach.
    """
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
    """
    Make pairs candidates if φ is at most the thickness plus twice their motion in this substep.

    Parameters
    ----------
    c, q : index of the collider, first slot of the block

    """
    thickness, slots, p = contacts.thickness[0], len(state.inv_mass), contacts.after
    near, several = contacts.near, contacts.first[c] > 0
    colliders = contacts.colliders
    x, y, z = (load_wide(state.x, q), load_wide(state.x, slots + q),
               load_wide(state.x, 2 * slots + q))
    x0, y0, z0 = (load_wide(state.x_prev, q), load_wide(state.x_prev, slots + q),
                  load_wide(state.x_prev, 2 * slots + q))
    lx, ly, lz = vectors_to_local(p, c, x, y, z)
    phi = depths(colliders, contacts.scratch, c, lx, ly, lz)
    free, sampled = load_wide(state.inv_mass, q) > 0.0, colliders.shape[c] > BOX
    close = both(free, phi <= load_wide(near.margin, q) + (
        (1.0 + UP) * thickness + near.budget[c]))
    if not any_lane(close):
        return
    if sampled or any_lane(both(close, phi > thickness)):
        dx, dy, dz = x - x0, y - y0, z - z0
        reach = root(dx * dx + dy * dy + dz * dz) + contacts.stir[0] + contacts.moved[c]
        if contacts.turned[c] > 0.0:
            ax, ay, az = x - p[c, 0], y - p[c, 1], z - p[c, 2]
            reach = reach + 2.0 * contacts.turned[c] * root(ax * ax + ay * ay + az * az)
        reach = thickness + 2.0 * reach
        close = both(free, phi <= reach)
        if sampled:
            close = both(close, bounding_distance(contacts, c, x, y, z) < reach)
        if not any_lane(close):
            return
    lx, ly, lz = vectors_to_local(contacts.before, c, x0, y0, z0)
    start = depths(colliders, contacts.scratch, c, lx, ly, lz)
    limit = start + DEPENETRATION * substep.h
    gap = smaller(limit, thickness)
    overlap = larger(gap - start, 0.0)
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
    begin_bounce(bounce, contacts, begin, state, substep)


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


@jit
def begin_bounce(bounce, contacts, begin, state, substep):
    """Store the velocities of approach of the candidates from ``begin`` on."""
    if bounce is not None:
        for k in range(begin, contacts.count[0]):
            for a in range(3):
                bounce.approach[k, a] = (state.v[a, contacts.particle[k]]
                                         - substep.h * state.gravity[a])
