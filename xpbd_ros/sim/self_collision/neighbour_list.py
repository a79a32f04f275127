"""
Neighbour list (Verlet list): pairs of particles, or of triangles and edges, that may come close.

A pair is listed if it is closer than thickness + margins at the positions y, with the largest
margin of each side. Later, with the common displacement U and s_i = |x_i - y_i - U|, its distance
has decreased by at most the sum of the largest s of both sides; so while no s exceeds the
particle's margin, pairs that are not listed are further apart than the thickness. Particles that
leave their margins get new y and margins, and only their pairs are sought.
``self_collision.pair_search`` lists pairs in an order that only the rest shape and the positions
determine, so that memory layout does not affect the bits.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lowest_bit
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.backend.threads import alone, count_up, turns, wait_uneven, worker, workers
from xpbd_ros.sim.geometry.box_tree import BoxTree, new_box_tree
from xpbd_ros.sim.geometry.closest_points import dot
from xpbd_ros.sim.particles.history import invalidate_history
from xpbd_ros.sim.self_collision.inverse_mass import inverse_mass
from xpbd_ros.sim.self_collision.list_order import Moves, new_moves

POINTS, TRIANGLES, EDGES = range(3)
"""kinds of pairs: two particles, particle and triangle, two edges"""
TRAVEL = INV_MASS = 3
"""last column of the records of particles"""
BEYOND = 0.25
"""least motion that projections are assumed to add, relative to that of the prediction"""
UP = 1.0 + 1e-6
"""for bounds that are rounded to float32"""
ROUNDING = 4e-7
"""bound of the rounding errors of float32 distances, relative to the largest coordinate"""
UNKNOWN = -1.0
"""distance to be kept that is not computed yet"""
CANDIDATES = 1024
"""pairs whose distance the search computes at once, a multiple of PACK"""
FULL, TOLD, SUM = 3, 4, 5
"""
places in ``NeighbourList.plan`` behind those of the kinds, the ends of their pairs that stay:
how many threads have no room for what they find; a number that ``told`` passes on; the sum of
``sum_of``
"""


class Surface(NamedTuple):
    """Trees of the triangles and edges of all cloths."""

    triangles: BoxTree
    edges: BoxTree


class NeighbourList(NamedTuple):
    """The list, the positions of its build, and motion since; particles in natural order."""

    slot: np.ndarray
    """slot of each particle, shape (particles,)"""
    cloth: np.ndarray
    """index of each particle's cloth, shape (particles,)"""
    rest: np.ndarray
    """
    records in float32, shape (particles + 1, 4): rest positions relative to the first one [m],
    index of the cloth
    """
    reach: float
    """largest margin of a particle, unless two substeps' motion needs more [m]"""
    x: np.ndarray
    """
    records x, y, z, travel [m], shape (particles + 1, 4): positions at the substep's start, and a
    bound of each particle's distance from x + step in this substep; the last one is a dummy
    """
    start: np.ndarray
    """the same records in float32, relative to ``origin``"""
    move: np.ndarray
    """
    records in float32, shape (particles + 1, 4): displacement in this substep less ``step`` [m],
    ``inverse_mass`` times ``unit``
    """
    precise_move: np.ndarray
    """the same records in float64: what pairs add conserves momentum to its rounding"""
    loaded: np.ndarray
    """``precise_move`` before pair contacts changed it"""
    origin: np.ndarray
    """moves along with the common displacement [m], shape (3,)"""
    unit: float
    """mean mass of a particle [kg]"""
    seen: np.ndarray
    """y: positions when a particle's pairs were sought, less U then [m], shape (particles, 3)"""
    drift: np.ndarray
    """U: common displacement since all pairs were sought [m], shape (3,)"""
    step: np.ndarray
    """common displacement in this substep: mean of the pinned particles, or of all without pinned
    ones [m], shape (3,)"""
    margin: np.ndarray
    """motion of each particle for which the list is complete [m], shape (particles,)"""
    pruned: np.ndarray
    """positions at the last pruning, less U then [m], shape (particles, 3)"""
    inner: np.ndarray
    """motion of each particle for which the pairs in front are complete [m], shape (particles,)"""
    unpruned: np.ndarray
    """number of pairs in front that came from searches since the last pruning, shape (1,)"""
    count: np.ndarray
    """
    in this frame: searches; pairs beyond the capacity; particles held back; particles and pairs
    that penetrate nevertheless; searches for all particles; shape (5,)
    """
    complete: np.ndarray
    """False if the last search for all pairs found no room for some, shape (1,)"""
    kind_begin: np.ndarray
    """begin of the pairs of each kind in the list, a multiple of PACK, shape (3,)"""
    kind_end: np.ndarray
    """end of the pairs of each kind, shape (3,)"""
    kind_front: np.ndarray
    """end of the pairs of each kind that may be near until the next pruning, shape (3,)"""
    kind_room: np.ndarray
    """end of the capacity for each kind, a multiple of PACK, shape (3,)"""
    corners: np.ndarray
    """
    particles of each pair, one side first, unused ones the dummy, shape (4, capacity
    + CANDIDATES): candidates of the search are behind the capacity
    """
    keep: np.ndarray
    """distance to be kept [m], or UNKNOWN; shape (capacity + CANDIDATES,)"""
    renewed: np.ndarray
    """True for particles whose pairs the last search has sought, shape (particles + 1,)"""
    hits: np.ndarray
    """scratch: bits of those found of each PACK pairs of the list, shape (capacity / PACK,)"""
    marks: np.ndarray
    """scratch: bits of the pairs that pruning brings to the front, shape (capacity / PACK,)"""
    movers: np.ndarray
    """scratch: twice the place of each of them that is behind it, plus its bit in ``hits``"""
    grouped: np.ndarray
    """bits of those of them in groups (``self_collision.near_pairs``), shape (capacity / PACK,)"""
    regroup: np.ndarray
    """True if the groups do not hold all near pairs, shape (1,)"""
    plan: np.ndarray
    """scratch: what a thread tells the others, see FULL; shape (6,)"""
    largest: np.ndarray
    """scratch: largest travel of the particles of each thread [m], shape (threads,)"""
    parts: np.ndarray
    """scratch: number of near pairs that each thread has found, shape (threads,)"""
    pieces: np.ndarray
    """scratch: begin and number of the pairs found for each pack of a tree, shape (2, packs)"""
    buffers: np.ndarray | None
    """
    scratch: pairs that each thread finds, as ``corners``, shape (threads, 4, room + CANDIDATES);
    None with one thread
    """
    moves: Moves | None
    """None but on a GPU"""
    points: BoxTree
    """tree of the particles that collide: all, or the corners of triangles"""
    surface: Surface | None
    """None if only particles collide"""
    kin: np.ndarray | None
    """weld group: equal for particles that a seam joins, shape (particles,); None without seams"""
    h: np.ndarray | None
    """length of the substep [s], shape (1,); None in a scene without compliant pins"""


def spacing_of(cloths) -> float:
    """Return the shortest of the cloths' mean edge lengths [m]; 0 without edges."""
    lengths = [length.mean() for cloth in cloths if len(length := np.linalg.norm(
        np.diff(cloth.mesh.positions[cloth.mesh.edges], axis=1)[:, 0], axis=1))]
    return float(min(lengths, default=0.0))


def new_neighbour_list(cloths, room: int, surface: bool, unit: float,
                       kin: np.ndarray | None, threads: int, on_device: bool, *,
                       springs: bool) -> NeighbourList:
    """
    Return an empty list.

    Parameters
    ----------
    cloths : all cloths
    room : capacity in pairs
    surface : True for pairs of triangles and edges, False for pairs of particles
    unit : mean mass of a particle [kg]
    kin : weld groups, shape (particles,), or None
    threads : that seek pairs at once
    on_device : True for those of a GPU
    springs : True if compliant pins may hold particles

    """
    rest = np.concatenate([cloth.mesh.positions for cloth in cloths])
    cloth_of = np.repeat(np.arange(len(cloths)), [len(cloth.mesh.positions) for cloth in cloths])
    count, points, trees = len(rest), np.arange(len(rest)), None

    def tree(items: np.ndarray) -> BoxTree:
        return new_box_tree(items, rest, cloth_of, threads)
    most = len(rest)
    if surface:
        triangles = np.concatenate([cloth.mesh.triangles + cloth.first for cloth in cloths])
        sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
        points = np.unique(triangles)
        trees = Surface(tree(triangles), tree(np.unique(sides, axis=0).reshape(-1, 2)))
        most = max(most, *(each.corners.shape[1] for each in trees))
    room = (room + 3 * PACK - 1) // PACK * PACK
    records = np.zeros((count + 1, 4), np.float32)
    records[:-1, :3], records[:-1, 3] = rest - rest[0], cloth_of
    return NeighbourList(
        np.concatenate([cloth.slots for cloth in cloths]), cloth_of, records,
        0.25 * spacing_of(cloths), np.zeros((count + 1, 4)),
        np.zeros((count + 1, 4), np.float32), np.zeros((count + 1, 4), np.float32),
        np.zeros((count + 1, 4)), np.zeros((count + 1, 4)), np.zeros(3), unit,
        np.zeros((count, 3)), np.zeros(3), np.zeros(3), np.zeros(count), np.zeros((count, 3)),
        np.zeros(count), np.zeros(1, np.int64), np.zeros(5, np.int64), np.zeros(1, np.bool_),
        np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3, np.int64),
        np.zeros((4, room + CANDIDATES), np.int32), np.zeros(room + CANDIDATES, np.float32),
        np.zeros(count + 1, np.bool_), np.zeros(room // PACK, np.int32),
        np.zeros(room // PACK, np.int32), np.zeros(room, np.int32),
        np.zeros(room // PACK, np.int32), np.ones(1, np.bool_), np.zeros(6, np.int64),
        np.zeros(threads), np.zeros(threads, np.int64),
        np.zeros((2, -(-most // PACK)), np.int64),
        np.zeros((threads, 4, max(room // threads, CANDIDATES) + CANDIDATES), np.int32)
        if threads > 1 else None,
        new_moves(room) if on_device else None, tree(points[:, None]), trees, kin,
        np.zeros(1) if springs else None)


@jit(inline=True)
def room_of(near):
    """Return the capacity of the list in pairs."""
    return len(near.keep) - CANDIDATES


@jit(inline=True)
def at(x, i):
    """Return row i of an array."""
    return x[i, 0], x[i, 1], x[i, 2]


@jit(inline=True)
def are_welded(kin, a, b):
    """Return True if two particles are the same or in one weld group."""
    if kin is None:
        return a == b
    else:    # Numba prunes the branch that is not taken
        return kin[a] == kin[b]


@jit
def empty_groups(team, near):
    """Mark the groups as outdated after a change of the list."""
    first, end, step = turns(team, len(near.grouped))
    for pack in range(first, end, step):
        near.grouped[pack] = 0
    if alone(team):
        near.regroup[0] = True


@jit(inline=True)
def length(v):
    """Return |v|."""
    return sqrt(dot(v, v))


@jit(inline=True)
def next_marked(marks, k, end):
    """Return the first place from k on whose bit is set, PACK bits a mark; else one behind end."""
    while k < end:
        found = marks[k // PACK] >> k % PACK
        if found:
            return k + lowest_bit(np.int64(found))
        k += PACK - k % PACK
    return k


@jit(inline=True)
def told(team, near, value):
    """Return the main thread's value on all threads; all wait for one another."""
    wait_uneven(team)
    if alone(team):
        near.plan[TOLD] = value
    wait_uneven(team)
    return near.plan[TOLD]


@jit(inline=True)
def any_thread(team, near, found):
    """Return True on all threads if ``found`` is True on one of them; all wait for one another."""
    return sum_of(team, near, 1 if found else 0) > 0


@jit(inline=True)
def sum_of(team, near, number):
    """Return the sum of the threads' numbers on all of them; all wait for one another."""
    if number:
        count_up(team, near.plan, SUM, number)
    wait_uneven(team)
    if alone(team):
        near.plan[TOLD], near.plan[SUM] = near.plan[SUM], 0
    wait_uneven(team)
    return near.plan[TOLD]


@jit
def common_step(near, state):
    """Store the positions at the substep's start and the common displacement as predicted."""
    team, before = state.team, state.x_prev
    first, end, step = turns(team, len(near.slot))
    for i in range(first, end, step):
        j = near.slot[i]
        near.x[i, 0], near.x[i, 1], near.x[i, 2] = before[0, j], before[1, j], before[2, j]
    wait_uneven(team)
    if alone(team):
        find_step(near, state)
    wait_uneven(team)


@jit
def advance(near, state):
    """Add the common displacement in this substep: pushes may have stopped what was predicted."""
    find_step(near, state)
    for a in range(3):
        near.drift[a] += near.step[a]
        near.origin[a] += near.step[a]


@jit
def find_step(near, state):
    """Set ``near.step`` to the common displacement since the substep's start."""
    x, step, n, held = state.x, near.step, len(near.slot), 0
    step[:] = 0.0
    for i in range(n):
        j = near.slot[i]
        pinned = state.inv_mass[j] == 0.0
        if pinned and held == 0:
            step[:] = 0.0
        held += pinned
        for a in range(3):
            if pinned or held == 0:
                step[a] += x[a, j] - near.x[i, a]
    for a in range(3):
        step[a] /= held if held > 0 else n


@jit
def track_motion(team, near, x, slack):
    """
    Update the bounds of the particles' motion in this substep, the travel in ``near.x``.

    Parameters
    ----------
    team : threads that take part
    near : neighbour list
    x : predicted positions [m], shape (3, slots)
    slack : least motion that projections are assumed to add, besides BEYOND [m]

    Returns
    -------
    largest travel, on the main thread; True if a sum of travel and s exceeds the particle's margin

    """
    most, leaves = 0.0, False
    first, end, step = turns(team, len(near.slot))
    for i in range(first, end, step):
        moved = gone(x, near.x, near.step, near.slot[i], i)
        near.x[i, TRAVEL] = moved + max(BEYOND * moved, slack)
        most = max(most, near.x[i, TRAVEL])
        side = near.x[i, TRAVEL] + gone_since(near.x, near.seen, near.drift, i)
        leaves |= side > near.margin[i]
    near.largest[worker(team)] = most
    leaves = any_thread(team, near, leaves)
    if alone(team):
        for k in range(workers(team)):
            most = max(most, near.largest[k])
    return most, leaves


@jit(inline=True)
def gone(x, start, step, j, i):
    """Return |x_j - start_i - step|: a particle's motion relative to the common one [m]."""
    return length((x[0, j] - start[i, 0] - step[0], x[1, j] - start[i, 1] - step[1],
                   x[2, j] - start[i, 2] - step[2]))


@jit(inline=True)
def gone_since(x, seen, drift, i):
    """Return |x_i - seen_i - drift|: the same since a list was built [m]."""
    return length((x[i, 0] - seen[i, 0] - drift[0], x[i, 1] - seen[i, 1] - drift[1],
                   x[i, 2] - seen[i, 2] - drift[2]))


@jit
def rounding_of(near):
    """Return a bound of the rounding errors of distances of the records ``near.start`` [m]."""
    most = 0.0
    for i in range(len(near.slot)):
        most = max(most, abs(near.start[i, 0]), abs(near.start[i, 1]), abs(near.start[i, 2]))
    return ROUNDING * most


@jit
def load_starts(team, near):
    """Copy the positions at the substep's start and the travels to the float32 records."""
    start, x, origin = near.start, near.x, near.origin
    first, end, step = turns(team, len(near.slot))
    for i in range(first, end, step):
        for a in range(3):
            start[i, a] = x[i, a] - origin[a]
        start[i, TRAVEL] = UP * x[i, TRAVEL]


@jit
def load_moves(near, state):
    """Copy the displacements in this substep to the records."""
    first, end, step = turns(state.team, len(near.slot))
    for i in range(first, end, step):
        load_move(near, state, i)


@jit(inline=True)
def load_move(near, state, i):
    """Do so for one particle."""
    move, x, start, step = near.precise_move, state.x, near.x, near.step
    j = near.slot[i]
    for a in range(3):
        move[i, a] = near.move[i, a] = near.loaded[i, a] = x[a, j] - start[i, a] - step[a]
    move[i, INV_MASS] = near.move[i, INV_MASS] = near.unit * inverse_mass(near.h, state, j)


@jit
def store_moves(near, state):
    """Add what pair contacts have added to the displacements to the positions."""
    first, end, step = turns(state.team, len(near.slot))
    for i in range(first, end, step):
        store_move(near, state, i)


@jit(inline=True)
def store_move(near, state, i):
    """Do so for one particle."""
    move, loaded, x = near.precise_move, near.loaded, state.x
    dx, dy, dz = (move[i, 0] - loaded[i, 0], move[i, 1] - loaded[i, 1],
                  move[i, 2] - loaded[i, 2])
    if dx != 0.0 or dy != 0.0 or dz != 0.0:
        j = near.slot[i]
        x[0, j] += dx
        x[1, j] += dy
        x[2, j] += dz
        invalidate_history(state.history, j)
