"""
Motion limit: the last resort where projections of pair contacts and colliders do not converge.

At the substep's start a plane separates the two sides of each pair. Particles of pairs that would
still cross move only the fraction of their displacement that keeps them behind their planes
(A. Chen et al., "Offset geometric contact", 2025, bound the displacement itself); so do particles
that these then obstruct. The planes move with the common displacement of the colliders and pins on
which the pairs rest, so that no particle passes a collider either. Momentum is not conserved.

Pairs that pins and colliders still force through each other are counted.
"""

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.collider_motion import surface_motion
from xpbd_ros.sim.contact.corners import is_penetrating
from xpbd_ros.sim.particles.history import invalidate_history
from xpbd_ros.sim.self_collision.neighbour_list import gone, TRAVEL
from xpbd_ros.sim.self_collision.separating_planes import next_plane, parts

ALONE, PINNED, BESIDE, PUSHED = range(4)
"""source of held particles' common displacement, by rank: themselves, a pin, a collider nearby, a
collider that pushes"""


@jit
def mark(planes, near, state):
    """Set ``held`` for the particles of all pairs that cross; return how many are new."""
    more = 0
    if planes is not None:
        m = next_plane(planes, 0)
        while m < planes.end[0]:
            if not parts(planes, m, near, state.x):
                more += hold(planes, m, near)
            m = next_plane(planes, m + 1)
    return more


@jit
def hold(planes, m, near):
    """Set ``held`` for the particles of pair m; return how many are new."""
    more = 0
    for p in range(4):
        j = near.slot[planes.number[m, p]]
        if not planes.held[j]:
            planes.held[j] = True
            more += 1
    return more


@jit
def compute_shares(planes, near, state):
    """
    Compute ``share``: the fraction of its displacement relative to ``step`` a particle may make.

    The separating plane of each pair is midway between its sides at the substep's start, moved as
    far as pinned particles require.
    """
    planes.share[:] = 1.0
    m = next_plane(planes, 0)
    while m < planes.end[0]:
        limit_shares(planes, m, near, state)
        m = next_plane(planes, m + 1)


@jit
def limit_shares(planes, m, near, state):
    """Do so for the particles of pair m."""
    start, step, slot, n, x, w = (near.x, near.step, near.slot, planes.normal, state.x,
                                  state.inv_mass)
    side, number = planes.side[m], planes.number[m]
    first, above, below = number[0], np.inf, -np.inf
    for p in range(4):
        at = 0.0
        for a in range(3):
            at += n[m, a] * (start[number[p], a] - start[first, a])
        if p < side:
            above = min(above, at)
        else:
            below = max(below, at)
    clear = 0.51 * planes.need[m]
    plane = 0.5 * (above + below)
    for turn in range(2):    # first move the plane for pinned particles, then limit the others
        for p in range(4):
            i = number[p]
            j, at, go = slot[i], 0.0, 0.0
            for a in range(3):
                at += n[m, a] * (start[i, a] - start[first, a])
                go += n[m, a] * (x[a, j] - start[i, a] - step[a])
            if turn == 0:
                if w[j] == 0.0:
                    plane = (min(plane, at + go - clear) if p < side
                             else max(plane, at + go + clear))
                continue
            sign = 1.0 if p < side else -1.0
            room, go = sign * (at - plane), sign * go
            if room + go < clear and go < 0.0:
                planes.share[i] = min(planes.share[i], max(0.0, (room - clear) / -go))
        plane = min(max(plane, below + clear), above - clear)


@jit
def hold_back(planes, near, state):
    """Limit the displacement of held particles, and then of those that they obstruct."""
    compute_shares(planes, near, state)
    for i in range(len(near.slot)):
        if planes.stays[near.slot[i]]:
            planes.share[i] = 0.0
    for _ in range(len(near.slot)):
        for i in range(len(near.slot)):
            j = near.slot[i]
            if planes.held[j] and planes.share[i] < np.inf:
                go_share(near, state, i, planes.share[i])
                planes.share[i] = np.inf
        if mark(planes, near, state) == 0:
            break


@jit
def go_share(near, state, i, share):
    """Limit a particle's displacement relative to ``step`` to a share of it, and to ``travel``."""
    j = near.slot[i]
    moved = gone(state.x, near.x, near.step, j, i)
    if moved > near.x[i, TRAVEL]:
        share = min(share, near.x[i, TRAVEL] / moved)
    if share >= 1.0 or state.inv_mass[j] == 0.0:
        return
    near.count[2] += 1
    invalidate_history(state.history, j)
    for a in range(3):
        start = near.x[i, a] + near.step[a]
        state.x[a, j] = start + share * (state.x[a, j] - start)


@jit
def rest_step(near, held, contacts, state):
    """
    Set ``near.step`` to the mean displacement in this substep of what held particles rest on.

    That is, of the highest rank present: colliders that push them, colliders nearby, pinned
    particles among them, or the held particles themselves.
    """
    step, rank, count, x = near.step, ALONE, 0, state.x
    step[:] = 0.0
    for i in range(len(near.slot)):
        j = near.slot[i]
        if held[j]:
            rank, count = add_to_step(step, rank, count, PINNED if state.inv_mass[j] == 0.0
                                      else ALONE, (x[0, j] - near.x[i, 0], x[1, j] - near.x[i, 1],
                                                   x[2, j] - near.x[i, 2]))
    if contacts is not None:
        for k in range(contacts.count[0]):
            if held[contacts.particle[k]]:
                rank, count = add_to_step(step, rank, count, PUSHED if contacts.push[k] > 0.0
                                          else BESIDE, surface_motion(contacts, k, state))
    if count > 0:
        step /= count


@jit(inline=True)
def add_to_step(step, rank, count, one, way):
    """Add a displacement of rank ``one`` to the sum of the highest rank; return rank and count."""
    if one > rank:
        rank, count = one, 0
        step[:] = 0.0
    if one == rank:
        count += 1
        for a in range(3):
            step[a] += way[a]
    return rank, count


@jit
def mark_penetrating(contacts, marks, state):
    """Set ``marks`` for the particles that penetrate a collider, shape (slots,)."""
    if contacts is not None:
        for k in range(contacts.count[0]):
            if is_penetrating(contacts, k, state):
                marks[contacts.particle[k]] = True


@jit
def left_over(planes, near, contacts, state):
    """Return the number of pairs that cross and of contacts that penetrate."""
    count = 0
    m = next_plane(planes, 0)
    while m < planes.end[0]:
        count += not parts(planes, m, near, state.x)
        m = next_plane(planes, m + 1)
    if contacts is not None:
        for k in range(contacts.count[0]):
            count += is_penetrating(contacts, k, state)
    return count
