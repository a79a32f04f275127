"""
Strain limit: no edge is longer than a given part more than at rest.

C = |x1 - x2| - L (1 + max) ≤ 0, gradient n = (x1 - x2) / |x1 - x2| at x1 and -n at x2, α = 0, and
a force f ≤ 0 that only pulls (Provot 1995; NUMERICS 2.12):

    Δf = min(-C / (m1 + m2), -f),   x1 += m1 n Δf,   x2 -= m2 n Δf

with mobilities m = w H². Where all edges keep to it is a convex set, so what is sought is the
point of it that is nearest to where the elastic forces left the particles, weighed by mass. On a
grid whole lines are solved at once (``sim.ropes``), warp and weft in turn, until no edge is
longer than it may be by more than EASE. Edges of other meshes take passes forth and back; since a
net that hangs by a corner would take thousands of them, each pair of passes starts from where the
last two lead (Nesterov 1983),

    x + β (x - x_before),   f + β (f - f_before),   β = (k - 1) / (k + 2),

with k counted anew when the largest excess has grown (O'Donoghue and Candès 2015). Where nothing
is too long one pass finds so. It comes last in each iteration, after all that is elastic and
before contact. Edges are those along warp and weft of a grid, and all of any other mesh.

Limits: it takes energy away, as an inelastic stop does; what it holds takes steps of backward
Euler, since an integrator that remembers would throw it back. Contact and friction come after it,
and pins further apart than the cloth may reach do not give way: ``strain_over_limit`` says how far
an edge is beyond the limit. Shear of a grid's cells is not limited.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.layout import zeros
from xpbd_ros.sim.lines import grid_lines, Lines
from xpbd_ros.sim.mesh import length
from xpbd_ros.sim.multistep import lose_history
from xpbd_ros.sim.packs import pack, padded
from xpbd_ros.sim.records import (
    load_records,
    new_records,
    store_records,
    to_positions,
    to_records,
)
from xpbd_ros.sim.ropes import tighten
from xpbd_ros.sim.stages import prepare, react, stage, touch
from xpbd_ros.sim.state import places
from xpbd_ros.sim.taut import hold, room_for, straighten, Taut
from xpbd_ros.sim.update import release_forces
from xpbd_ros.sim.vector import (
    both,
    fma,
    highest,
    lanes,
    larger,
    load,
    root,
    select,
    splat,
    store,
)

EASE = 3e-3
"""what an edge may be longer than the limit, relative"""
FINE, FEW = 1e-5, 8
"""the same in so many passes, if they suffice: what is left over makes forces chatter"""
NEAR = 3e-3
"""how much shorter than the limit an edge of a line may be that a first pass takes as pulling"""
PASSES = 200
"""most passes over all lines, or pairs of passes over the edges of meshes, in an iteration"""
GROWTH = 1.2
"""by how much the largest excess may grow before k is counted anew"""
SUBSTEPS = 8
"""what ``auto`` gives at least: with fewer, passes cost more than substeps"""


@dataclass(frozen=True)
class Parameters:
    """The limit."""

    max: float = quantity(0.1, minimum=0.0, live=True,
                          doc='largest strain; 0.1 is ten per cent')


class Pulled(NamedTuple):
    """The edges one by one, for the forces on pinned particles."""

    particles: np.ndarray
    """slots of both ends, shape (2, edges)"""
    index: np.ndarray
    """where each keeps its force, shape (edges,)"""


class StrainLimit(NamedTuple):
    """Data of the kernels: grids."""

    lines: Lines
    """as long as they may be"""
    force: np.ndarray
    """f [N], negative in tension, shape (2 grids * slots,)"""
    pulled: Pulled
    taut: Taut | None
    """None in a scene without pins"""


class MeshStrainLimit(NamedTuple):
    """Data of the kernels: other meshes, edges in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots of both ends, shape (2, edges)"""
    longest: np.ndarray
    """L (1 + max) [m], shape (edges,)"""
    force: np.ndarray
    """f [N], negative in tension, shape (edges,)"""
    before: np.ndarray
    """records after the last pair of passes, shape (slots, 4)"""
    force_before: np.ndarray
    """f [N] after the last pair of passes, shape (edges,)"""
    pulled: Pulled


@stage(prepare, StrainLimit)
@jit
def prepare_lines(limit, state, substep):
    """Zero the forces, but for lines that cannot be."""
    release_forces(None, limit.force)
    straighten(limit.taut, limit.lines, limit.force, state)


@stage(prepare, MeshStrainLimit)
@jit
def prepare_edges(limit, state, substep):
    """Zero the forces."""
    release_forces(None, limit.force)


@stage(touch, StrainLimit)
@jit
def limit_lines(limit, state, substep):
    """Put lines that are too long back, until none is."""
    for k in range(PASSES):
        most = tighten(limit.lines, limit.force, state, NEAR if k == 0 else 0.0)
        if most <= (FINE if k < FEW else EASE):
            break
    _stop(limit.pulled, limit.force, state)


@stage(touch, MeshStrainLimit)
@jit
def limit_edges(limit, state, substep):
    """Put edges that are too long back, until none is."""
    first, last, count = limit.slots[0], limit.slots[1], len(limit.force)
    i, j = limit.particles[0], limit.particles[1]
    to_records(state, limit.records, first, last)
    step, before = 0.0, np.inf
    for k in range(PASSES):
        if k > 0:
            share = max(step - 1.0, 0.0) / (step + 2.0)
            _go_on(limit.records, limit.before, 4 * first, 4 * last, share)
            _go_on(limit.force, limit.force_before, 0, count, share)
        most = _put_back(limit.records, i, j, limit.longest, limit.force, False)
        if most <= (FINE if k < FEW else EASE):
            break
        if k == 0:
            _go_on(limit.records, limit.before, 4 * first, 4 * last, 0.0)
            _go_on(limit.force, limit.force_before, 0, count, 0.0)
        _put_back(limit.records, i, j, limit.longest, limit.force, True)
        step = 0.0 if most > GROWTH * before else step + 1.0
        before = most
    to_positions(state, limit.records, first, last)
    _stop(limit.pulled, limit.force, state)


@jit
def _stop(pulled, force, state):
    """Let what is held back end the substep with backward Euler."""
    for c in range(len(pulled.index)):
        if force[pulled.index[c]] < 0.0:
            lose_history(state.history, pulled.particles[0, c])
            lose_history(state.history, pulled.particles[1, c])


@jit
def _go_on(numbers, before, first, last, share):
    """Go on by a share of what numbers changed by since the last time."""
    for q in range(first, last, lanes(numbers)):
        now = load(numbers, q)
        if share > 0.0:    # no share of nan is 0
            store(numbers, q, fma(share, now - load(before, q), now))
        store(before, q, now)


@jit
def _put_back(records, i, j, longest, force, reverse):
    """Pass over all edges; return the largest excess over the limit that it found, relative."""
    count, step, most = len(longest), lanes(longest), splat(longest, 0.0)
    for p in range(0, count, step):
        q = count - step - p if reverse else p
        xi, yi, zi, mi = load_records(records, i, q)
        xj, yj, zj, mj = load_records(records, j, q)
        dx, dy, dz, total, longest_ = xi - xj, yi - yj, zi - zj, mi + mj, load(longest, q)
        l, f = root(fma(dx, dx, fma(dy, dy, dz * dz))), load(force, q)
        moves = both(l > 0.0, total > 0.0)
        over = select(moves, l - longest_, 0.0)
        most = larger(most, over / longest_)
        pulled = f - over / select(moves, total, 1.0)
        pulled = select(both(moves, pulled < 0.0), pulled, 0.0)
        g = (pulled - f) / select(moves, l, 1.0)
        gi, gj = g * mi, -g * mj
        store_records(records, i, q, fma(gi, dx, xi), fma(gi, dy, yi), fma(gi, dz, zi), mi)
        store_records(records, j, q, fma(gj, dx, xj), fma(gj, dy, yj), fma(gj, dz, zj), mj)
        store(force, q, pulled)
    return highest(most)


@stage(react, StrainLimit)
@stage(react, MeshStrainLimit)
@jit
def react_limit(limit, state, substep):
    """
    Force on pinned particles: f n.

    What f moved by m f ends the substep with backward Euler, so the force was m f / (w h²).
    """
    part, x, w = substep.end - substep.begin, state.x, state.inv_mass
    ends, index = limit.pulled.particles, limit.pulled.index
    for c in range(len(index)):
        i, j, f = ends[0, c], ends[1, c], limit.force[index[c]]
        if f != 0.0 and (w[i] == 0.0 or w[j] == 0.0):
            free = i if w[i] > 0.0 else j
            if state.mobility[free] > 0.0:    # else it lies between pins too far apart
                f *= state.mobility[free] / (w[free] * substep.h**2)
            dx, dy, dz = x[0, i] - x[0, j], x[1, i] - x[1, j], x[2, i] - x[2, j]
            f *= part / np.sqrt(dx * dx + dy * dy + dz * dz)
            for k, d in enumerate((dx, dy, dz)):
                state.reaction[k, i] += f * d
                state.reaction[k, j] -= f * d


def limited_edges(mesh) -> np.ndarray:
    """Return the edges along warp and weft of a grid, or all edges; shape (edges, 2)."""
    if mesh.grid is None:
        return mesh.edges
    grid = mesh.grid
    return np.concatenate([np.stack([grid[:, :-1], grid[:, 1:]], -1).reshape(-1, 2),
                           np.stack([grid[:-1], grid[1:]], -1).reshape(-1, 2)])


def _on_grids(cloths, world) -> StrainLimit:
    blocks = [cloth.block for cloth, _ in cloths]
    lines = grid_lines(
        blocks, [(1.0 + chosen.max) * np.array(cloth.mesh.spacing) for cloth, chosen in cloths],
        [(np.zeros(block.rows), np.zeros(block.columns)) for block in blocks],
        slots=world.slots, dtype=world.state.x.dtype)
    ends, index = [], []
    for g, block in enumerate(blocks):
        slots = block.slots
        for along, (a, b) in enumerate(((slots[:, :-1], slots[:, 1:]), (slots[:-1], slots[1:]))):
            ends.append(np.stack([a.ravel(), b.ravel()]))
            index.append(lines.force[g, along] + a.ravel())
    return StrainLimit(lines, zeros(2 * len(blocks) * world.slots, world.state.x.dtype),
                       Pulled(np.concatenate(ends, 1), np.concatenate(index)),
                       room_for(blocks) if world.pins else None)


def _on_meshes(cloths, world) -> MeshStrainLimit:
    ends = [cloth.slots[cloth.mesh.edges] for cloth, _ in cloths]
    particles, longest = np.concatenate(ends), np.concatenate([
        (1.0 + chosen.max) * length(cloth.mesh.positions[cloth.mesh.edges[:, 0]]
                                    - cloth.mesh.positions[cloth.mesh.edges[:, 1]])
        for cloth, chosen in cloths])
    order, dtype = pack(particles), world.state.x.dtype
    index = np.flatnonzero(order >= 0)
    return MeshStrainLimit(
        world.records, np.array([particles.min(initial=0), particles.max(initial=-1) + 1]),
        padded(particles, order, world.slots - 1, np.int32).T.copy(),
        padded(longest, order, 1.0, dtype), zeros(len(order), dtype),
        new_records(world.slots, dtype), zeros(len(order), dtype),
        Pulled(particles[order[index]].T.astype(np.int64), index))


class BuiltStrainLimit(Built):
    """The edges of every cloth that has a limit: of grids, and of other meshes."""

    not_with = ('ndf2',)    # it damps too little for what sets in and lets go at once
    ns_per_particle = 100.0

    def __init__(self, parameters, world):
        super().__init__()
        made = []
        for make, of_kind in ((_on_grids, True), (_on_meshes, False)):
            cloths = [(cloth, chosen) for cloth, chosen in parameters.items()
                      if (cloth.mesh.grid is not None) == of_kind]
            if cloths:
                made.append(make(cloths, world))
        self.data, *self.also = made
        self._edges = []
        for cloth, chosen in parameters.items():
            edges, x = limited_edges(cloth.mesh), cloth.mesh.positions
            self._edges.append((cloth.slots[edges].T, length(x[edges[:, 0]] - x[edges[:, 1]]),
                                chosen.max))
        self._state = world.state
        self._blocks = [cloth.block for cloth in parameters if cloth.mesh.grid is not None]

    def hold(self, inv_mass):
        if self._blocks:
            hold(self.data.taut, self._blocks, inv_mass)

    def least_substeps(self, frame_dt):
        return SUBSTEPS

    def stats(self):
        x, most = self._state.x, -np.inf
        for (i, j), rest, limit in self._edges:
            strain = length(places(x, i) - places(x, j)) / rest - 1.0
            most = max(most, float(strain.max(initial=-1.0)) - limit)
        return {'strain_over_limit': most}


EFFECT = Effect('strain_limit', Parameters, BuiltStrainLimit)
