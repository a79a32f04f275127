"""Contact candidates (pairs of particle and collider) of a substep, and their projection."""

import copy
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    all_lanes,
    any_lane,
    both,
    either,
    larger,
    select,
    smaller,
)
from xpbd_ros.sim.backend.simd_wide import (
    any_true,
    gather,
    load_columns,
    load_wide,
    scatter,
    store_columns,
    store_wide,
    WIDTH,
)
from xpbd_ros.sim.backend.threads import alone, count_up, wait, worker
from xpbd_ros.sim.contact.colliders import (
    Colliders,
    has_pad,
    is_on_pad,
    normals_to_world,
    vectors_to_local,
)
from xpbd_ros.sim.contact.continuous_detection import detect_crossing
from xpbd_ros.sim.contact.corners import contact_distance, is_penetrating, leave_corners, SHORT
from xpbd_ros.sim.contact.near_blocks import NearBlocks, new_near_blocks
from xpbd_ros.sim.contact.pads import Pads, press_pads
from xpbd_ros.sim.contact.particle_lanes import is_run, place, positions
from xpbd_ros.sim.contact.pieces import candidate, rounds
from xpbd_ros.sim.contact.signed_distance_simd import depths, signed_distances
from xpbd_ros.sim.contact.wrenches import new_wrenches, react_to_turn, react_to_turns, Wrenches
from xpbd_ros.sim.particles.history import invalidate_history, touched
from xpbd_ros.sim.particles.memory_layout import zeros

DEPENETRATION = 1.0
"""largest speed of depenetration, for particles that begin a substep too deep [m/s]"""
CORNER = 8
"""most passes over the candidates, so that a particle stopped by one collider does not end behind
another"""


class Contacts(NamedTuple):
    """The candidates of this substep; those with push > 0 are contacts."""

    colliders: Colliders
    before: np.ndarray
    """collider poses at the substep's start, shape (capacity, 7)"""
    after: np.ndarray
    """collider poses at the substep's end, shape (capacity, 7)"""
    surface: np.ndarray
    """poses of the surfaces at the substep's start: those that move to ``after`` with the surface
    velocity, shape (capacity, 7)"""
    moved: np.ndarray
    """distance that each collider moves in the substep [m], shape (capacity,)"""
    turned: np.ndarray
    """norm of its quaternion's change in the substep, about half its rotation [rad], shape
    (capacity,)"""
    slack: np.ndarray
    """motion of a particle in the substep up to which it cannot pass through [m], shape
    (capacity,)"""
    up: np.ndarray
    """z axis of each collider, the normal of a plane, shape (capacity, 3)"""
    count: np.ndarray
    """number of candidates; of candidates without room in this frame; not 0 if the last pass
    stopped a particle that would have passed through; not 0 if a particle is a candidate of
    several colliders; number of those left inside one in this frame; not 0 if ``extra`` is; shape
    (6,)"""
    thickness: np.ndarray
    """[m], shape (1,)"""
    stir: np.ndarray
    """bound of the displacement of any particle by other effects in the rest of this substep [m];
    0 unless an effect sets it; shape (1,)"""
    latest: np.ndarray
    """index of each slot's last candidate, possibly of an earlier substep, shape (slots,)"""
    earlier: np.ndarray
    """index of the same particle's previous candidate, -1: none; shape (capacity,)"""
    particle: np.ndarray
    """slot, shape (capacity,)"""
    collider: np.ndarray
    """index, shape (capacity,)"""
    gap: np.ndarray
    """distance r to be kept [m], shape (capacity,)"""
    overlap: np.ndarray
    """part of the push that must not become velocity [m], shape (capacity,)"""
    push: np.ndarray
    """displacement d along the normal, accumulated in this substep [m], shape (capacity,)"""
    normal: np.ndarray
    """unit vector out of the collider, shape (capacity, 3)"""
    slip: np.ndarray
    """displacement s by friction, accumulated in this substep [m], shape (capacity, 3)"""
    crossed: np.ndarray
    """1 if the particle's path through the substep meets the collider, int32, shape (capacity,)"""
    side: np.ndarray
    """if so, the plane that the particle stays in front of: unit normal, offset [m]; shape
    (capacity, 4)"""
    extra: np.ndarray
    """impulse on the particle, of all its contacts at once, that is not in the wrenches yet [N s],
    shape (capacity, 3)"""
    first: np.ndarray
    """index of each collider's first candidate, shape (capacity + 1,)"""
    near: NearBlocks
    """particles that may come close, by collider"""
    scratch: np.ndarray
    """working memory of each thread, shape (threads, 4, WIDTH)"""
    wrenches: Wrenches
    """impulses that the colliders got from the cloth"""
    pads: Pads | None
    """None in a scene without pads"""
    marks: tuple | None
    """``device_search.Marks``; None on a CPU"""

    def in_use(self, other: 'Contacts') -> 'Contacts':
        """Return ``other`` without the room that this one does not use."""
        partial = other.wrenches.partial[:0]    # all 0
        return other._replace(wrenches=other.wrenches._replace(partial=partial), **{
            name: getattr(other, name)[:self.count[0]] for name in OF_CANDIDATES})

    def __deepcopy__(self, memo: dict) -> 'Contacts':
        """Return a copy; the room that is not in use, which is large, is empty."""
        for name in OF_CANDIDATES:
            array = getattr(self, name)
            copied = np.zeros(array.shape, array.dtype)    # pages never written take no time
            copied[:self.count[0]] = array[:self.count[0]]
            memo[id(array)] = copied
        memo[id(self.wrenches.partial)] = np.zeros_like(self.wrenches.partial)
        return Contacts._make(copy.deepcopy(value, memo) for value in self)


OF_CANDIDATES = ('earlier', 'particle', 'collider', 'gap', 'overlap', 'push', 'normal', 'slip',
                 'crossed', 'side', 'extra')
"""arrays of ``Contacts`` with a row for each candidate"""


def new_contacts(colliders: Colliders, room: int, thickness: float, slots: int,
                 threads: int, pads: Pads | None = None, marks: tuple | None = None) -> Contacts:
    """Return an empty list with the capacity of ``room`` candidates, and a vector of padding."""
    capacity = len(colliders.shape)

    def numbers(*shape):
        return zeros((room + WIDTH, *shape), np.float64)

    def integers():
        return zeros((room + WIDTH,), np.int64)

    return Contacts(colliders, np.zeros_like(colliders.start), np.zeros_like(colliders.start),
                    np.zeros_like(colliders.start),
                    np.zeros(capacity), np.zeros(capacity), np.zeros(capacity),
                    np.zeros((capacity, 3)),
                    np.zeros(6, np.int64), np.array([thickness]), np.zeros(1),
                    zeros((slots,), np.int64), integers(), integers(), integers(),
                    numbers(), numbers(), numbers(), numbers(3), numbers(3),
                    zeros((room + WIDTH,), np.int32), numbers(4), np.zeros((room, 3)),
                    np.zeros(capacity + 1, np.int64), new_near_blocks(colliders, slots, threads),
                    zeros((threads, 4, WIDTH), np.float64),
                    new_wrenches(capacity, slots, room, threads, on_device=marks is not None),
                    pads, marks)


@jit(inline=True)
def room_of(contacts):
    """Return the capacity in candidates."""
    return len(contacts.extra)


@jit
def push_all(contacts, state, eased):
    """
    Project all candidates; repeat for particles between several colliders.

    If ``eased``, only penetration is prevented, not the full thickness kept.
    """
    if not eased:
        press_pads(contacts.pads, contacts, state)
    turn = 0
    while turn <= CORNER:    # the last turn is backwards
        push_once(contacts, state, turn == CORNER, eased)
        turn += 1
        if turn < CORNER and not contacts.count[2]:
            turn = CORNER
        if turn == CORNER and not contacts.count[3]:
            break
        wait(state.team)    # until all have read the count
    if contacts.count[3]:
        leave_corners(contacts, state)


@jit(inline=True)
def wait_for_others(contacts, team):
    """Go on when all threads of a GPU are done with a collider, if particles have several."""
    if contacts.count[3]:
        wait(team)


@jit
def push_once(contacts, state, back, eased):
    """
    Project all candidates once: x += n Δd, Δd = max(r - φ, -d), d += Δd.

    With ``back``, in reverse order and by half of a positive Δd: a particle between two colliders
    closer than twice the thickness ends in the middle, not at the last one. With ``eased``, r is
    at most SHORT of the thickness, and Δd is not negative.
    """
    held_back, count, team = False, contacts.colliders.count[0], state.team
    if not back:
        if alone(team):
            contacts.count[2] = 0
        wait(team)
    if contacts.count[0] > 0:
        for n in range(count):
            c = count - 1 - n if back else n
            held_back |= push_from(contacts, c, state, back, eased)
            wait_for_others(contacts, team)
    if held_back:
        count_up(team, contacts.count, 2, 1)
    wait(team)


@jit(inline=True)
def push_from(contacts, c, state, back, eased):
    """Project the candidates of collider c; return True if one of those that crossed is pushed."""
    held_back, team, begin, last = False, state.team, contacts.first[c], contacts.first[c + 1]
    by_lanes = WIDTH > 1 and not has_pad(contacts.colliders.stiffness, c)
    for n in range(rounds(team, begin, last)):
        k = candidate(team, n, begin)
        if not (by_lanes and k + WIDTH <= last
                and push_pack(contacts, c, k, state, back, eased)):
            for j in range(k, min(k + WIDTH, last)):
                held_back |= push_candidate(contacts, j, state, back, eased)
    return held_back


@jit(inline=True)
def push_pack(contacts, c, k, state, back, eased):
    """
    Project the candidates k, k + 1, … of collider c by lanes, as ``push_candidate`` does.

    Return False if one of them crosses or may cross the collider.
    """
    index = contacts.particle
    x, y, z = positions(state.x, index, k)
    if not stays_within(contacts, c, k, state, x, y, z):
        return False
    lx, ly, lz = vectors_to_local(contacts.after, c, x, y, z)
    phi, nx, ny, nz = signed_distances(contacts.colliders, contacts.scratch[worker(state.team)],
                                       c, lx, ly, lz)
    before, gap = load_wide(contacts.push, k), load_wide(contacts.gap, k)
    if eased:
        gap = smaller(SHORT * contacts.thickness[0], gap)
    push = larger(-before, gap - phi)
    if eased:
        push = larger(0.0, push)
    if back:
        push = 0.5 * larger(0.0, push)
    moved = either(push > 0.0, push < 0.0)
    if not any_lane(moved):
        return True
    nx, ny, nz = normals_to_world(contacts.after, c, nx, ny, nz)
    again = both(moved, before > 0.0)
    if any_lane(again):
        react_to_turns(contacts, k, state, again, nx, ny, nz)
    store_wide(contacts.push, k, select(moved, before + push, before))
    place(state.x, index, k, select(moved, x + nx * push, x), select(moved, y + ny * push, y),
          select(moved, z + nz * push, z))
    if not all_lanes(moved):
        mx, my, mz = load_columns(contacts.normal, k)
        nx, ny, nz = select(moved, nx, mx), select(moved, ny, my), select(moved, nz, mz)
    store_columns(contacts.normal, k, nx, ny, nz)
    invalidate_histories(state.history, index, k, moved)
    return True


@jit(inline=True)
def stays_within(contacts, c, k, state, x, y, z):
    """Return True if no candidate k, k + 1, … crosses collider c, or moves far enough to do so."""
    slack = contacts.slack[c]
    if slack == np.inf:
        return True
    x0, y0, z0 = positions(state.x_prev, contacts.particle, k)
    dx, dy, dz = x - x0, y - y0, z - z0
    return not any_true(contacts.crossed, k) and all_lanes(
        dx * dx + dy * dy + dz * dz < slack * slack)


@jit
def invalidate_histories(history, index, k, moved):
    """Mark the particles index[k], … as TOUCHED where the mask is true."""
    if history is not None:
        if is_run(index, k):
            fresh = load_wide(history.fresh, index[k])
            store_wide(history.fresh, index[k], touched(fresh, moved))
        else:
            scatter(history.fresh, 0, index, k,
                    touched(gather(history.fresh, 0, index, k), moved))


@jit
def push_candidate(contacts, k, state, back, eased):
    """Project one candidate; return True if it has crossed its collider and is pushed."""
    i, c = contacts.particle[k], contacts.collider[k]
    if is_on_pad(contacts.pads, k):
        return False
    x, y, z = state.x[0, i], state.x[1, i], state.x[2, i]
    x0, y0, z0 = state.x_prev[0, i], state.x_prev[1, i], state.x_prev[2, i]
    step = (x - x0)**2 + (y - y0)**2 + (z - z0)**2
    if not contacts.crossed[k] and step >= contacts.slack[c]**2:
        detect_crossing(contacts, k, x0, y0, z0, x, y, z, contacts.thickness[0])
    phi, (nx, ny, nz) = contact_distance(contacts, k, x, y, z)
    before = contacts.push[k]
    gap = contacts.gap[k]
    if eased:
        gap = min(gap, SHORT * contacts.thickness[0])
    push = max(gap - phi, -before)
    if eased:
        push = max(push, 0.0)
    if back:
        push = 0.5 * max(push, 0.0)
    if push == 0.0:
        return False
    if before > 0.0:
        react_to_turn(contacts, k, state, before, nx, ny, nz)
    contacts.push[k] = before + push
    state.x[0, i] += nx * push
    state.x[1, i] += ny * push
    state.x[2, i] += nz * push
    contacts.normal[k, 0], contacts.normal[k, 1], contacts.normal[k, 2] = nx, ny, nz
    invalidate_history(state.history, i)
    return contacts.crossed[k] != 0 and push > 0.0


@jit
def count_penetrating(contacts, state):
    """Return how many of this thread's candidates penetrate (see ``corners.is_penetrating``)."""
    count, team = 0, state.team
    for c in range(contacts.colliders.count[0] if contacts.count[0] > 0 else 0):
        begin, last = contacts.first[c], contacts.first[c + 1]
        for n in range(rounds(team, begin, last)):
            k = candidate(team, n, begin)
            if not (WIDTH > 1 and k + WIDTH <= last and is_clear(contacts, c, k, state)):
                for j in range(k, min(k + WIDTH, last)):
                    count += is_penetrating(contacts, j, state)
    return count


@jit(inline=True)
def is_clear(contacts, c, k, state):
    """Return True if no candidate k, k + 1, … of collider c crosses or penetrates it."""
    if any_true(contacts.crossed, k):
        return False
    x, y, z = positions(state.x, contacts.particle, k)
    lx, ly, lz = vectors_to_local(contacts.after, c, x, y, z)
    phi = depths(contacts.colliders, contacts.scratch[worker(state.team)], c, lx, ly, lz)
    least = smaller(load_wide(contacts.gap, k) - SHORT * contacts.thickness[0], 0.0)
    return not any_lane(phi < least)


@jit(inline=True)
def shortened(sx, sy, sz, sticks, slides):
    """
    Return a displacement by friction (sx, sy, sz), clamped to the friction cone [m].

    If its length exceeds ``sticks``, the limit of static friction, it is scaled to ``slides``, the
    limit of sliding friction.
    """
    l = sqrt(sx * sx + sy * sy + sz * sz)
    if l > sticks:
        f = slides / l
        return f * sx, f * sy, f * sz
    return sx, sy, sz
