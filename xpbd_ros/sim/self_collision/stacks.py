"""
Squeezed pairs: the pair contacts of layers of cloth between two pads, or a pad and a collider.

A particle is backed along n if a collider pushes it along n, or would where the collider carries
it from the substep's start, or if a pair contact would push it along n whose other side is backed
along n. A pair is squeezed if the colliders behind its sides would press them together, and one of
them is a pad. Normals and weights of these pairs are those at the substep's start, not at the end
of the sweep (``narrow_phase``): pads hold what elastic forces displace by several times the
thickness in a sweep.

Pairs that share particles, directly or through other pairs, form an island, and are solved apart
from other islands, whatever the number of threads.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone, turns, wait_uneven
from xpbd_ros.sim.contact.collider_motion import surface_motion
from xpbd_ros.sim.contact.contacts import DEPENETRATION
from xpbd_ros.sim.contact.corners import contact_distance
from xpbd_ros.sim.self_collision.close_pairs import ClosePairs, find_close, new_close_pairs
from xpbd_ros.sim.self_collision.neighbour_list import at, INV_MASS

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
    """number of pairs, of particles, of islands, and of passes over layers; shape (4,)"""
    begin: np.ndarray
    """begin of each island's pairs, particles and springs; shape (particles + 1, 3)"""
    sizes: np.ndarray
    """number of each island's pairs and particles, shape (particles, 2)"""
    pairs: np.ndarray
    """squeezed pairs by island: places among the close pairs, shape (pairs,)"""
    particles: np.ndarray
    """their particles by island, shape (particles,)"""
    place: np.ndarray
    """place of a particle in its island, -1: none; shape (particles + 1,)"""
    close: ClosePairs
    axis: np.ndarray
    """direction in which a particle is backed first, shape (particles + 1, 3)"""
    behind: np.ndarray
    """
    candidates of the colliders that back it along and against that, -1: none; (particles + 1, 2)
    """
    since: np.ndarray
    """pass over layers in which what backs it last changed, -1: nothing does; (particles + 1,)"""
    low: np.ndarray
    """scratch: lower corner of a box about the particles that a pad backs [m], (colliders, 3)"""
    high: np.ndarray
    """scratch: its upper corner [m], shape (colliders, 3)"""
    about: np.ndarray
    """scratch: True for particles about the pads, shape (particles + 1,)"""
    island: np.ndarray
    """scratch: island of each particle in ``particles``, shape (particles,)"""
    unsorted: np.ndarray
    """scratch: pairs or particles before they are sorted by island"""


def new_stack(particles: int, pairs: int, colliders: int) -> Stack:
    """Return storage for these numbers."""
    return Stack(
        np.zeros(4, np.int64), np.zeros((particles + 1, 3), np.int64),
        np.zeros((particles, 2), np.int64), np.zeros(pairs, np.int64),
        np.zeros(particles, np.int64), np.full(particles + 1, -1), new_close_pairs(pairs),
        np.zeros((particles + 1, 3)), np.full((particles + 1, 2), -1),
        np.full(particles + 1, -1), np.zeros((colliders, 3)), np.zeros((colliders, 3)),
        np.zeros(particles + 1, np.bool_), np.zeros(particles, np.int64),
        np.zeros(max(pairs, particles), np.int64))


@jit
def list_stack(team, stack, contacts, near, pairs, state, thickness, h):
    """List the squeezed pairs of a substep and their particles, by island."""
    if alone(team):
        stack.count[:] = 0
        stack.since[:] = stack.behind[:] = -1
        stack.low[:] = np.inf
        stack.high[:] = -np.inf
        back_by(stack, contacts, near, state, True, 0.0)
    wait_uneven(team)
    mark_about(team, stack, near, LAYERS * thickness)
    wait_uneven(team)
    find_close(team, stack.close, stack.about, near, pairs, -CLOSE * thickness, DEPENETRATION * h)
    if alone(team):
        back_layers(stack, near)
        back_by(stack, contacts, near, state, False, CLOSE * thickness)    # along axes set by pads
        back_layers(stack, near)
        list_squeezed(stack, contacts, near)
        sort_by_island(stack, contacts, near)
    wait_uneven(team)


@jit
def back_layers(stack, near):
    """Let the close pairs pass on what backs them, from layer to layer."""
    for _ in range(LAYERS):
        before, changed = stack.count[3], False
        stack.count[3] += 1
        for n in range(stack.close.count[1]):
            m = stack.close.found[n]
            if is_backed_since(stack, m, before):
                changed |= pass_on(stack, near, m)
        if not changed:
            break


@jit(inline=True)
def is_backed_since(stack, m, turn):
    """Return True if what backs a particle of pair m has changed in a pass or after it."""
    since, particles = stack.since, stack.close.particles
    return max(max(since[particles[0, m]], since[particles[1, m]]),
               max(since[particles[2, m]], since[particles[3, m]])) >= turn


@jit
def list_squeezed(stack, contacts, near):
    """List the squeezed pairs and their particles, in the order of the pairs."""
    stack.place[:] = -1
    for n in range(stack.close.count[1]):
        m = stack.close.found[n]
        if is_backed_since(stack, m, 0):
            below, above = backing_of(stack, near, m)
            if below >= 0 and above >= 0 and (
                    contacts.pads.soft[below] or contacts.pads.soft[above]):
                list_pair(stack, near, m)
    for n in range(stack.count[0]):
        back_rest(stack, near, stack.pairs[n])


@jit
def sort_by_island(stack, contacts, near):
    """Sort pairs and particles by island, in the order of the islands' first particles."""
    begin, island, unsorted = stack.begin, stack.island, stack.unsorted
    find_islands(stack, near)
    count_by_island(stack, contacts, near)
    for m in range(stack.count[0]):
        unsorted[m] = stack.pairs[m]
    for m in range(stack.count[0]):
        c = island_of(stack, unsorted[m])
        stack.pairs[begin[c, 0]] = unsorted[m]
        begin[c, 0] += 1
    for q in range(stack.count[1]):
        unsorted[q] = stack.particles[q]
    for q in range(stack.count[1]):
        c = island[q]
        stack.particles[begin[c, 1]] = unsorted[q]
        begin[c, 1] += 1
    for c in range(stack.count[2], 0, -1):    # they are the ends by now
        begin[c, 0], begin[c, 1] = begin[c - 1, 0], begin[c - 1, 1]
    begin[0, 0] = begin[0, 1] = 0
    for c in range(stack.count[2]):
        for q in range(begin[c, 1], begin[c + 1, 1]):
            stack.place[stack.particles[q]] = q - begin[c, 1]


@jit
def count_by_island(stack, contacts, near):
    """Write ``begin``."""
    begin = stack.begin
    begin[:stack.count[2] + 1] = 0
    for m in range(stack.count[0]):
        c = island_of(stack, stack.pairs[m])
        begin[c + 1, 0] += 1
        begin[c + 1, 2] += 1
    for q in range(stack.count[1]):
        c, k = stack.island[q], last_candidate(contacts, near.slot[stack.particles[q]])
        begin[c + 1, 1] += 1
        while k >= 0:
            begin[c + 1, 2] += 1
            k = contacts.earlier[k]
    for c in range(stack.count[2]):
        for a in range(3):
            begin[c + 1, a] += begin[c, a]


@jit(inline=True)
def island_of(stack, m):
    """Return the island of pair m, before its particles are sorted."""
    return stack.island[stack.place[stack.close.particles[0, m]]]


@jit
def find_islands(stack, near):
    """Number the islands, and write that of each particle (union-find)."""
    root, particles = stack.island, stack.close.particles
    for q in range(stack.count[1]):
        root[q] = q
    for n in range(stack.count[0]):
        m = stack.pairs[n]
        first = root_of(root, stack.place[particles[0, m]])
        for p in range(1, 4):
            i = particles[p, m]
            if i < len(near.slot):
                other = root_of(root, stack.place[i])
                first, other = min(first, other), max(first, other)
                root[other] = first
    stack.count[2] = 0
    for q in range(stack.count[1]):
        if root[q] == q:
            root[q] = stack.count[2]
            stack.count[2] += 1
        else:    # the root came before, and is numbered
            root[q] = root[root[q]]


@jit(inline=True)
def root_of(root, q):
    """Return the first particle of the island of particle q as known so far."""
    while root[q] != q:
        root[q] = root[root[q]]
        q = root[q]
    return q


@jit(inline=True)
def last_candidate(contacts, j):
    """Return the last candidate of the particle in slot j, -1: none."""
    k = contacts.latest[j]
    return k if k < contacts.count[0] and contacts.particle[k] == j else -1


@jit(inline=True)
def list_pair(stack, near, m):
    """List pair m and its particles."""
    stack.pairs[stack.count[0]] = m
    stack.count[0] += 1
    for p in range(4):
        i = stack.close.particles[p, m]
        if i < len(near.slot) and stack.place[i] < 0:
            stack.place[i] = stack.count[1]
            stack.particles[stack.count[1]] = i
            stack.count[1] += 1


@jit(inline=True)
def back_rest(stack, near, m):
    """Copy normal and backing of pair m to its particles that are not backed from both sides."""
    close, (below, above) = stack.close, backing_of(stack, near, m)
    for p in range(4):
        i = close.particles[p, m]
        if i < len(near.slot) and close.weight[p, m] != 0.0 and (
                stack.behind[i, 0] < 0 or stack.behind[i, 1] < 0):
            stack.behind[i, 0], stack.behind[i, 1] = below, above
            for a in range(3):
                stack.axis[i, a] = close.normal[a, m]


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
def mark_about(team, stack, near, reach):
    """Mark the particles nearer to a box than ``reach``."""
    first, end, step = turns(team, len(near.slot))
    for i in range(first, end, step):
        stack.about[i] = False
    for c in range(len(stack.low)):
        low_x, low_y, low_z = at(stack.low, c)
        high_x, high_y, high_z = at(stack.high, c)
        if low_x <= high_x:
            for i in range(first, end, step):
                x, y, z = at(near.x, i)
                stack.about[i] |= ((low_x - reach < x) & (x < high_x + reach)
                                   & (low_y - reach < y) & (y < high_y + reach)
                                   & (low_z - reach < z) & (z < high_z + reach))


@jit(inline=True)
def back(stack, i, n, k):
    """Note that candidate k's collider backs particle i along n; return True if that is new."""
    axis = stack.axis
    if stack.behind[i, 0] < 0 and stack.behind[i, 1] < 0:
        axis[i, 0], axis[i, 1], axis[i, 2] = n
    side = side_of(stack, i, n[0], n[1], n[2])
    if side < 0 or stack.behind[i, side] >= 0:
        return False
    stack.behind[i, side], stack.since[i] = k, stack.count[3]
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
def backing_of(stack, near, m):
    """
    Return candidates of the colliders that back pair m.

    They are that of the side with b < 0 along n, and that of the side with b > 0 against n; -1:
    none.
    """
    close, n, below, above = stack.close, stack.close.normal, -1, -1
    for p in range(4):
        i, b = close.particles[p, m], close.weight[p, m]
        if i < len(near.slot) and b < -SHARE:
            below = max(below, collider_behind(stack, i, n[0, m], n[1, m], n[2, m]))
        elif i < len(near.slot) and b > SHARE:
            above = max(above, collider_behind(stack, i, -n[0, m], -n[1, m], -n[2, m]))
    return below, above


@jit(inline=True)
def pass_on(stack, near, m):
    """Let what backs one side of pair m back the other one; return True if that is new."""
    close, (below, above) = stack.close, backing_of(stack, near, m)
    if below < 0 and above < 0:
        return False
    n, changed = (close.normal[0, m], close.normal[1, m], close.normal[2, m]), False
    for p in range(4):
        i, b = close.particles[p, m], close.weight[p, m]
        if i < len(near.slot) and b > SHARE and below >= 0:
            changed |= back(stack, i, n, below)
        elif i < len(near.slot) and b < -SHARE and above >= 0:
            changed |= back(stack, i, (-n[0], -n[1], -n[2]), above)
    return changed


@jit(inline=True)
def pair_of(stack, n):
    """Return the number of squeezed pair n among the near pairs."""
    return stack.close.number[stack.pairs[n]]


@jit(inline=True)
def mobility_of_pair(near, pairs, k):
    """Return W = Σ w b² of pair k."""
    total = 0.0
    for p in range(4):
        i, b = pairs.particles[p, k], float(pairs.weight[p, k])
        if i < len(near.slot):
            total += near.precise_move[i, INV_MASS] * b * b
    return total
