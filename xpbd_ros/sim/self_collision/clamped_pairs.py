"""
Clamped pairs: the pair contacts of layers between two colliders, one of them a pad.

A particle is backed along n if a collider pushes it along n, or if a pair contact would push it
along n whose other side is backed along n. A pair is clamped if what backs its sides would press
them together, and if one of these colliders is a pad.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import bits, lanes, load, lowest_bit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.self_collision.neighbour_list import INV_MASS

LAYERS = 12
"""most layers between a particle and the collider that backs it"""
CLOSE = 0.25
"""distance beyond that to be kept up to which a pair counts, relative to it"""
SHARE = 0.2
"""least weight of a particle in a pair that passes on what backs it"""
AGAINST = 0.9
"""least cosine of the angle between two normals that count as one"""
BACKED, BY_PAD = 1, 2
"""bits of ``sides`` for what backs a particle along its axis; those against it are times 4"""


class ClampedPairs(NamedTuple):
    """The pairs and their particles."""

    count: np.ndarray
    """number of pairs and of particles, shape (2,)"""
    pairs: np.ndarray
    """clamped pairs, shape (pairs,)"""
    particles: np.ndarray
    """their particles, shape (particles,)"""
    place: np.ndarray
    """place of a particle in ``particles``, -1: none; shape (particles + 1,)"""
    axis: np.ndarray
    """direction in which a particle is backed first, shape (particles + 1, 3)"""
    sides: np.ndarray
    """bits that tell what backs a particle, along its axis and against it; (particles + 1,)"""
    behind: np.ndarray
    """candidate of the contact that does so, along and against, shape (particles + 1, 2)"""
    found: np.ndarray
    """scratch: close pairs about the pads, shape (pairs,)"""


def new_clamped_pairs(particles: int, pairs: int) -> ClampedPairs:
    """Return storage for numbers of particles and of pairs."""
    return ClampedPairs(
        np.zeros(2, np.int64), np.zeros(pairs, np.int64), np.zeros(particles, np.int64),
        np.full(particles + 1, -1), np.zeros((particles + 1, 3)),
        np.zeros(particles + 1, np.int64), np.zeros((particles + 1, 2), np.int64),
        np.zeros(pairs, np.int64))


@jit
def list_clamped(clamped, contacts, near, pairs):
    """List the clamped pairs of a substep, and their particles."""
    clamped.sides[:] = 0
    low, high = back_by_colliders(clamped, contacts, near)
    found = list_close(clamped, near, pairs, low, high)
    for _ in range(LAYERS):
        changed = False
        for m in range(found):
            if is_any_backed(clamped, pairs, clamped.found[m]):
                changed |= pass_on(clamped, near, pairs, clamped.found[m], SHARE)
        if not changed:
            break
    clamped.count[0] = clamped.count[1] = 0
    clamped.place[:] = -1
    for m in range(found):
        k = clamped.found[m]
        if is_any_backed(clamped, pairs, k) and is_clamped(clamped, near, pairs, k):
            clamped.pairs[clamped.count[0]] = k
            clamped.count[0] += 1
            pass_on(clamped, near, pairs, k, 0.0)
            for p in range(4):
                if pairs.weight[p, k] != 0.0:
                    list_particle(clamped, near, pairs.particles[p, k])


@jit(inline=True)
def is_any_backed(clamped, pairs, k):
    """Return True if a collider or a pair backs a particle of pair k."""
    sides, p = clamped.sides, pairs.particles
    return sides[p[0, k]] | sides[p[1, k]] | sides[p[2, k]] | sides[p[3, k]] != 0


@jit(inline=True)
def is_clamped(clamped, near, pairs, k):
    """Return True if what backs the sides of pair k would press them together."""
    (below, _), (above, _) = backing_of(clamped, near, pairs, k)
    return below != 0 and above != 0 and (below | above) & BY_PAD != 0


@jit(inline=True)
def list_particle(clamped, near, i):
    """List a particle that is not listed yet."""
    if i < len(near.slot) and clamped.place[i] < 0:
        clamped.place[i] = clamped.count[1]
        clamped.particles[clamped.count[1]] = i
        clamped.count[1] += 1


@jit
def back_by_colliders(clamped, contacts, near):
    """Note which particles colliders push; return a box about those that pads push [m]."""
    lx = ly = lz = np.inf
    hx = hy = hz = -np.inf
    for i in range(len(near.slot)):
        k = last_candidate(contacts, near.slot[i])
        while k >= 0:
            if contacts.push[k] > 0.0:
                n = contacts.normal[k]
                soft = contacts.pads.soft[k]
                back(clamped, i, (n[0], n[1], n[2]), BACKED | BY_PAD if soft else BACKED, k)
                if soft:
                    x, y, z = near.x[i, 0], near.x[i, 1], near.x[i, 2]
                    lx, ly, lz = min(lx, x), min(ly, y), min(lz, z)
                    hx, hy, hz = max(hx, x), max(hy, y), max(hz, z)
            k = contacts.earlier[k]
    return (lx, ly, lz), (hx, hy, hz)


@jit(inline=True)
def last_candidate(contacts, j):
    """Return the last candidate of the particle in slot j, -1: none."""
    k = contacts.latest[j]
    return k if k < contacts.count[0] and contacts.particle[k] == j else -1


@jit
def list_close(clamped, near, pairs, low, high):
    """List the close pairs with their first particle near a box; return their number."""
    found = 0
    for group in range(0, pairs.end[0], PACK):
        close = 0
        for q in range(group, group + PACK, lanes(pairs.keep)):
            close |= bits(load(pairs.deficit, q) > -CLOSE * load(pairs.keep, q)) << (q - group)
        while close:
            k = group + lowest_bit(close)
            close &= close - 1
            x, reach = near.x[pairs.particles[0, k]], LAYERS * pairs.keep[k]
            if (low[0] - reach < x[0] < high[0] + reach and low[1] - reach < x[1] < high[1] + reach
                    and low[2] - reach < x[2] < high[2] + reach):
                clamped.found[found] = k
                found += 1
    return found


@jit(inline=True)
def back(clamped, i, n, bits, k):
    """Note that candidate k backs particle i along n; return True if that is new."""
    axis, before = clamped.axis, clamped.sides[i]
    if before == 0:
        axis[i, 0], axis[i, 1], axis[i, 2] = n
    along = axis[i, 0] * n[0] + axis[i, 1] * n[1] + axis[i, 2] * n[2]
    if abs(along) < AGAINST:
        return False
    side = 0 if along > 0.0 else 1
    if (before >> 2 * side) & BACKED == 0:
        clamped.behind[i, side] = k
    clamped.sides[i] = before | bits << 2 * side
    return clamped.sides[i] != before


@jit(inline=True)
def backed(clamped, i, x, y, z):
    """Return bits that tell what backs particle i along (x, y, z), and the candidate."""
    axis = clamped.axis
    along = axis[i, 0] * x + axis[i, 1] * y + axis[i, 2] * z
    if clamped.sides[i] == 0 or abs(along) < AGAINST:
        return 0, -1
    side = 0 if along > 0.0 else 1
    return (clamped.sides[i] >> 2 * side) & (BACKED | BY_PAD), clamped.behind[i, side]


@jit(inline=True)
def backing_of(clamped, near, pairs, k):
    """Return what backs the side of pair k with b < 0 along n, and that with b > 0 against n."""
    n, below, above = pairs.normal, (0, -1), (0, -1)
    for p in range(4):
        i, b = pairs.particles[p, k], pairs.weight[p, k]
        if i < len(near.slot) and b < -SHARE:
            below = both_of(below, backed(clamped, i, n[0, k], n[1, k], n[2, k]))
        elif i < len(near.slot) and b > SHARE:
            above = both_of(above, backed(clamped, i, -n[0, k], -n[1, k], -n[2, k]))
    return below, above


@jit(inline=True)
def both_of(one, other):
    """Return the bits of both, and the candidate of the last that has some."""
    return one[0] | other[0], other[1] if other[0] else one[1]


@jit(inline=True)
def pass_on(clamped, near, pairs, k, least):
    """
    Let what backs one side of pair k back the other one; return True if that is new.

    ``least`` is the weight that its particles must exceed.
    """
    below, above = backing_of(clamped, near, pairs, k)
    if not (below[0] or above[0]):
        return False
    n, changed = (pairs.normal[0, k], pairs.normal[1, k], pairs.normal[2, k]), False
    for p in range(4):
        i, b = pairs.particles[p, k], pairs.weight[p, k]
        if i < len(near.slot) and b > least and below[0]:
            changed |= back(clamped, i, n, below[0], below[1])
        elif i < len(near.slot) and b < -least and above[0]:
            changed |= back(clamped, i, (-n[0], -n[1], -n[2]), above[0], above[1])
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
