"""Contacts: the pairs of particle and collider that may touch in a substep, and how they do."""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.colliders import Colliders, pose_at, to_local, to_world
from xpbd_ros.sim.jit import jit


class Contacts(NamedTuple):
    """The candidates of this substep; those with a push > 0 touch."""

    colliders: Colliders
    count: np.ndarray
    """candidates, and how many found no room in this frame; shape (2,)"""
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


def new_contacts(colliders: Colliders, room: int) -> Contacts:
    """Return room for that many candidates, none of them in use."""
    return Contacts(colliders, np.zeros(2, np.int64), np.zeros(room, np.int64),
                    np.zeros(room, np.int64), np.zeros(room), np.zeros(room), np.zeros(room),
                    np.zeros((room, 3)), np.zeros((room, 3)))


@jit
def surface_motion(contacts, k, state, substep):
    """Return how far the collider's surface at contact k moves in this substep [m]."""
    colliders, c, x = contacts.colliders, contacts.collider[k], state.x[:, contacts.particle[k]]
    after = pose_at(colliders, c, substep.end)
    if colliders.has_twist[c]:
        v, h, p = colliders.twist[c], substep.h, after[0]
        rx, ry, rz = x[0] - p[0], x[1] - p[1], x[2] - p[2]
        return ((v[0] + v[4] * rz - v[5] * ry) * h, (v[1] + v[5] * rx - v[3] * rz) * h,
                (v[2] + v[3] * ry - v[4] * rx) * h)
    lx, ly, lz = to_local(after, x[0], x[1], x[2])
    bx, by, bz = to_world(pose_at(colliders, c, substep.begin), lx, ly, lz)
    return x[0] - bx, x[1] - by, x[2] - bz
