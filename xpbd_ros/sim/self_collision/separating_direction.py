"""
Search for a direction that separates the two sides of a pair throughout a substep.

A side is a particle, an edge or a triangle. Particles move in straight lines within a substep, so
any vector from one side to the other, at any time in between, is a convex combination of the
vectors p between their particles at the start and at the end. If n · p > 0 for all p, the sides do
not cross within the substep; if there is no such n, the convex hull of the p contains the origin.

The point v of the hull closest to the origin is found by the algorithm of B. Mitchell,
V. Demyanov, V. Malozemov, "Finding the point of a polyhedron closest to the origin", 1974: v is a
convex combination of the p, and each step shifts weight from the p with the largest v · p to the
one with the smallest, as far as that shortens v.
"""

from math import inf, sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.closest_points import dot, minus
from xpbd_ros.sim.self_collision.neighbour_list import at

STEPS = 40
"""most steps of the search; a pair that is not separated by then counts as crossing"""


@jit
def write_vectors(points, side, number, start, slot, x):
    """
    Write the vectors p between a pair's sides, at the substep's start and then at its end [m].

    Parameters
    ----------
    points : output, shape (8, 3)
    side : number of particles on the first side
    number : the pair's particles in natural order, the first side first, shape (4,)
    start : positions at the substep's start in natural order [m], shape (particles, 3)
    slot : slot of each particle, shape (particles,)
    x : positions at the substep's end [m], shape (3, slots)

    Returns
    -------
    number of vectors at the start; as many follow for the end

    """
    count = side * (4 - side)
    k = 0
    for p in range(side):
        i = number[p]
        for q in range(side, 4):
            j = number[q]
            for a in range(3):
                apart = start[i, a] - start[j, a]
                points[k, a] = apart
                points[count + k, a] = apart + ((x[a, slot[i]] - start[i, a])
                                                - (x[a, slot[j]] - start[j, a]))
            k += 1
    return count


@jit(inline=True)
def least_along(points, first, last, n):
    """Return the smallest n · p of points[first:last], and its index."""
    least, which = dot(at(points, first), n), first
    for k in range(first + 1, last):
        along = dot(at(points, k), n)
        if along < least:
            least, which = along, k
    return least, which


@jit
def part(points, share, count, n, need):
    """
    Return whether a direction separates a pair's sides throughout the substep, and the best one.

    Parameters
    ----------
    points : output of ``write_vectors``
    share : scratch for their weights, shape (8,)
    count : number of vectors at the start
    n : unit vector that separates the sides at the start by ``need``
    need : distance to be kept [m]

    Returns
    -------
    True if the sides are at least ``need`` apart along the direction at start and end; the
    direction, which separates them by ``need`` at the start in any case

    """
    best, most = n, least_along(points, count, 2 * count, n)[0]
    if most >= need:
        return True, best
    v = 0.0, 0.0, 0.0
    for k in range(2 * count):
        share[k] = 0.5 / count
        v = add(v, share[k], at(points, k))
    for _ in range(STEPS):
        size = sqrt(dot(v, v))
        if size < need:    # the closest point of the hull is closer still: no direction suffices
            break
        m = v[0] / size, v[1] / size, v[2] / size
        first, k = least_along(points, 0, count, m)
        last, l = least_along(points, count, 2 * count, m)
        if first >= need and last > most:
            best, most = m, last
            if most >= need:
                return True, best
        low, high, ahead = l if last < first else k, 0, -inf
        for k in range(2 * count):
            if share[k] > 0.0 and dot(at(points, k), m) > ahead:
                high, ahead = k, dot(at(points, k), m)
        way = minus(at(points, low), at(points, high))
        square = dot(way, way)
        step = -dot(v, way) / square if square > 0.0 else 0.0
        if step <= 0.0:
            break
        step = min(step, share[high])
        share[high] -= step
        share[low] += step
        v = add(v, step, way)
    return False, best


@jit(inline=True)
def add(v, share, p):
    """Return v + share p."""
    return v[0] + share * p[0], v[1] + share * p[1], v[2] + share * p[2]
