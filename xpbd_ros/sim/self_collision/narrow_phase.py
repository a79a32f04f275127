"""
Narrow phase: pairs of the neighbour list that may touch, or pass through each other, in a substep.

A pair contact acts along the direction between the pair's closest points. At the substep's start
this direction may oppose a sliding motion: cloth that slides over cloth approaches the triangle
ahead, and a contact with the normal at the start would stop it, although at the end it lies above
that triangle. So where that contact would push, the normal and the closest points at the end of
the sweep are used, unless the pair passes through each other before.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.self_collision.neighbour_list import (
    at,
    closest_vector,
    closest_vector_of_slots,
    corners,
    EDGES,
    length,
    POINTS,
    required_distance,
    TRIANGLES,
)
from xpbd_ros.sim.self_collision.separating_direction import part, write_vectors
from xpbd_ros.sim.self_collision.separating_planes import add_plane, CLEAR


@jit(inline=True)
def approach_bounds(near, kind, i, j, k, l):
    """Return bounds of a pair's approach in this substep, and since the build of the list [m]."""
    go, past = near.travel, near.drift_since_build
    if kind == EDGES:
        return max(go[i], go[j]) + max(go[k], go[l]), max(past[i], past[j]) + max(past[k], past[l])
    return go[i] + max(go[j], go[k], go[l]), past[i] + max(past[j], past[k], past[l])


@jit(inline=True)
def all_pinned(w, slot, b, i, j, k, l):
    """Return True if all of a pair's particles with nonzero weight are pinned."""
    return (w[slot[i]] * b[0] == 0.0 and w[slot[j]] * b[1] == 0.0 and w[slot[k]] * b[2] == 0.0
            and w[slot[l]] * b[3] == 0.0)


@jit(inline=True)
def is_inside(kind, b):
    """
    Return True unless the closest points of two edges include an end point.

    Pairs of a particle and a triangle cover those.
    """
    return kind != EDGES or b[0] > 0.0 and b[1] > 0.0 and b[2] < 0.0 and b[3] < 0.0


@jit
def list_candidates(near, surface, planes, touches, rubbing, state, thickness, apart, both):
    """
    List the pairs that may pass through each other in this substep; if ``both``, contacts too.

    Parameters
    ----------
    near : neighbour list
    surface : its triangles and edges, or None
    planes : receives the pairs that may pass through each other; None if only particles collide
    touches : receives the pairs that may come closer than the distance to be kept
    rubbing : friction data of ``touches``, or None
    state : particles
    thickness : distance to be kept [m]
    apart : largest depenetration in the substep [m]
    both : True to list ``touches`` too

    """
    kind, aside = POINTS, thickness if both else 0.0
    if planes is not None:
        planes.count[0] = 0
    if both:
        touches.count[0] = 0
    for c in range(near.kind_end[2]):
        while c >= near.kind_end[kind]:
            kind += 1
        i, j, k, l = corners(surface, kind, near.first[c], near.second[c])
        reach, moved = approach_bounds(near, kind, i, j, k, l)
        if near.distance[c] - moved > reach + aside:
            continue
        v, b = closest_vector(kind, near.x, i, j, k, l)
        distance = length(v)
        if distance > reach + aside or all_pinned(state.inv_mass, near.slot, b, i, j, k, l):
            continue
        if near.keep[c] < 0.0:
            near.keep[c] = required_distance(near.cloth, near.rest, kind, thickness, i, j, k, l)
        if planes is not None:    # noqa: SIM102  Numba prunes only branches on None alone
            if 0.0 < distance <= reach:
                add_plane(planes, 2 if kind == EDGES else 1, i, j, k, l,
                          (v[0] / distance, v[1] / distance, v[2] / distance), distance,
                          near.keep[c])
        if both and is_inside(kind, b):
            add_pair_contact(near, planes, touches, rubbing, state.x, kind, i, j, k, l, v, b,
                             distance, min(near.keep[c], distance + apart))


@jit
def add_pair_contact(near, planes, touches, rubbing, x, kind, i, j, k, l, v, b, distance, gap):
    """
    Append a pair to ``touches``.

    Parameters
    ----------
    kind, i, j, k, l : kind of the pair and its particles
    v, b, distance : vector between its closest points at the substep's start, weights, |v| [m]
    gap : distance to be kept [m]

    """
    n, slot, m = v, near.slot, touches.count[0]
    if distance == 0.0:
        n = fallback_normal(kind, at(near.x, i), at(near.x, j), at(near.x, k), at(near.x, l))
    size = length(n)
    if size == 0.0:
        return
    n = n[0] / size, n[1] / size, n[2] / size
    if distance > 0.0:
        good, n, b = contact_normal(planes, near, kind, i, j, k, l, n, b, distance, gap, x)
        if not good:
            return
    if m == len(touches.gap):
        touches.count[1] += 1
        return
    for a in range(3):
        touches.normal[m, a] = n[a]
    touches.gap[m] = gap
    touches.overlap[m] = max(0.0, gap - distance)
    touches.push[m] = 0.0
    touches.particles[m, 0], touches.weight[m, 0] = slot[i], b[0]
    touches.particles[m, 1], touches.weight[m, 1] = slot[j], b[1]
    if planes is not None:
        touches.particles[m, 2], touches.weight[m, 2] = slot[k], b[2]
        touches.particles[m, 3], touches.weight[m, 3] = slot[l], b[3]
    if rubbing is not None:
        for a in range(3):
            rubbing.slip[m, a] = 0.0
    touches.count[0] = m + 1


@jit
def contact_normal(planes, near, kind, i, j, k, l, n, b, distance, gap, x):
    """
    Return whether a pair is a contact, and its normal and weights.

    They are those of the substep's start (n, b) if these would not push, or if the pair passes
    through each other in the substep; else those of its end (see the module's docstring).
    """
    if planes is None:
        return True, n, b
    else:    # Numba prunes the branch that is not taken
        slot, along = near.slot, 0.0
        for a in range(3):    # differences: no loss of digits far from the origin
            along += n[a] * (b[1] * (x[a, slot[j]] - x[a, slot[i]])
                             + b[2] * (x[a, slot[k]] - x[a, slot[i]])
                             + b[3] * (x[a, slot[l]] - x[a, slot[i]]))
        if along >= gap:
            return True, n, b
        v, now = closest_vector_of_slots(kind, x, slot[i], slot[j], slot[k], slot[l])
        size = length(v)
        if size == 0.0:
            return True, n, b
        count = write_vectors(planes.points, 2 if kind == EDGES else 1, (i, j, k, l), near.x,
                              slot, x)
        if not part(planes.points, planes.shares, count, n, CLEAR * distance)[0]:
            return True, n, b
        return is_inside(kind, now), (v[0] / size, v[1] / size, v[2] / size), now


@jit
def fallback_normal(kind, p, q, r, s):
    """Return a direction (not normalised) that separates a pair at distance 0."""
    if kind == POINTS:
        return 0.0, 0.0, 1.0
    if kind == TRIANGLES:
        u = r[0] - q[0], r[1] - q[1], r[2] - q[2]
        v = s[0] - q[0], s[1] - q[1], s[2] - q[2]
    else:
        u = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        v = s[0] - r[0], s[1] - r[1], s[2] - r[2]
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
