"""
Neighbour list (Verlet list) of contact: blocks of particles that may come close to a collider.

A block is one vector of slots. The list is kept over substeps. At its build, with positions y and
poses of the colliders of that time, a block is listed for a collider if for one of its particles

    φ(y) ≤ thickness + margin + budget

with the particle's margin and the collider's budget [m]. A pair is a candidate in a substep
(``contact.broad_phase``) if φ ≤ thickness + 2 (s + stir + moved + 2 turned arm), with s the
particle's motion in the substep. Since the build φ has decreased by at most |x - y| + D + 2 T arm,
with D and T the collider's translation and change of its quaternion. So while

    |x - y| + 2 s ≤ margin   and   D + 2 (stir + moved) + (2 T + 4 turned) arm ≤ budget

no pair that is not listed is a candidate, and the bits of a run do not depend on the list. Margins
and budgets are some substeps of the present motion. For a mesh or a height field φ is the distance
to its bounding sphere or half space.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import all_lanes, any_lane, both, highest, larger, root, select
from xpbd_ros.sim.backend.simd_wide import load_wide, store_wide, wide, WIDTH
from xpbd_ros.sim.contact.colliders import BOX, Colliders, vectors_to_local
from xpbd_ros.sim.contact.signed_distance_simd import shape_depths
from xpbd_ros.sim.particles.memory_layout import zeros

AHEAD = 16.0
"""substeps of the present motion that a list should last"""
LEAST = 1.0
"""least margin of a particle, relative to the thickness"""
UP = 0.01
"""bound of the rounding errors of distances, relative to the thickness"""
LISTS = 8
"""room for lists of all blocks; colliders beyond it are tested against all blocks"""
ALL = -1
"""end of a list without room"""


class NearBlocks(NamedTuple):
    """The list, and positions and poses of its build."""

    valid: np.ndarray
    """1 if the list has been built, shape (1,)"""
    x: np.ndarray
    """y [m], shape (3, slots)"""
    margin: np.ndarray
    """[m], inf in the padding, shape (slots,)"""
    pose: np.ndarray
    """poses of the colliders, shape (capacity, 7)"""
    budget: np.ndarray
    """[m], shape (capacity,)"""
    arm: np.ndarray
    """bound of the distance of particles from a collider's position, while each is within its
    margin and the collider does not move [m], shape (capacity,)"""
    begin: np.ndarray
    """begin of each collider's part of ``block``, shape (capacity,)"""
    end: np.ndarray
    """its end, or ALL, shape (capacity,)"""
    block: np.ndarray
    """first slots of blocks, ascending within a list"""
    chosen: np.ndarray | None
    """scratch of several threads: bits of the particles in reach of each block, shape (slots /
    WIDTH,)"""
    found: np.ndarray | None
    """number of those that each thread has found, shape (threads,)"""


def new_near_blocks(colliders: Colliders, slots: int, threads: int) -> NearBlocks:
    """Return an empty list."""
    capacity = len(colliders.shape)
    return NearBlocks(
        np.zeros(1, np.int64), zeros((3, slots), np.float64), zeros((slots,), np.float64),
        np.zeros_like(colliders.start), np.zeros(capacity), np.zeros(capacity),
        np.zeros(capacity, np.int64), np.zeros(capacity, np.int64),
        np.zeros(min(capacity, LISTS) * -(-slots // WIDTH), np.int64),
        *((np.zeros(-(-slots // WIDTH), np.int64), np.zeros(threads, np.int64))
          if threads > 1 else (None, None)))


@jit(inline=True)
def update_near_blocks(near, contacts, state):
    """Build the list if it may lack a pair."""
    if not (near.valid[0] and are_colliders_within(near, contacts)
            and are_particles_within(near, state)):
        build(near, contacts, state)


@jit(inline=True)
def are_colliders_within(near, contacts):
    """Return True if no collider has moved further than its budget allows."""
    p, p0 = contacts.after, near.pose
    for c in range(contacts.colliders.count[0]):
        way = sqrt((p[c, 0] - p0[c, 0])**2 + (p[c, 1] - p0[c, 1])**2
                   + (p[c, 2] - p0[c, 2])**2)
        turn = sqrt((p[c, 3] - p0[c, 3])**2 + (p[c, 4] - p0[c, 4])**2
                    + (p[c, 5] - p0[c, 5])**2 + (p[c, 6] - p0[c, 6])**2)
        used = way + 2.0 * (contacts.stir[0] + contacts.moved[c]) + (
            2.0 * turn + 4.0 * contacts.turned[c]) * (near.arm[c] + way)
        if not used <= near.budget[c]:    # true for nan too
            return False
    return True


@jit(inline=True)
def are_particles_within(near, state):
    """Return True if all particles have √(2 |x - y|² + 8 s²) ≤ margin; |x - y| + 2 s is less."""
    x, before, y, slots = state.x, state.x_prev, near.x, len(near.margin)
    for q in range(0, slots, WIDTH):
        square = wide(0.0)
        for a in range(3):
            now = load_wide(x, a * slots + q)
            away, step = now - load_wide(y, a * slots + q), now - load_wide(before, a * slots + q)
            square = square + (2.0 * away * away + 8.0 * step * step)
        margin = load_wide(near.margin, q)
        if not all_lanes(square <= margin * margin):    # true for nan too
            return False
    return True


@jit
def build(near, contacts, state):
    """List the blocks of all colliders for the present positions and poses."""
    thickness, colliders = contacts.thickness[0], contacts.colliders
    most, radius, centre = set_margins(near, state, LEAST * thickness)
    p, size, count, slots = contacts.after, colliders.size, 0, len(near.margin)
    for c in range(colliders.count[0]):
        for k in range(7):
            near.pose[c, k] = p[c, k]
        near.arm[c] = most + radius + sqrt((centre[0] - p[c, 0])**2 + (centre[1] - p[c, 1])**2
                                           + (centre[2] - p[c, 2])**2)
        near.budget[c] = 4.0 * contacts.stir[0] + (2.0 + AHEAD) * (
            contacts.moved[c] + 2.0 * contacts.turned[c] * near.arm[c])
        near.begin[c], near.end[c] = count, ALL
        if count + slots // WIDTH > len(near.block):
            continue
        shape, reach = colliders.shape[c], (1.0 + UP) * thickness + near.budget[c]
        for q in range(0, slots, WIDTH):
            x, y, z = (load_wide(near.x, q), load_wide(near.x, slots + q),
                       load_wide(near.x, 2 * slots + q))
            if shape > BOX:
                phi = bounding_distance(contacts, c, x, y, z)
            else:
                x, y, z = vectors_to_local(p, c, x, y, z)
                phi = shape_depths(shape, size[c, 0], size[c, 1], size[c, 2], x, y, z)
            close = phi <= reach + load_wide(near.margin, q)
            if any_lane(both(load_wide(state.mass, q) > 0.0, close)):
                near.block[count] = q
                count += 1
        near.end[c] = count
    near.valid[0] = 1


@jit(inline=True)
def set_margins(near, state, least):
    """Store positions and margins; return the largest margin, radius and centre of a ball."""
    x, before, slots = state.x, state.x_prev, len(near.margin)
    most, square, centre = wide(0.0), wide(0.0), (0.0, 0.0, 0.0)
    for i in range(slots):
        if state.mass[i] > 0.0:
            centre = float(x[0, i]), float(x[1, i]), float(x[2, i])
            break
    for q in range(0, slots, WIDTH):
        there = load_wide(state.mass, q) > 0.0
        step = wide(0.0)
        for a in range(3):
            now = load_wide(x, a * slots + q)
            store_wide(near.x, a * slots + q, now)
            moved = now - load_wide(before, a * slots + q)
            step = step + moved * moved
        dx, dy = load_wide(x, q) - centre[0], load_wide(x, slots + q) - centre[1]
        dz = load_wide(x, 2 * slots + q) - centre[2]
        away = dx * dx + dy * dy + dz * dz
        margin = AHEAD * root(step) + least
        store_wide(near.margin, q, select(there, margin, np.inf))
        most = larger(most, select(there, margin, 0.0))
        square = larger(square, select(there, away, 0.0))
    return highest(most), sqrt(highest(square)), centre


@jit(inline=True)
def bounding_distance(contacts, c, x, y, z):
    """Return the distance to the bounding sphere or half space of a collider."""
    bound, p, up = contacts.colliders.reach[c], contacts.after, contacts.up
    dx, dy, dz = x - p[c, 0], y - p[c, 1], z - p[c, 2]
    if bound >= 0.0:
        return root(dx * dx + dy * dy + dz * dz) - bound
    return dx * up[c, 0] + dy * up[c, 1] + dz * up[c, 2] - (-1.0 - bound)
