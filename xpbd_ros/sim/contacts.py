"""Contacts: the pairs of particle and collider that may touch in a substep, and how they do."""

from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.colliders import Colliders, signed_distance, to_local, to_world, write_pose
from xpbd_ros.sim.crossing import look_back
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.multistep import lose_history
from xpbd_ros.sim.rotation import rotate

DEPENETRATION = 1.0
"""speed at which an overlap that was there before is undone [m/s]"""


class Contacts(NamedTuple):
    """The candidates of this substep; those with a push > 0 touch."""

    colliders: Colliders
    before: np.ndarray
    """poses at the substep's start, shape (capacity, 7)"""
    after: np.ndarray
    """poses at its end, shape (capacity, 7)"""
    moved: np.ndarray
    """how far each moves in the substep [m], shape (capacity,)"""
    turned: np.ndarray
    """how far its quaternion moves, about half the angle [rad], shape (capacity,)"""
    slack: np.ndarray
    """a particle that moves further than this in the substep may get through it [m], same shape"""
    up: np.ndarray
    """its z axis, the normal of a plane; shape (capacity, 3)"""
    count: np.ndarray
    """candidates; how many found no room in this frame; 1 where the last push held a particle back
    from what it would have got through; 1 where a particle is a candidate of two; shape (4,)"""
    thickness: np.ndarray
    """[m], shape (1,)"""
    latest: np.ndarray
    """of each slot the last candidate it was, maybe in another substep; shape (slots,)"""
    particle: np.ndarray
    """shape (room,)"""
    collider: np.ndarray
    """shape (room,)"""
    gap: np.ndarray
    """distance r to be kept [m], shape (room,)"""
    overlap: np.ndarray
    """part of the push that must not become velocity [m], shape (room,)"""
    push: np.ndarray
    """d, along the normal, so far in this substep [m], shape (room,)"""
    normal: np.ndarray
    """unit vector out of the collider, shape (room, 3)"""
    slip: np.ndarray
    """s, friction's displacement so far in this substep [m], shape (room, 3)"""
    crossed: np.ndarray
    """whether the particle's way through the substep meets the collider, shape (room,)"""
    side: np.ndarray
    """if so, the plane that it stays in front of: unit normal, offset [m]; shape (room, 4)"""


def new_contacts(colliders: Colliders, room: int, thickness: float, slots: int) -> Contacts:
    """Return room for that many candidates, none of them in use."""
    capacity = len(colliders.shape)
    return Contacts(colliders, np.zeros_like(colliders.start), np.zeros_like(colliders.start),
                    np.zeros(capacity), np.zeros(capacity), np.zeros(capacity),
                    np.zeros((capacity, 3)),
                    np.zeros(4, np.int64), np.array([thickness]), np.zeros(slots, np.int64),
                    np.zeros(room, np.int64),
                    np.zeros(room, np.int64), np.zeros(room), np.zeros(room), np.zeros(room),
                    np.zeros((room, 3)), np.zeros((room, 3)), np.zeros(room, np.bool_),
                    np.zeros((room, 4)))


@jit(inline=True)
def surface_motion(contacts, k, state, substep):
    """Return how far the collider's surface at contact k moves in this substep [m]."""
    colliders, c, i, p = (contacts.colliders, contacts.collider[k], contacts.particle[k],
                          contacts.after)
    x, y, z = state.x[0, i], state.x[1, i], state.x[2, i]
    if colliders.has_twist[c]:
        v, h = colliders.twist, substep.h
        rx, ry, rz = x - p[c, 0], y - p[c, 1], z - p[c, 2]
        return ((v[c, 0] + v[c, 4] * rz - v[c, 5] * ry) * h,
                (v[c, 1] + v[c, 5] * rx - v[c, 3] * rz) * h,
                (v[c, 2] + v[c, 3] * ry - v[c, 4] * rx) * h)
    if not colliders.moving[c]:
        return 0.0, 0.0, 0.0
    lx, ly, lz = to_local(p, c, x, y, z)
    bx, by, bz = to_world(contacts.before, c, lx, ly, lz)
    return x - bx, y - by, z - bz


@jit
def move_colliders(contacts, substep):
    """Put every collider where it is at the substep's start and end, and say how far that is."""
    for c in range(contacts.colliders.count[0]):
        write_pose(contacts.colliders, c, substep.begin, contacts.before)
        write_pose(contacts.colliders, c, substep.end, contacts.after)
        a, b = contacts.before, contacts.after
        contacts.moved[c] = sqrt((b[c, 0] - a[c, 0])**2 + (b[c, 1] - a[c, 1])**2
                                 + (b[c, 2] - a[c, 2])**2)
        contacts.turned[c] = sqrt((b[c, 3] - a[c, 3])**2 + (b[c, 4] - a[c, 4])**2
                                  + (b[c, 5] - a[c, 5])**2 + (b[c, 6] - a[c, 6])**2)
        arm = 2.0 * max(contacts.colliders.reach[c], 0.0)
        contacts.slack[c] = max(0.0, contacts.colliders.inner[c] - contacts.moved[c]
                                - arm * contacts.turned[c])
        up = rotate(b[c, 3], b[c, 4], b[c, 5], b[c, 6], 0.0, 0.0, 1.0)
        contacts.up[c, 0], contacts.up[c, 1], contacts.up[c, 2] = up


@jit
def push_once(contacts, state, back=False):
    """
    Push every candidate that is too deep out along the normal.

    On the way ``back`` each goes half of what is left, so that a particle between two colliders
    with less room than it wants ends in the middle, and not with the one that came last.
    """
    poses, held_back, count = contacts.after, False, contacts.count[0]
    for n in range(count):
        k = count - 1 - n if back else n
        i, c = contacts.particle[k], contacts.collider[k]
        x, y, z = state.x[0, i], state.x[1, i], state.x[2, i]
        x0, y0, z0 = state.x_prev[0, i], state.x_prev[1, i], state.x_prev[2, i]
        step = (x - x0)**2 + (y - y0)**2 + (z - z0)**2
        if not contacts.crossed[k] and step >= contacts.slack[c]**2:
            look_back(contacts, k, x0, y0, z0, x, y, z, contacts.thickness[0])
        lx, ly, lz = to_local(poses, c, x, y, z)
        phi, nx, ny, nz = signed_distance(contacts.colliders, c, lx, ly, lz)
        nx, ny, nz = rotate(poses[c, 3], poses[c, 4], poses[c, 5], poses[c, 6], nx, ny, nz)
        if contacts.crossed[k]:
            plane = contacts.side[k]
            ahead = plane[0] * x + plane[1] * y + plane[2] * z - plane[3]
            if ahead < phi:
                phi, nx, ny, nz = ahead, plane[0], plane[1], plane[2]
        before = contacts.push[k]
        push = max(contacts.gap[k] - phi, -before)
        if back:
            push = 0.5 * max(push, 0.0)
        if push == 0.0:
            continue
        held_back |= contacts.crossed[k] and push > 0.0
        contacts.push[k] = before + push
        state.x[0, i] += nx * push
        state.x[1, i] += ny * push
        state.x[2, i] += nz * push
        contacts.normal[k, 0], contacts.normal[k, 1], contacts.normal[k, 2] = nx, ny, nz
        lose_history(state.history, i)
    if held_back or not back:
        contacts.count[2] = held_back


@jit(inline=True)
def shortened(sx, sy, sz, sticks, slides):
    """Return friction's displacement: if longer than what sticks, as long as what slides [m]."""
    l = sqrt(sx * sx + sy * sy + sz * sz)
    if l > sticks:
        f = slides / l
        return f * sx, f * sy, f * sz
    return sx, sy, sz
