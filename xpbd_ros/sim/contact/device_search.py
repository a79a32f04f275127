"""
Broad phase by all threads of a GPU: the candidates of ``contact.broad_phase``, in the same order.

Each thread marks the particles in reach. The place of a candidate is the number of marks before
its own; sums of FAN marks, of FAN such sums and so on tell those of whole parts of a row. Up to
ROWS colliders are searched at once.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import any_lane, highest
from xpbd_ros.sim.backend.simd_wide import wide
from xpbd_ros.sim.backend.threads import alone, count_up, turns, wait
from xpbd_ros.sim.contact.contacts import room_of
from xpbd_ros.sim.contact.pads import begin_pad
from xpbd_ros.sim.contact.reach import distances_to_keep, in_reach
from xpbd_ros.sim.contact.restitution import note_approach

FAN, ROWS = 32, 8


class Marks(NamedTuple):
    """Marks of ROWS colliders, and sums of them; int32, with room for whole sums."""

    close: np.ndarray
    """1 if a particle is in reach of a collider, shape (ROWS, slots)"""
    ones: np.ndarray
    """sums of FAN marks, shape (ROWS, …)"""
    twos: np.ndarray
    """sums of FAN of them"""
    threes: np.ndarray
    """sums of FAN of those"""


def new_marks(slots: int) -> Marks:
    """Return empty lists."""
    ones = -(-slots // FAN)
    twos = -(-ones // FAN)
    threes = -(-twos // FAN)
    return Marks(*(np.zeros((ROWS, count), np.int32)
                   for count in (FAN * ones, FAN * twos, FAN * threes, threes)))


@jit
def search_by_all(marks, contacts, bounce, state, substep):
    """Do what ``find_candidates`` does; ``marks`` is that of ``Contacts``."""
    team, count = state.team, contacts.colliders.count[0]
    wait(team)    # until all have read the count of candidates
    if alone(team):
        contacts.first[0] = contacts.count[0] = contacts.count[3] = 0
    for begin in range(0, count, ROWS):
        rows = min(ROWS, count - begin)
        mark(marks, contacts, state, begin, rows)
        add_parts(team, marks.close, marks.ones, rows)
        add_parts(team, marks.ones, marks.twos, rows)
        add_parts(team, marks.twos, marks.threes, rows)
        if alone(team):
            assign_places(marks, contacts, begin, rows)
        wait(team)
        enter_marked(marks, contacts, bounce, state, substep, begin, rows)
        wait(team)
    if count == 0:
        wait(team)


@jit(inline=True)
def mark(marks, contacts, state, begin, rows):
    """Mark the particles in reach of colliders ``begin``, …, ``begin`` + ``rows`` - 1."""
    first, end, step = turns(state.team, len(state.inv_mass))
    for i in range(first, end, step):
        if begin == 0:
            contacts.latest[i] = -1
        for row in range(rows):
            close = any_lane(in_reach(contacts, state, begin + row, i, wide(np.inf)))
            marks.close[row, i] = 1 if close else 0
    wait(state.team)


@jit
def add_parts(team, numbers, sums, rows):
    """Write the sums of FAN numbers."""
    count = numbers.shape[1] // FAN
    first, end, step = turns(team, rows * count)
    for n in range(first, end, step):
        row, part = n // count, n % count
        found = 0
        for k in range(FAN):
            found += numbers[row, part * FAN + k]
        sums[row, part] = found
    wait(team)


@jit
def assign_places(marks, contacts, begin, rows):
    """Write where the candidates of the colliders begin, and how many have no room."""
    room = room_of(contacts)
    for row in range(rows):
        place = contacts.first[begin + row]
        for part in range(marks.threes.shape[1]):
            place += marks.threes[row, part]
        contacts.count[1] += max(0, place - room)
        contacts.first[begin + row + 1] = min(place, room)
    contacts.count[0] = contacts.first[begin + rows]


@jit(inline=True)
def enter_marked(marks, contacts, bounce, state, substep, begin, rows):
    """Write the candidates of the marked particles."""
    several = False
    first, end, step = turns(state.team, len(state.inv_mass))
    for i in range(first, end, step):
        for row in range(rows):
            if marks.close[row, i]:
                k = contacts.first[begin + row] + marks_before(marks, row, i)
                if k < contacts.first[begin + row + 1]:
                    enter(contacts, bounce, state, substep, begin + row, i, k)
                    several |= contacts.earlier[k] >= 0
    if several:
        count_up(state.team, contacts.count, 3, 1)


@jit(inline=True)
def marks_before(marks, row, i):
    """Return the number of marks of a row before number i."""
    found = 0
    for k in range(FAN):    # all loads at once
        found += (k < i % FAN) * marks.close[row, i // FAN * FAN + k]
    i //= FAN
    for k in range(FAN):
        found += (k < i % FAN) * marks.ones[row, i // FAN * FAN + k]
    i //= FAN
    for k in range(FAN):
        found += (k < i % FAN) * marks.twos[row, i // FAN * FAN + k]
    for k in range(i // FAN):
        found += marks.threes[row, k]
    return found


@jit(inline=True)
def enter(contacts, bounce, state, substep, c, i, k):
    """Write candidate k, of collider c and particle i."""
    start, limit, gap, overlap = distances_to_keep(contacts, state, c, i, substep.h)
    contacts.particle[k], contacts.collider[k] = i, c
    contacts.gap[k], contacts.overlap[k] = highest(gap), highest(overlap)
    contacts.push[k], contacts.crossed[k] = 0.0, 0
    for a in range(3):
        contacts.slip[k, a] = 0.0
    contacts.earlier[k], contacts.latest[i] = contacts.latest[i], k
    begin_pad(contacts.pads, contacts, k, highest(start), highest(limit))
    note_approach(bounce, contacts, k)
