"""
Reaction forces of edges on pinned particles, along the directions of projection.

As in ``constraints.pinned``, for line solves: the direction n and the multiplier of each edge at a
pinned particle are recorded before the solve, and n Δf is added afterwards.
"""

from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone, wait
from xpbd_ros.sim.constraints.grid_batches import Runs
from xpbd_ros.sim.constraints.pinned import room_for, stops_for
from xpbd_ros.sim.constraints.projection import at_the_end


class Held(NamedTuple):
    """List of edges at pinned particles."""

    count: np.ndarray
    """length of the list, shape (1,)"""
    particles: np.ndarray
    """slots, shape (capacity, 2)"""
    index: np.ndarray
    """position of each multiplier in ``force``, shape (capacity,)"""
    rest_length: np.ndarray
    """[m], shape (capacity,)"""
    compliance: np.ndarray
    """[m/N], shape (capacity,)"""


class EdgeStops(NamedTuple):
    """``Stops`` of edges, and the record of their directions and multipliers for line solves."""

    held: Any
    """the edges, in sweep order"""
    first: np.ndarray
    """position in ``held`` of each run's first edge, and their number; shape (runs + 1,)"""
    direction: np.ndarray
    """n of each edge at its projection, shape (capacity, 3)"""
    before: np.ndarray
    """f of each edge before its projection [N], shape (capacity,)"""


def room(count: int, width: int = 2) -> Held:
    """Return an empty list for ``count`` edges."""
    return Held(*room_for(count, width), np.zeros(count), np.zeros(count))


def edge_stops_for(runs: Runs) -> EdgeStops:
    """Return empty lists for all edges of some runs."""
    stops = stops_for(runs, room)
    count = len(stops.held.index)
    return EdgeStops(*stops, np.zeros((count, 3)), np.zeros(count))


@jit
def note(stops, first, last, x, y, z, apart, force):
    """Record the directions and multipliers of the listed edges first:last."""
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
    """
    Add the forces n Δf that the listed edges first:last exerted since ``note``.

    ``part`` is the substep's fraction of the frame. Edges between two immobile particles are
    treated by ``react_edges``.
    """
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
    """Record the listed edges of one family before a line solve; its multipliers begin at base."""
    if stops is not None:
        if alone(state.team):
            for k in range(stops.held.count[0]):
                if base <= stops.held.index[k] < base + state.x.shape[1]:
                    note(stops, k, k + 1, state.x[0], state.x[1], state.x[2], state.apart, force)
        wait(state.team)


@jit
def gather_line_reaction(stops, base, state, force, part):
    """Add the forces that the listed edges of one family exerted in a line solve."""
    if stops is not None:
        if alone(state.team):
            for k in range(stops.held.count[0]):
                if base <= stops.held.index[k] < base + state.x.shape[1]:
                    gather_reaction(stops, k, k + 1, state.mobility, force, part, state.reaction)
        wait(state.team)


@jit
def react_edges(held, force, state, substep):
    """
    Add the forces of edges between two immobile particles: -C / α n between pinned ones.

    Edges of overextended lines (``constraints.overextended_lines``) pull with the f assigned
    there.
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
