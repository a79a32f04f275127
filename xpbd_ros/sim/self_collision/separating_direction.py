"""
Parting: a direction along which the two sides of a pair lie apart through a whole substep.

A side is a particle, an edge or a triangle. Particles go straight from where the substep starts to
where it ends, so every vector from the one side to the other, at any time in between, is a mean of
the vectors p between their particles at the start and at the end. If n · p > 0 for all of these,
nothing crosses within the substep; if there is no such n, the hull of p holds the origin.

The point v of that hull nearest to the origin is found after B. Mitchell, V. Demyanov,
V. Malozemov, "Finding the point of a polyhedron closest to the origin", 1974: v is a mean of the
p; weight goes from the p furthest ahead along v to the one furthest back, as long as that brings v
nearer.
"""

from math import inf, sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.closest_points import dot, minus

STEPS = 40
"""at most; what they do not part counts as crossing"""


@jit
def write_vectors(points, side, number, start, slot, x):
    """
    Write the vectors between a pair's sides, at the substep's start and then at its end [m].

    Parameters
    ----------
    points : room for them, shape (8, 3)
    side : how many particles are on the one side
    number : of its particles in natural order, those of that side first, shape (4,)
    start : where particles were, in natural order [m], shape (particles, 3)
    slot : where each particle lies, shape (particles,)
    x : where they are [m], shape (3, slots)

    Returns
    -------
    how many there are at the start; as many more are at the end

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
    """Return the smallest n · p of some vectors, and which it is of."""
    least, which = dot(at(points, first), n), first
    for k in range(first + 1, last):
        along = dot(at(points, k), n)
        if along < least:
            least, which = along, k
    return least, which


@jit
def part(points, share, count, n, need):
    """
    Return whether the sides part, and the best direction there is.

    Parameters
    ----------
    points : of ``write_vectors``
    share : room for their weights, shape (8,)
    count : how many are at the start
    n : a direction that parts the sides there by ``need``
    need : distance to be kept [m]

    Returns
    -------
    whether the sides are that far apart along the direction at both ends; and the direction, which
    at the start parts them by so much in any case

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
        if size < need:    # and the nearest point is nearer: nothing parts them
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
def at(points, k):
    """Return row k of an array."""
    return points[k, 0], points[k, 1], points[k, 2]


@jit(inline=True)
def add(v, share, p):
    """Return v + share p."""
    return v[0] + share * p[0], v[1] + share * p[1], v[2] + share * p[2]
