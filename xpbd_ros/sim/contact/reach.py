"""Pairs of particle and collider that may touch in a substep, and the distances they keep."""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import any_lane, both, larger, root, smaller
from xpbd_ros.sim.backend.simd_wide import load_wide
from xpbd_ros.sim.backend.threads import worker
from xpbd_ros.sim.contact.colliders import BOX, vectors_to_local
from xpbd_ros.sim.contact.contacts import DEPENETRATION
from xpbd_ros.sim.contact.near_blocks import bounding_distance
from xpbd_ros.sim.contact.particle_lanes import block
from xpbd_ros.sim.contact.signed_distance_simd import depths


@jit(inline=True)
def in_reach(contacts, state, c, q, most):
    """
    Return the mask of pairs with φ up to the thickness plus twice their motion in this substep.

    Parameters
    ----------
    c, q : index of the collider, first slot of the block
    most : φ beyond which no pair is in reach [m], vector

    """
    thickness, slots, p = contacts.thickness[0], len(state.inv_mass), contacts.after
    colliders = contacts.colliders
    x, y, z = block(state.x, slots, q)
    lx, ly, lz = vectors_to_local(p, c, x, y, z)
    phi = depths(colliders, contacts.scratch[worker(state.team)], c, lx, ly, lz)
    free, sampled = load_wide(state.inv_mass, q) > 0.0, colliders.shape[c] > BOX
    close = both(free, phi <= most)
    if any_lane(close) and (sampled or any_lane(both(close, phi > thickness))):
        x0, y0, z0 = block(state.x_prev, slots, q)
        dx, dy, dz = x - x0, y - y0, z - z0
        reach = root(dx * dx + dy * dy + dz * dz) + contacts.stir[0] + contacts.moved[c]
        if contacts.turned[c] > 0.0:
            ax, ay, az = x - p[c, 0], y - p[c, 1], z - p[c, 2]
            reach = reach + 2.0 * contacts.turned[c] * root(ax * ax + ay * ay + az * az)
        reach = thickness + 2.0 * reach
        close = both(free, phi <= reach)
        if sampled:
            close = both(close, bounding_distance(contacts, c, x, y, z) < reach)
    return close


@jit(inline=True)
def distances_to_keep(contacts, state, c, q, h):
    """Return vectors: φ at the substep's start, φ up to which it may separate, gap, overlap."""
    x, y, z = block(state.x_prev, len(state.inv_mass), q)
    x, y, z = vectors_to_local(contacts.before, c, x, y, z)
    start = depths(contacts.colliders, contacts.scratch[worker(state.team)], c, x, y, z)
    limit = start + DEPENETRATION * h
    gap = smaller(limit, contacts.thickness[0])
    return start, limit, gap, larger(gap - start, 0.0)
