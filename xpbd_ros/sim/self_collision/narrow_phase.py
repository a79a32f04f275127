"""
Narrow phase: which near pairs may touch, or pass through each other, in a substep; their normal.

A pair contact acts along the direction between the pair's closest points. At the substep's start
this direction may oppose a sliding motion: cloth that slides over cloth approaches the triangle
ahead, and a contact with the normal at the start would stop it, although at the end it lies above
that triangle. So where that contact would push, the normal and the closest points at the end of
the sweep are used, unless the pair passes through each other before.
"""

from math import sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    any_lane,
    bits,
    both,
    either,
    lanes,
    larger,
    load,
    lowest_bit,
    root,
    select,
    smaller,
    store,
)
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import alone, wait_uneven, worker
from xpbd_ros.sim.contact.contacts import DEPENETRATION
from xpbd_ros.sim.geometry.closest_points_simd import dot, minus
from xpbd_ros.sim.self_collision.near_pairs import (
    closest,
    is_inside,
    kept_distance,
    packs_of,
    travel_of,
)
from xpbd_ros.sim.self_collision.neighbour_list import (
    at,
    EDGES,
    length,
    POINTS,
)
from xpbd_ros.sim.self_collision.pair_contacts import (
    load_corners,
    mobility_of,
    NEVER,
    store_vector,
    store_weights,
    weighted,
)
from xpbd_ros.sim.self_collision.separating_direction import part, write_vectors
from xpbd_ros.sim.self_collision.separating_planes import (
    CLEAR,
    end_planes,
    forget_planes,
    set_plane,
)

STICKS = 20.0
"""relative speed below which μ_s holds cloth on cloth, over the length of a substep [m/s²]"""


@jit
def find_contacts(team, near, planes, pairs, state, h):
    """
    Set normals, weights and deficits of the near pairs, and list the planes.

    Parameters
    ----------
    team : threads that take part
    near : neighbour list, with the records of the substep's start and of the displacements
    planes : receives the pairs that may pass through each other; None if only particles collide
    pairs : pair contacts
    state : particles
    h : length of the substep [s]

    """
    if alone(team):
        end_planes(planes, pairs.end[0])
    first, end, step = packs_of(team, 0, pairs.end[0])
    for group in range(first, end, step):
        forget_planes(planes, group // PACK)
        for q in range(group, group + PACK, lanes(near.start)):
            find_some(near, planes, pairs, state.x, pairs.kind[group // PACK], q,
                      DEPENETRATION * h, worker(team))
            choose_friction(pairs.friction, pairs, near, q, state.v, STICKS * h)
    wait_uneven(team)


@jit(inline=True)
def find_some(near, planes, pairs, x, kind, q, apart, me):
    """Do so for a vector of pairs, on thread ``me``."""
    a, b, c, d = load_corners(near.start, pairs.particles, q)
    v, weight = closest(kind, a, b, c, d)
    distance, reach = root(dot(v, v)), travel_of(kind, a, b, c, d)
    zero = distance - distance
    store(pairs.push, q, zero)
    store(pairs.deficit, q, zero + NEVER)
    store(pairs.overlap, q, zero)
    zero_slip(pairs.friction, q, zero)
    keep = load(pairs.keep, q)
    close = distance <= reach + keep
    if kind == EDGES:
        close = both(close, either(is_inside(kind, weight), distance <= reach))
    if not any_lane(close):
        return
    starts, moves = (a, b, c, d), load_corners(near.move, pairs.particles, q)
    a, b, c, d = (plus(a, moves[0]), plus(b, moves[1]), plus(c, moves[2]), plus(d, moves[3]))
    close = both(close, mobility_of(weight, a, b, c, d) > 0.0)
    if not any_lane(close):
        return
    there = distance > 0.0
    per = 1.0 / select(there, distance, 1.0)
    n = per * v[0], per * v[1], per * v[2]
    store_vector(pairs.normal, q, n)
    store(pairs.deficit, q, distance)    # distance, for those that follow
    list_planes_of(planes, pairs, kind, q, bits(both(close, both(there, distance <= reach))))
    gap = smaller(keep, distance + apart)
    inside = both(close, is_inside(kind, weight))
    pushes = both(both(inside, there), dot(n, weighted(weight, a, b, c, d)) < gap)
    if any_lane(pushes):
        n, weight, inside = end_normals(planes, near, pairs, x, kind, q, pushes, inside, n,
                                        weight, distance, (a, b, c, d), me)
    store_vector(pairs.normal, q, n)
    store_weights(pairs, q, weight)
    a, b, c, d = starts
    store(pairs.deficit, q, select(inside, gap - dot(n, weighted(weight, a, b, c, d)), NEVER))
    overlap = select(inside, larger(gap - distance, 0.0), 0.0)
    store(pairs.overlap, q, overlap)
    unload(pairs.friction, q, select(gap < keep, overlap, 0.0))
    together = bits(both(inside, distance <= 0.0))
    if together:
        while together:
            separate(near, pairs, kind, q + lowest_bit(together))
            together &= together - 1


@jit(inline=True)
def choose_friction(friction, pairs, near, q, v, slow):
    """Set the coefficients of friction of a vector of pairs in this substep."""
    if friction is not None:
        choose_coefficient(friction.static, friction, pairs, near, q, v, slow)


@jit(inline=True)
def choose_coefficient(static, friction, pairs, near, q, v, slow):
    """
    Take μ_s where the contact slides by less than ``slow`` [m/s], else μ_k.

    Several pairs share the load of a particle, and none of them knows whether all of them together
    hold it.
    """
    if static is not None:
        for k in range(q, q + lanes(near.start)):
            friction.coefficient[k] = friction.slides[k]
            if pairs.deficit[k] > NEVER and slides_by(pairs, near, k, v) < slow:
                last = pairs.particles[3, k]
                friction.coefficient[k] = static[
                    near.cloth[pairs.particles[0, k]],
                    near.cloth[pairs.particles[1, k] if last == len(near.slot) else last]]


@jit(inline=True)
def slides_by(pairs, near, k, v):
    """Return the tangential speed of pair k at the substep's start [m/s]."""
    n, along, square = pairs.normal, 0.0, 0.0
    for a in range(3):
        u = 0.0
        for p in range(4):
            i = pairs.particles[p, k]
            if i < len(near.slot):
                u += pairs.weight[p, k] * v[a, near.slot[i]]
        along += n[a, k] * u
        square += u * u
    return sqrt(max(0.0, square - along * along))


@jit(inline=True)
def plus(start, move):
    """Return the records start + move, with the inverse mass."""
    return start[0] + move[0], start[1] + move[1], start[2] + move[2], move[3]


@jit(inline=True)
def zero_slip(friction, q, zero):
    """Zero the displacement by friction."""
    if friction is not None:
        store_vector(friction.slip, q, (zero, zero, zero))


@jit(inline=True)
def unload(friction, q, overlap):
    """Note the part of pushes that undoes overlaps too deep for one substep."""
    if friction is not None:
        store(friction.unloaded, q, overlap)


@jit(inline=True)
def list_planes_of(planes, pairs, kind, q, found):
    """List the pairs q + k of all bits k, from their normals and distances."""
    if planes is not None:
        planes.found[q // PACK] |= found << q % PACK
        while found:
            k = q + lowest_bit(found)
            found &= found - 1
            p, n = pairs.particles, pairs.normal
            set_plane(planes, k, 2 if kind == EDGES else 1, p[0, k], p[1, k], p[2, k], p[3, k],
                      (n[0, k], n[1, k], n[2, k]), pairs.deficit[k], pairs.keep[k])


@jit(inline=True)
def end_normals(planes, near, pairs, x, kind, q, pushes, inside, n, weight, distance, points, me):
    """
    Return the normals and weights of pairs, and which of them are contacts.

    They are those of the substep's start where these would not push, or where the pair passes
    through each other in the substep; else those of its end (see the module's docstring).
    """
    if planes is None:
        return n, weight, inside
    else:    # Numba prunes the branch that is not taken
        a, b, c, d = points
        v, now = closest(kind, a, b, c, d)
        size = root(dot(v, v))
        ab, ac, ad = dot(n, minus(b, a)), dot(n, minus(c, a)), dot(n, minus(d, a))
        zero = size - size
        least = (smaller(ab, zero) if kind == EDGES else zero) - larger(
            larger(ac, ad), ac if kind == EDGES else ab)
        good = both(both(pushes, size > 0.0), least >= CLEAR * distance)
        unknown = bits(both(pushes, both(size > 0.0, least < CLEAR * distance)))
        if unknown:
            store(pairs.overlap, q, select(good, 1.0, zero))
            while unknown:
                k = q + lowest_bit(unknown)
                unknown &= unknown - 1
                pairs.overlap[k] = is_separated(planes, near, pairs, x, kind, k, me)
            good = load(pairs.overlap, q) > 0.0
        per = 1.0 / select(size > 0.0, size, 1.0)
        n = (select(good, per * v[0], n[0]), select(good, per * v[1], n[1]),
             select(good, per * v[2], n[2]))
        inside = both(inside, either(is_inside(kind, now), select(good, zero, 1.0) > 0.0))
        return n, (select(good, now[0], weight[0]), select(good, now[1], weight[1]),
                   select(good, now[2], weight[2]), select(good, now[3], weight[3])), inside


@jit
def is_separated(planes, near, pairs, x, kind, k, me):
    """Return 1.0 if a direction separates the sides of pair k throughout the substep, else 0.0."""
    p, n, points = pairs.particles, pairs.normal, planes.points[me]
    count = write_vectors(points, 2 if kind == EDGES else 1,
                          (p[0, k], p[1, k], p[2, k], p[3, k]), near.x, near.slot,
                          x)
    return 1.0 if part(points, planes.shares[me], count, (n[0, k], n[1, k], n[2, k]),
                       CLEAR * pairs.deficit[k])[0] else 0.0


@jit
def separate(near, pairs, kind, k):
    """Set a normal that separates a pair at distance 0; none if there is no such direction."""
    p, x = pairs.particles, near.x
    n = fallback_normal(kind, at(x, p[0, k]), at(x, p[1, k]), at(x, p[2, k]), at(x, p[3, k]))
    size = length(n)
    if size == 0.0:
        pairs.deficit[k] = NEVER
        pairs.overlap[k] = 0.0
        return
    for a in range(3):
        pairs.normal[a, k] = n[a] / size


@jit
def list_planes(team, near, planes, thickness):
    """List the pairs of the whole neighbour list that may pass through each other."""
    if planes is not None:
        for kind in range(3):
            find_crossing(team, near, kind)
        wait_uneven(team)
        if alone(team):
            planes.end[0] = near.kind_end[EDGES]
            planes.found[:planes.end[0] // PACK + 1] = 0
            for kind in range(3):
                collect_planes(near, planes, kind, thickness)
        wait_uneven(team)


@jit(inline=True)
def find_crossing(team, near, kind):
    """Set ``hits`` to where this thread's part of a kind has pairs within their travels."""
    first, last, step = packs_of(team, near.kind_begin[kind], near.kind_front[kind])
    for pack in range(first, last, step):
        found = 0
        for q in range(pack, pack + PACK, lanes(near.start)):
            a, b, c, d = load_corners(near.start, near.corners, q)
            v, travel = closest(kind, a, b, c, d)[0], travel_of(kind, a, b, c, d)
            found |= bits(dot(v, v) <= travel * travel)
        near.hits[pack // PACK] = found


@jit
def collect_planes(near, planes, kind, thickness):
    """List the pairs of a kind that ``hits`` tells of."""
    for pack in range(near.kind_begin[kind], near.kind_front[kind], PACK):
        if near.hits[pack // PACK]:
            for q in range(pack, pack + PACK, lanes(near.start)):
                list_movable(near, planes, kind, q, thickness)


@jit(inline=True)
def list_movable(near, planes, kind, q, thickness):
    """List those pairs of a vector of listed pairs of which a particle can move."""
    a, b, c, d = load_corners(near.start, near.corners, q)
    v, weight = closest(kind, a, b, c, d)
    square, travel = dot(v, v), travel_of(kind, a, b, c, d)
    a, b, c, d = load_corners(near.move, near.corners, q)
    found = bits(both(both(square > 0.0, square <= travel * travel),
                      mobility_of(weight, a, b, c, d) > 0.0))
    if found:
        kept_distance(near, kind, q, thickness)
        list_planes_at(near, planes, kind, q, found, v)


@jit(inline=True)
def list_planes_at(near, planes, kind, q, found, v):
    """List the pairs q + k of all bits k in the neighbour list."""
    scratch = planes.vectors
    planes.found[q // PACK] |= found << q % PACK
    store_vector(scratch, 0, v)
    while found:
        lane = lowest_bit(found)
        found &= found - 1
        k, n = q + lane, (scratch[0, lane], scratch[1, lane], scratch[2, lane])
        i, j, l, m = near.corners[0, k], near.corners[1, k], near.corners[2, k], near.corners[3, k]
        distance = length(n)
        set_plane(planes, k, 2 if kind == EDGES else 1, i, j, l, m, (
            n[0] / distance, n[1] / distance, n[2] / distance), distance, near.keep[k])


@jit
def fallback_normal(kind, p, q, r, s):
    """Return a direction (not normalised) that separates a pair at distance 0."""
    if kind == POINTS:
        return 0.0, 0.0, 1.0
    if kind == EDGES:
        u = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        v = s[0] - r[0], s[1] - r[1], s[2] - r[2]
    else:
        u = r[0] - q[0], r[1] - q[1], r[2] - q[2]
        v = s[0] - q[0], s[1] - q[1], s[2] - q[2]
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
