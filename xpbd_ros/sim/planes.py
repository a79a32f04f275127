"""
Planes: what parts the two sides of a near pair of surfaces, and that neither gets past it.

A. Chen et al., "Offset geometric contact", 2025, bound the way itself. As the way is straight, no
crossing begins within the substep either.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.multistep import lose_history
from xpbd_ros.sim.nearby import gone

CLEAR = 0.05
"""of a pair's distance: how far before its plane a side stops"""


class Planes(NamedTuple):
    """What stops at the planes."""

    side: np.ndarray
    """how many of a pair's particles are on the one side; 0: it has no plane; shape (room,)"""
    number: np.ndarray
    """particles in natural order, as ``Touches.particles``; shape (room, 4)"""
    share: np.ndarray
    """τ of each particle, shape (particles,)"""
    way: np.ndarray
    """room for where a pair's particles start and how far they go along n [m], shape (2, 4)"""


@jit
def part_sides(planes, near, touches, state):
    """Find how much of its way each particle may go."""
    if planes is not None:
        planes.share[:] = 1.0
        part(planes.share, planes.side, planes.number, planes.way, near.x, near.step, near.slot,
             touches.normal, touches.count[0], state.x, state.inv_mass)


@jit
def stop_all(planes, near, x, w, history):
    """Let each particle go only its share of the way, unless it is pinned."""
    for i in range(len(near.slot)):
        moved = gone(x, near.x, near.step, near.slot[i], i)
        share = near.travel[i] / moved if moved > near.travel[i] else 1.0
        if planes is not None:
            share = min(share, planes.share[i])
        j = near.slot[i]
        if share == 1.0 or w[j] == 0.0:
            continue
        near.count[2] += 1
        lose_history(history, j)
        for a in range(3):
            start = near.x[i, a] + near.step[a]
            x[a, j] = start + share * (x[a, j] - start)


@jit
def part(share, side, number, way, start, step, slot, n, count, x, w):
    """Stop both sides of each pair before the plane between them."""
    for m in range(count):
        if side[m] == 0:
            continue
        above, below = np.inf, -np.inf
        for p in range(4):
            i = number[m, p]
            j = slot[i]
            way[0, p] = (n[m, 0] * start[i, 0] + n[m, 1] * start[i, 1] + n[m, 2] * start[i, 2])
            way[1, p] = (n[m, 0] * (x[0, j] - start[i, 0] - step[0])
                         + n[m, 1] * (x[1, j] - start[i, 1] - step[1])
                         + n[m, 2] * (x[2, j] - start[i, 2] - step[2]))
            if p < side[m]:
                above = min(above, way[0, p])
            else:
                below = max(below, way[0, p])
        clear = CLEAR * (above - below)
        if clear <= 0.0:
            continue
        plane = 0.5 * (above + below)
        for p in range(4):    # what is pinned goes its way
            if w[slot[number[m, p]]] == 0.0:
                end = way[0, p] + way[1, p]
                plane = min(plane, end - clear) if p < side[m] else max(plane, end + clear)
        plane = min(max(plane, below + 2.0 * clear), above - 2.0 * clear)
        for p in range(4):
            sign = 1.0 if p < side[m] else -1.0
            room, go = sign * (way[0, p] - plane), sign * way[1, p]
            if room + go < clear:
                i = number[m, p]
                share[i] = min(share[i], max(0.0, (room - clear) / -go))
