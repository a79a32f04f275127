"""
The impulses of edges on pinned particles, along the directions they were projected with.

As ``constraints.pinned``, for edges on grids: a sweep over runs stops at each edge in question,
notes its direction and multiplier, and collects n Δf afterwards.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone, wait
from xpbd_ros.sim.constraints.grid_batches import listed, Runs
from xpbd_ros.sim.constraints.pinned import remember, room_for
from xpbd_ros.sim.constraints.projection import at_the_end


class Held(NamedTuple):
    """The edges at pinned particles, whose reaction forces are requested."""

    count: np.ndarray
    """shape (1,)"""
    particles: np.ndarray
    """slots, shape (room, 2)"""
    index: np.ndarray
    """where each keeps its force, shape (room,)"""
    rest_length: np.ndarray
    """[m], shape (room,)"""
    compliance: np.ndarray
    """[m/N], shape (room,)"""


class Stops(NamedTuple):
    """Where a sweep over runs stops for edges at pinned particles, and what is noted of them."""

    held: Held
    """the edges, in sweep order"""
    first: np.ndarray
    """number of each run's first of them, and how many there are; shape (runs + 1,)"""
    direction: np.ndarray
    """n of each, as it is projected; shape (room, 3)"""
    before: np.ndarray
    """f of each before that [N], shape (room,)"""


def room(count: int) -> Held:
    """Return a list for as many edges as there are."""
    return Held(*room_for(count, 2), np.zeros(count), np.zeros(count))


def stops_for(runs: Runs) -> Stops:
    """Return the stops of a sweep over some runs."""
    count = len(listed(runs)[1])
    return Stops(room(count), np.zeros(len(runs.start) + 1, np.int64), np.zeros((count, 3)),
                 np.zeros(count))


@jit
def note(stops, first, last, x, y, z, apart, force):
    """Note the directions and multipliers of some edges at pinned particles."""
    if stops is not None:
        for k in range(first, last):
            i, j = stops.held.particles[k, 0], stops.held.particles[k, 1]
            dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
            l = np.sqrt(dx * dx + dy * dy + dz * dz)
            per = 1.0 / l if l > 0.0 else 0.0
            stops.direction[k, 0] = per * dx
            stops.direction[k, 1] = per * dy
            stops.direction[k, 2] = per * dz
            stops.before[k] = force[stops.held.index[k]] if at_the_end(apart) else 0.0


@jit
def gather_reaction(stops, first, last, mobility, force, part, reaction):
    """Add what they exerted since, n Δf; what cannot move is for ``react_edges``."""
    if stops is not None:
        for k in range(first, last):
            i, j = stops.held.particles[k, 0], stops.held.particles[k, 1]
            if mobility[i] + mobility[j] > 0.0:
                df = part * (force[stops.held.index[k]] - stops.before[k])
                for a in range(3):
                    reaction[a, i] += df * stops.direction[k, a]
                    reaction[a, j] -= df * stops.direction[k, a]


@jit
def note_line(stops, base, state, force):
    """Note the edges at pinned particles whose multipliers begin at ``base``, before a solve."""
    if stops is not None:
        if alone(state.team):
            for k in range(stops.held.count[0]):
                if base <= stops.held.index[k] < base + state.x.shape[1]:
                    note(stops, k, k + 1, state.x[0], state.x[1], state.x[2], state.apart, force)
        wait(state.team)


@jit
def gather_line_reaction(stops, base, state, force, part):
    """Add what they exerted in the solve."""
    if stops is not None:
        if alone(state.team):
            for k in range(stops.held.count[0]):
                if base <= stops.held.index[k] < base + state.x.shape[1]:
                    gather_reaction(stops, k, k + 1, state.mobility, force, part, state.reaction)
        wait(state.team)


@jit
def note_packs(packs, first_, last, x, apart, force):
    """Note n and -n of the edges of a pack."""
    if packs is not None:
        remember(packs, first_, last, apart, force)
        for k in range(first_, last):
            i, j = packs.held.particles[k, 0], packs.held.particles[k, 1]
            dx, dy, dz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
            l = np.sqrt(dx * dx + dy * dy + dz * dz)
            per = 1.0 / l if l > 0.0 else 0.0
            for a, d in enumerate((dx, dy, dz)):
                packs.gradient[k - first_, 0, 0, a] = per * d
                packs.gradient[k - first_, 0, 1, a] = -per * d


@jit
def react_edges(held, force, state, substep):
    """
    Add what edges exert that cannot move: -C / α n between two pins.

    What is taut between two pins (``constraints.overextended_lines``) pulls with the f that it was
    given.
    """
    weight, x = substep.end - substep.begin, state.x
    for k in range(held.count[0]):
        i, j, c = held.particles[k, 0], held.particles[k, 1], held.index[k]
        if state.mobility[i] + state.mobility[j] > 0.0:
            continue
        dx, dy, dz = x[0, i] - x[0, j], x[1, i] - x[1, j], x[2, i] - x[2, j]
        l = np.sqrt(dx * dx + dy * dy + dz * dz)
        if l == 0.0:
            continue
        f = force[c]
        if state.inv_mass[i] + state.inv_mass[j] == 0.0 and held.compliance[k] > 0.0:
            f = -(l - held.rest_length[k]) / held.compliance[k]
        f *= weight / l
        for a, d in enumerate((dx, dy, dz)):
            state.reaction[a, i] += f * d
            state.reaction[a, j] -= f * d
