"""
Tether: upper bounds on the distance of particles from pinned ones (long-range attachments).

C = |x - a| - r ≤ 0 for a particle x and a pinned particle a, gradient n = (x - a) / |x - a|,
α = 0. A particle beyond the bound is moved back onto it,

    f = -C / m where C > 0,   x += m f n,

with r = (1 + slack) times the shortest way from a to x over the surface at rest (Kim, Chentanez
and Müller 2012, algorithm 1): on a grid, which is flat, the straight line; on other meshes the
shortest path of straight lines across at most ACROSS edges (``geometry.geodesics``). Each group of
neighbouring pinned particles holds every particle by its nearest member, up to GROUPS groups each;
paths and groups are recomputed when a pin grasps or releases. So solver error does not accumulate
along the cloth, even with few substeps. Tethers precede contact in each iteration.

A particle that begins a substep beyond its bound, where pins held the cloth stretched or grasp it
so, comes back at the speed CLOSING: r is then the distance at the substep's start less h CLOSING.

Limits: a bound without elasticity: it hides real stretch beyond ``slack``, so leave it out where
accuracy counts. On meshes ways are up to 8 % too long, more where triangles are slivers; in a body
of tetrahedra they follow edges. Cloth without pins has no tethers.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import turns, turns_on_device, wait
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.geometry.geodesics import shortest, straight_lines
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.stepping.stages import prepare, project_inequalities, stage

GROUPS = 4
"""most pinned groups that hold one particle"""
ACROSS = 4
"""most edges that a straight line crosses"""
CLOSING = 1.0
"""speed at which what begins a substep beyond its bound comes back [m/s]"""


@dataclass(frozen=True)
class Parameters:
    """The slack of the tethers."""

    slack: float = quantity(0.05, minimum=0.0, live=True,
                            doc='slack, relative to the geodesic distance')


class Pulls(NamedTuple):
    """Forces on pinned particles before they are added up, where threads share the tethers."""

    order: np.ndarray
    """indices of the tethers in rising order of the pinned particle, shape (room,)"""
    force: np.ndarray
    """f n of the last projection, times the substep's part of the frame [N], shape (3, room)"""


class Tether(NamedTuple):
    """Data of the kernels."""

    count: np.ndarray
    """tethers, shape (1,)"""
    particle: np.ndarray
    """slot of the particle of each, in rising order, shape (room,)"""
    pinned: np.ndarray
    """slot of its pinned particle, shape (room,)"""
    longest: np.ndarray
    """r [m], shape (room,)"""
    force: np.ndarray
    """f [N], negative in tension, shape (room,)"""
    pulls: Pulls | None
    """None with one thread"""


@stage(prepare, Tether, on_device=True)
@jit
def prepare_tethers(tether, state, substep):
    """Zero the forces."""
    begin, end, turn = turns_on_device(state.team, tether.count[0])
    for t in range(begin, end, turn):
        tether.force[t] = 0.0


@stage(project_inequalities, Tether, shared=True)
@jit
def pull_back(tether, state, substep):
    """Project the tethers of each particle, one after another; threads share the particles."""
    count, particle = tether.count[0], tether.particle
    begin, end, turn = turns(state.team, count)
    for first in range(begin, end, turn):
        i = particle[first]
        if first == 0 or particle[first - 1] != i:
            t = first
            while t < count and particle[t] == i:
                _project(tether, t, state, substep)
                t += 1
    wait(state.team)
    _add_up(tether.pulls, tether, state)


@jit(inline=True)
def _project(tether, t, state, substep):
    """Project tether t."""
    x, i, a, most = state.x, tether.particle[t], tether.pinned[t], tether.longest[t]
    dx, dy, dz = x[0, i] - x[0, a], x[1, i] - x[1, a], x[2, i] - x[2, a]
    square = dx * dx + dy * dy + dz * dz
    if square > most * most and state.mobility[i] > 0.0:
        l, before = np.sqrt(square), state.x_prev
        most = max(most, np.sqrt(
            (before[0, i] - before[0, a])**2 + (before[1, i] - before[1, a])**2
            + (before[2, i] - before[2, a])**2) - CLOSING * substep.h)
        short = min(0.0, most - l)
        back = short / l
        x[0, i] += back * dx
        x[1, i] += back * dy
        x[2, i] += back * dz
        f = short / state.mobility[i]
        tether.force[t] += f
        pull = (substep.end - substep.begin) * f / l
        _pull(tether.pulls, t, a, pull * dx, pull * dy, pull * dz, state.reaction)
    else:
        _store(tether.pulls, t, 0.0, 0.0, 0.0)


@jit(inline=True)
def _pull(pulls, t, a, fx, fy, fz, reaction):
    """Add the force of tether t on its pinned particle, -f n, or store it."""
    if pulls is None:
        _pull_at(reaction, a, fx, fy, fz)
    _store(pulls, t, fx, fy, fz)


@jit(inline=True)
def _store(pulls, t, fx, fy, fz):
    """Store the force of tether t."""
    if pulls is not None:
        pulls.force[0, t], pulls.force[1, t], pulls.force[2, t] = fx, fy, fz


@jit(inline=True)
def _pull_at(reaction, a, fx, fy, fz):
    """Add the force on a pinned particle."""
    if reaction is not None:
        reaction[0, a] -= fx
        reaction[1, a] -= fy
        reaction[2, a] -= fz


@jit
def _add_up(pulls, tether, state):
    """Add the forces on pinned particles; threads share these."""
    if pulls is not None:
        count, order, pinned, force = tether.count[0], pulls.order, tether.pinned, pulls.force
        begin, end, turn = turns(state.team, count)
        for first in range(begin, end, turn):
            a = pinned[order[first]]
            if first == 0 or pinned[order[first - 1]] != a:
                k = first
                while k < count and pinned[order[k]] == a:
                    t = order[k]
                    _pull_at(state.reaction, a, force[0, t], force[1, t], force[2, t])
                    k += 1
        wait(state.team)


@dataclass
class Ways:
    """The neighbours and the ways over the surface of one cloth, and its tethers."""

    slots: np.ndarray
    """of its particles, shape (particles,)"""
    edges: csr_array
    """between neighbours"""
    lines: csr_array | None
    """straight ways at rest [m]; None on a grid, where all ways are straight"""
    rest: np.ndarray
    """unstressed positions [m], shape (particles, 3)"""
    slack: float

    @staticmethod
    def of(cloth, slack: float) -> 'Ways':
        """Return the graphs of a cloth; in a strip of one row, neighbours are those in the row."""
        mesh, lines = cloth.mesh, None
        ends, count = mesh.edges, len(mesh.positions)
        if mesh.grid is not None and not len(ends):
            row = mesh.grid.ravel()
            ends = np.stack([row[:-1], row[1:]], 1)
        d = length(mesh.positions[ends[:, 0]] - mesh.positions[ends[:, 1]])
        if mesh.grid is None:
            pairs, across = straight_lines(mesh.positions, mesh.triangles, ACROSS)
            pairs, ways = shortest(np.concatenate([ends, pairs]), np.concatenate([d, across]))
            lines = coo_array((ways, pairs.T), (count, count)).tocsr()
        return Ways(cloth.slots, coo_array((d, ends.T), (count, count)).tocsr(), lines,
                    mesh.positions, slack)

    def shortest(self, pinned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the way from each particle to the nearest of some pinned ones [m], and which."""
        if self.lines is None:
            way, nearest = cKDTree(self.rest[pinned]).query(self.rest)
            return way, pinned[nearest]
        way, _, source = dijkstra(self.lines, directed=False, indices=pinned,
                                  return_predecessors=True, min_only=True)
        return way, source

    def tethers(self, inv_mass: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return particle, pinned particle (slots) and r [m] of each tether."""
        pinned = np.flatnonzero(inv_mass[self.slots] == 0.0)
        none = np.zeros(0, np.int64)
        if not len(pinned) or len(pinned) == len(self.slots):
            return none, none, np.zeros(0)
        _, group = connected_components(self.edges[pinned][:, pinned], directed=False)
        found = [self.shortest(pinned[group == g]) for g in range(group.max() + 1)]
        ways, nearest = (np.array(each) for each in zip(*found))
        free = np.flatnonzero(inv_mass[self.slots] > 0.0)
        order = np.argsort(ways[:, free], 0, kind='stable')[:GROUPS]
        particle = np.broadcast_to(free, order.shape)
        way = ways[order, particle]
        there = np.isfinite(way)
        source = nearest[order, particle]
        return (self.slots[particle[there]], self.slots[source[there]],
                (1.0 + self.slack) * way[there])


class BuiltTether(Built):
    """The tethers of all cloths with this effect, while particles are pinned."""

    explicit_velocity_lags = True
    incompatible_with = ('ndf2',)    # it damps too little for limits that engage abruptly

    def __init__(self, parameters, world):
        super().__init__()
        if not world.pins:
            self.notes = [f'cloths.{cloth.name}.effects.tether: does nothing, for the scene has '
                          'no pins; add pins or effects.pin, or leave tether out'
                          for cloth in parameters]
        self._ways = [Ways.of(cloth, chosen.slack) for cloth, chosen in parameters.items()]
        room = GROUPS * sum(len(ways.slots) for ways in self._ways) if world.pins else 0
        self.data = Tether(np.zeros(1, np.int64), np.zeros(room, np.int64),
                           np.zeros(room, np.int64), np.zeros(room), np.zeros(room),
                           Pulls(np.zeros(room, np.int64), np.zeros((3, room)))
                           if world.threads > 1 else None)

    def hold(self, inv_mass):
        found = [np.concatenate(columns) for columns in zip(
            *(ways.tethers(inv_mass) for ways in self._ways))]
        order = np.argsort(found[0], kind='stable')
        self.data.count[0] = len(order)
        for column, numbers in zip(self.data[1:4], found):
            column[:len(order)] = numbers[order]
        if self.data.pulls is not None:
            self.data.pulls.order[:len(order)] = np.argsort(found[1][order], kind='stable')

    def read_by_stats(self):
        return self.data.force,

    def stats(self):
        taut = self.data.force[:self.data.count[0]] < 0.0
        return {'tethers': len(taut), 'tethers_taut': int(taut.sum())}


EFFECT = Effect('tether', Parameters, BuiltTether)
