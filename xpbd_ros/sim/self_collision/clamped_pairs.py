"""
Pairs that pads clamp, and further turns of these alone (``self_collision.backing``).

Only pairs with colliders near both sides, at least one of them a pad, take part in a further turn;
they are few, so it costs no more than the search for them in the first one.
"""

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lowest_bit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import in_block, wait_in_block
from xpbd_ros.sim.contact.pads import meets_pad
from xpbd_ros.sim.self_collision.backing import (
    BESIDE,
    BESIDE_PAD,
    last_candidate,
    load_axis,
    store_pushes,
    TURNS,
)
from xpbd_ros.sim.self_collision.neighbour_list import EDGES, load_move, store_move
from xpbd_ros.sim.self_collision.pair_contacts import NEVER, project_pairs


@jit
def project_again(backing, near, pairs, state):
    """Project the clamped pairs; in the first further turn, list them before."""
    if backing is not None:
        team, turn, clamped = state.team, backing.turn[0], backing.clamped
        me, threads = in_block(team)
        if me == 0:
            backing.contacts.pads.again[0] = turn < TURNS
            if turn == 1:
                mark_particles(backing, near)
                list_clamped(clamped, near, pairs)
        wait_in_block(team)
        for m in range(me, clamped.count[0], threads):
            load_axis(backing, near.slot, clamped.particles[m])
            load_move(near, state, clamped.particles[m])
        wait_in_block(team)
        project_pairs(team, near, pairs)
        for m in range(me, clamped.count[0], threads):
            store_move(near, state, clamped.particles[m])
            store_pushes(backing, near, clamped.particles[m])


@jit
def mark_particles(backing, near):
    """Note which particles are near colliders, and near pads."""
    contacts, beside = backing.contacts, backing.clamped.near
    for i in range(len(near.slot)):
        last = last_candidate(contacts, near.slot[i])
        beside[i] = 0 if last < 0 else BESIDE | BESIDE_PAD * meets_pad(
            contacts.pads, contacts, last)


@jit
def list_clamped(clamped, near, pairs):
    """List the clamped pairs and their particles."""
    clamped.count[0] = 0
    clamped.listed[:] = False
    for group in range(0, pairs.end[0], PACK):
        found = near_pads(clamped.near, pairs.particles, group)
        clamped.groups[group // PACK] = found != 0
        if found:
            clamped.part[group:group + PACK] = 0.0
            list_some(clamped, near, pairs, pairs.kind[group // PACK], group, found)


@jit(inline=True)
def near_pads(beside, particles, group):
    """Return bits of the pairs of a group that have a particle near a pad."""
    found = 0
    for lane in range(PACK):
        marks = (beside[np.uint32(particles[0, group + lane])]
                 | beside[np.uint32(particles[1, group + lane])]
                 | beside[np.uint32(particles[2, group + lane])]
                 | beside[np.uint32(particles[3, group + lane])])
        found |= (marks & BESIDE_PAD) << lane
    return found // BESIDE_PAD


@jit(inline=True)
def list_some(clamped, near, pairs, kind, group, found):
    """List those of the pairs group + k of all bits k that are clamped, and their particles."""
    while found:
        k = group + lowest_bit(found)
        found &= found - 1
        if is_clamped(clamped.near, pairs, kind, k):
            clamped.part[k] = 1.0
            for p in range(4):
                i = pairs.particles[p, k]
                if i < len(near.slot) and not clamped.listed[i]:
                    clamped.listed[i] = True
                    clamped.particles[clamped.count[0]] = i
                    clamped.count[0] += 1


@jit(inline=True)
def is_clamped(beside, pairs, kind, k):
    """Return True if pair k, with a pad near it, is a contact with colliders near both sides."""
    p = pairs.particles
    first, last = beside[p[0, k]], beside[p[3, k]] | beside[p[2, k]]
    if kind == EDGES:
        first |= beside[p[1, k]]
    else:
        last |= beside[p[1, k]]
    return first & last & BESIDE != 0 and pairs.deficit[k] > NEVER
