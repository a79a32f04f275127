"""
Squeezed pairs: the pair contacts of three or more layers of cloth between two pads.

A particle is backed along n if a pad pushes it along n, or if a pair contact would push it along n
whose other side is backed along n. A pair is squeezed if the pads behind its sides would press
them together. A particle that no pad touches, and that is backed from both sides, is of an inner
layer; only with such are pairs listed.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import bits, lanes, load, lowest_bit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.self_collision.backing import last_candidate
from xpbd_ros.sim.self_collision.neighbour_list import INV_MASS

LAYERS = 12
"""most layers between a particle and the pad that backs it"""
CLOSE = 0.25
"""distance beyond that to be kept up to which a pair counts, relative to the thickness"""
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
    particles: np.ndarray
    """their particles, shape (particles,)"""
    place: np.ndarray
    """place of a particle in ``particles``, -1: none; shape (particles + 1,)"""
    axis: np.ndarray
    """direction in which a particle is backed first, shape (particles + 1, 3)"""
    behind: np.ndarray
    """candidates of the pads that back it along and against that, -1: none; (particles + 1, 2)"""
    touched: np.ndarray
    """True for particles that a pad pushes itself, shape (particles + 1,)"""
    about: np.ndarray
    """scratch: True for particles about the pads, shape (particles + 1,)"""
    found: np.ndarray
    """scratch: close pairs about the pads, shape (pairs,)"""


def new_stack(particles: int, pairs: int) -> Stack:
    """Return storage for numbers of particles and of pairs."""
    return Stack(
        np.zeros(2, np.int64), np.zeros(pairs, np.int64), np.zeros(particles, np.int64),
        np.full(particles + 1, -1), np.zeros((particles + 1, 3)), np.full((particles + 1, 2), -1),
        np.zeros(particles + 1, np.bool_), np.zeros(particles + 1, np.bool_),
        np.zeros(pairs, np.int64))


@jit
def list_stack(stack, contacts, near, pairs, thickness):
    """
    List the squeezed pairs of a substep and their particles.

    Return False, and list none, if there are no inner layers.
    """
    stack.count[0] = stack.count[1] = 0
    stack.behind[:] = -1
    stack.touched[:] = False
    low, high = back_by_pads(stack, contacts, near)
    mark_about(stack, near, low, high, LAYERS * thickness)
    found = list_close(stack, pairs, -CLOSE * thickness)
    for _ in range(LAYERS):
        changed = False
        for m in range(found):
            if is_any_backed(stack, pairs, stack.found[m]):
                changed |= pass_on(stack, near, pairs, stack.found[m], SHARE)
        if not changed:
            break
    if not is_any_inner(stack, near):
        return False
    stack.place[:] = -1
    for m in range(found):
        k = stack.found[m]
        if is_any_backed(stack, pairs, k) and is_in_stack(stack, near, pairs, k):
            stack.pairs[stack.count[0]] = k
            stack.count[0] += 1
            pass_on(stack, near, pairs, k, 0.0)
            for p in range(4):
                if pairs.weight[p, k] != 0.0:
                    list_particle(stack, near, pairs.particles[p, k])
    return True


@jit(inline=True)
def is_any_backed(stack, pairs, k):
    """Return True if a pad or a pair backs a particle of pair k."""
    for p in range(4):
        i = pairs.particles[p, k]
        if stack.behind[i, 0] >= 0 or stack.behind[i, 1] >= 0:
            return True
    return False


@jit
def is_any_inner(stack, near):
    """Return True if a particle that no pad touches is backed from both sides."""
    for i in range(len(near.slot)):
        if stack.behind[i, 0] >= 0 and stack.behind[i, 1] >= 0 and not stack.touched[i]:
            return True
    return False


@jit(inline=True)
def is_in_stack(stack, near, pairs, k):
    """Return True if the pads behind the sides of pair k would press them together."""
    below, above = backing_of(stack, near, pairs, k)
    return below >= 0 and above >= 0


@jit(inline=True)
def list_particle(stack, near, i):
    """List a particle that is not listed yet."""
    if i < len(near.slot) and stack.place[i] < 0:
        stack.place[i] = stack.count[1]
        stack.particles[stack.count[1]] = i
        stack.count[1] += 1


@jit
def back_by_pads(stack, contacts, near):
    """Note which particles pads push; return a box about them [m]."""
    lx = ly = lz = np.inf
    hx = hy = hz = -np.inf
    for i in range(len(near.slot)):
        k = last_candidate(contacts, near.slot[i])
        while k >= 0:
            if contacts.pads.soft[k] and contacts.push[k] > 0.0:
                n = contacts.normal[k]
                back(stack, i, (n[0], n[1], n[2]), k)
                stack.touched[i] = True
                x, y, z = near.x[i, 0], near.x[i, 1], near.x[i, 2]
                lx, ly, lz = min(lx, x), min(ly, y), min(lz, z)
                hx, hy, hz = max(hx, x), max(hy, y), max(hz, z)
            k = contacts.earlier[k]
    return (lx, ly, lz), (hx, hy, hz)


@jit
def mark_about(stack, near, low, high, reach):
    """Mark the particles nearer to a box than ``reach``."""
    for i in range(len(near.slot)):
        x, y, z = near.x[i, 0], near.x[i, 1], near.x[i, 2]
        stack.about[i] = (low[0] - reach < x < high[0] + reach
                          and low[1] - reach < y < high[1] + reach
                          and low[2] - reach < z < high[2] + reach)


@jit
def list_close(stack, pairs, least):
    """List the pairs with -C above ``least`` and the first particle about pads; count them."""
    found = 0
    for group in range(0, pairs.end[0], PACK):
        close = 0
        for q in range(group, group + PACK, lanes(pairs.deficit)):
            close |= bits(load(pairs.deficit, q) > least) << (q - group)
        while close:
            k = group + lowest_bit(close)
            close &= close - 1
            if stack.about[np.uint32(pairs.particles[0, k])]:
                stack.found[found] = k
                found += 1
    return found


@jit(inline=True)
def back(stack, i, n, k):
    """Note that the pad of candidate k backs particle i along n; return True if that is new."""
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
def pad_behind(stack, i, x, y, z):
    """Return the candidate of the pad that backs particle i along (x, y, z), -1: none."""
    side = side_of(stack, i, x, y, z)
    return stack.behind[i, side] if side >= 0 else -1


@jit(inline=True)
def backing_of(stack, near, pairs, k):
    """
    Return candidates of the pads that back pair k.

    They are that of the side with b < 0 along n, and that of the side with b > 0 against n; -1:
    none.
    """
    n, below, above = pairs.normal, -1, -1
    for p in range(4):
        i, b = pairs.particles[p, k], pairs.weight[p, k]
        if i < len(near.slot) and b < -SHARE:
            below = max(below, pad_behind(stack, i, n[0, k], n[1, k], n[2, k]))
        elif i < len(near.slot) and b > SHARE:
            above = max(above, pad_behind(stack, i, -n[0, k], -n[1, k], -n[2, k]))
    return below, above


@jit(inline=True)
def pass_on(stack, near, pairs, k, least):
    """
    Let what backs one side of pair k back the other one; return True if that is new.

    ``least`` is the weight that its particles must exceed.
    """
    below, above = backing_of(stack, near, pairs, k)
    if below < 0 and above < 0:
        return False
    n, changed = (pairs.normal[0, k], pairs.normal[1, k], pairs.normal[2, k]), False
    for p in range(4):
        i, b = pairs.particles[p, k], pairs.weight[p, k]
        if i < len(near.slot) and b > least and below >= 0:
            changed |= back(stack, i, n, below)
        elif i < len(near.slot) and b < -least and above >= 0:
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
