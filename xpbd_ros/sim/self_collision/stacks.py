"""
Squeezed pairs: the pair contacts of layers of cloth between two pads, or a pad and a collider.

A particle is backed along n if a collider pushes it along n, or would where the collider carries
it from the substep's start, or if a pair contact would push it along n whose other side is backed
along n. A pair is squeezed if the colliders behind its sides would press them together, and one of
them is a pad. Normals and weights of these pairs are those at the substep's start, not at the end
of the sweep (``narrow_phase``): pads hold what elastic forces displace by several times the
thickness in a sweep.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    bits,
    both,
    lanes,
    load,
    lowest_bit,
    root,
    select,
    smaller,
    store,
)
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.contact.collider_motion import surface_motion
from xpbd_ros.sim.contact.contacts import DEPENETRATION
from xpbd_ros.sim.contact.corners import contact_distance
from xpbd_ros.sim.geometry.closest_points_simd import dot
from xpbd_ros.sim.self_collision.near_pairs import closest, is_inside
from xpbd_ros.sim.self_collision.neighbour_list import INV_MASS
from xpbd_ros.sim.self_collision.pair_contacts import load_corners, store_vector, store_weights

LAYERS = 12
"""most layers between a particle and the pad that backs it"""
CLOSE = 0.25
"""
distance beyond that to be kept up to which a pair, or a rigid collider, counts, relative to the
thickness
"""
SHARE = 0.2
"""least weight of a particle in a pair that passes on what backs it"""
PARALLEL = 0.9
"""least cosine of the angle between two normals that count as one"""


class Stack(NamedTuple):
    """The pairs and their particles."""

    count: np.ndarray
    """number of pairs and of particles, shape (2,)"""
    pairs: np.ndarray
    """squeezed pairs, shape (pairs,)"""
    normal: np.ndarray
    """n of pairs about pads at the substep's start, float32, shape (3, pairs)"""
    weight: np.ndarray
    """their b there, float32, shape (4, pairs)"""
    deficit: np.ndarray
    """their -C there [m], float32, shape (pairs,)"""
    particles: np.ndarray
    """their particles, shape (particles,)"""
    place: np.ndarray
    """place of a particle in ``particles``, -1: none; shape (particles + 1,)"""
    axis: np.ndarray
    """direction in which a particle is backed first, shape (particles + 1, 3)"""
    behind: np.ndarray
    """
    candidates of the colliders that back it along and against that, -1: none; (particles + 1, 2)
    """
    low: np.ndarray
    """scratch: lower corner of a box about the particles that a pad backs [m], (colliders, 3)"""
    high: np.ndarray
    """scratch: its upper corner [m], shape (colliders, 3)"""
    about: np.ndarray
    """scratch: True for particles about the pads, shape (particles + 1,)"""
    found: np.ndarray
    """scratch: close pairs about the pads, shape (pairs,)"""


def new_stack(particles: int, pairs: int, colliders: int) -> Stack:
    """Return storage for these numbers."""
    return Stack(
        np.zeros(2, np.int64), np.zeros(pairs, np.int64), np.zeros((3, pairs), np.float32),
        np.zeros((4, pairs), np.float32), np.zeros(pairs, np.float32),
        np.zeros(particles, np.int64),
        np.full(particles + 1, -1), np.zeros((particles + 1, 3)), np.full((particles + 1, 2), -1),
        np.zeros((colliders, 3)), np.zeros((colliders, 3)),
        np.zeros(particles + 1, np.bool_), np.zeros(pairs, np.int64))


@jit
def list_stack(stack, contacts, near, pairs, state, thickness, h):
    """List the squeezed pairs of a substep and their particles."""
    stack.count[0] = stack.count[1] = 0
    stack.behind[:] = -1
    stack.low[:] = np.inf
    stack.high[:] = -np.inf
    back_by(stack, contacts, near, state, True, 0.0)
    mark_about(stack, near, LAYERS * thickness)
    found = list_close(stack, near, pairs, -CLOSE * thickness, DEPENETRATION * h)
    back_layers(stack, near, pairs, found)
    back_by(stack, contacts, near, state, False, CLOSE * thickness)    # along axes set by pads
    back_layers(stack, near, pairs, found)
    stack.place[:] = -1
    for m in range(found):
        k = stack.found[m]
        if is_any_backed(stack, pairs, k):
            below, above = backing_of(stack, near, pairs, k)
            if below >= 0 and above >= 0 and (
                    contacts.pads.soft[below] or contacts.pads.soft[above]):
                list_pair(stack, near, pairs, k)
    for m in range(stack.count[0]):
        back_rest(stack, near, pairs, stack.pairs[m])


@jit
def back_layers(stack, near, pairs, found):
    """Let the close pairs pass on what backs them, from layer to layer."""
    for _ in range(LAYERS):
        changed = False
        for m in range(found):
            if is_any_backed(stack, pairs, stack.found[m]):
                changed |= pass_on(stack, near, pairs, stack.found[m])
        if not changed:
            break


@jit(inline=True)
def last_candidate(contacts, j):
    """Return the last candidate of the particle in slot j, -1: none."""
    k = contacts.latest[j]
    return k if k < contacts.count[0] and contacts.particle[k] == j else -1


@jit(inline=True)
def is_any_backed(stack, pairs, k):
    """Return True if a collider or a pair backs a particle of pair k."""
    for p in range(4):
        i = pairs.particles[p, k]
        if stack.behind[i, 0] >= 0 or stack.behind[i, 1] >= 0:
            return True
    return False


@jit(inline=True)
def list_pair(stack, near, pairs, k):
    """List pair k and its particles."""
    stack.pairs[stack.count[0]] = k
    stack.count[0] += 1
    for p in range(4):
        i = pairs.particles[p, k]
        if i < len(near.slot) and stack.place[i] < 0:
            stack.place[i] = stack.count[1]
            stack.particles[stack.count[1]] = i
            stack.count[1] += 1


@jit(inline=True)
def back_rest(stack, near, pairs, k):
    """Copy normal and backing of pair k to its particles that are not backed from both sides."""
    below, above = backing_of(stack, near, pairs, k)
    for p in range(4):
        i = pairs.particles[p, k]
        if i < len(near.slot) and stack.weight[p, k] != 0.0 and (
                stack.behind[i, 0] < 0 or stack.behind[i, 1] < 0):
            stack.behind[i, 0], stack.behind[i, 1] = below, above
            for a in range(3):
                stack.axis[i, a] = stack.normal[a, k]


@jit
def back_by(stack, contacts, near, state, pads, reach):
    """
    Note which particles pads back, and boxes about these; or which rigid colliders back near them.

    They back particles nearer than the thickness and ``reach`` [m].
    """
    for i in range(len(near.slot)):
        k = last_candidate(contacts, near.slot[i]) if pads or stack.about[i] else -1
        while k >= 0:
            if (contacts.pads.soft[k] != 0) == pads:
                _, phi, n = carried(contacts, k, state)
                if contacts.push[k] > 0.0 or phi < contacts.gap[k] + reach:
                    back(stack, i, n, k)
                    low, high = stack.low[contacts.collider[k]], stack.high[contacts.collider[k]]
                    for a in range(3):
                        low[a], high[a] = min(low[a], near.x[i, a]), max(high[a], near.x[i, a])
            k = contacts.earlier[k]


@jit
def carried(contacts, k, state):
    """
    Return where the collider of candidate k would carry its particle from the substep's start.

    Returns
    -------
    displacement up to there [m]; φ [m] and n there

    """
    i, x, (wx, wy, wz) = contacts.particle[k], state.x_prev, surface_motion(contacts, k, state)
    phi, n = contact_distance(contacts, k, x[0, i] + wx, x[1, i] + wy, x[2, i] + wz)
    return (wx, wy, wz), phi, n


@jit
def mark_about(stack, near, reach):
    """Mark the particles nearer to a box than ``reach``."""
    stack.about[:] = False
    for c in range(len(stack.low)):
        low, high = stack.low[c], stack.high[c]
        if low[0] <= high[0]:
            for i in range(len(near.slot)):
                x, y, z = near.x[i, 0], near.x[i, 1], near.x[i, 2]
                stack.about[i] |= (low[0] - reach < x < high[0] + reach
                                   and low[1] - reach < y < high[1] + reach
                                   and low[2] - reach < z < high[2] + reach)


@jit
def list_close(stack, near, pairs, least, apart):
    """
    List the pairs with -C above ``least`` and the first particle about pads; count them.

    Those that overlap keep the distance at which they are, plus ``apart`` [m].
    """
    found = 0
    for group in range(0, pairs.end[0], PACK):
        about = close = 0
        for lane in range(PACK):
            about |= stack.about[np.uint32(pairs.particles[0, group + lane])] << lane
        if about:
            for q in range(group, group + PACK, lanes(near.start)):
                close |= place_at_start(stack, near, pairs, pairs.kind[group // PACK], q, least,
                                        apart) << (q - group)
        close &= about
        while close:
            k = group + lowest_bit(close)
            close &= close - 1
            if is_movable(near, pairs, k):
                stack.found[found] = k
                found += 1
    return found


@jit(inline=True)
def place_at_start(stack, near, pairs, kind, q, least, apart):
    """Set normals, weights and deficits of a vector of pairs; return bits of those to list."""
    a, b, c, d = load_corners(near.start, pairs.particles, q)
    v, weight = closest(kind, a, b, c, d)
    distance = root(dot(v, v))
    there, keep = distance > 0.0, load(pairs.keep, q)
    per, deficit = 1.0 / select(there, distance, 1.0), smaller(keep, distance + apart) - distance
    store_vector(stack.normal, q, (per * v[0], per * v[1], per * v[2]))
    store_weights(stack, q, weight)
    store(stack.deficit, q, deficit)
    return bits(both(both(is_inside(kind, weight), there), deficit > least))


@jit(inline=True)
def is_movable(near, pairs, k):
    """Return True if a particle of pair k has a finite mass."""
    total = 0.0
    for p in range(4):
        total += near.precise_move[pairs.particles[p, k], INV_MASS]
    return total > 0.0


@jit(inline=True)
def back(stack, i, n, k):
    """Note that candidate k's collider backs particle i along n; return True if that is new."""
    axis = stack.axis
    if stack.behind[i, 0] < 0 and stack.behind[i, 1] < 0:
        axis[i, 0], axis[i, 1], axis[i, 2] = n
    side = side_of(stack, i, n[0], n[1], n[2])
    if side < 0 or stack.behind[i, side] >= 0:
        return False
    stack.behind[i, side] = k
    return True


@jit(inline=True)
def side_of(stack, i, x, y, z):
    """Return 0 if (x, y, z) is along the axis of particle i, 1 against it, -1: neither."""
    axis = stack.axis
    along = axis[i, 0] * x + axis[i, 1] * y + axis[i, 2] * z
    if abs(along) < PARALLEL:
        return -1
    return 0 if along > 0.0 else 1


@jit(inline=True)
def collider_behind(stack, i, x, y, z):
    """Return the candidate of the collider that backs particle i along (x, y, z), -1: none."""
    side = side_of(stack, i, x, y, z)
    return stack.behind[i, side] if side >= 0 else -1


@jit(inline=True)
def backing_of(stack, near, pairs, k):
    """
    Return candidates of the colliders that back pair k.

    They are that of the side with b < 0 along n, and that of the side with b > 0 against n; -1:
    none.
    """
    n, below, above = stack.normal, -1, -1
    for p in range(4):
        i, b = pairs.particles[p, k], stack.weight[p, k]
        if i < len(near.slot) and b < -SHARE:
            below = max(below, collider_behind(stack, i, n[0, k], n[1, k], n[2, k]))
        elif i < len(near.slot) and b > SHARE:
            above = max(above, collider_behind(stack, i, -n[0, k], -n[1, k], -n[2, k]))
    return below, above


@jit(inline=True)
def pass_on(stack, near, pairs, k):
    """Let what backs one side of pair k back the other one; return True if that is new."""
    below, above = backing_of(stack, near, pairs, k)
    if below < 0 and above < 0:
        return False
    n, changed = (stack.normal[0, k], stack.normal[1, k], stack.normal[2, k]), False
    for p in range(4):
        i, b = pairs.particles[p, k], stack.weight[p, k]
        if i < len(near.slot) and b > SHARE and below >= 0:
            changed |= back(stack, i, n, below)
        elif i < len(near.slot) and b < -SHARE and above >= 0:
            changed |= back(stack, i, (-n[0], -n[1], -n[2]), above)
    return changed


@jit(inline=True)
def mobility_of_pair(near, pairs, k):
    """Return W = Σ w b² of pair k."""
    total = 0.0
    for p in range(4):
        i, b = pairs.particles[p, k], float(pairs.weight[p, k])
        if i < len(near.slot):
            total += near.precise_move[i, INV_MASS] * b * b
    return total
