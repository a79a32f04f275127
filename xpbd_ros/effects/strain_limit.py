"""
Strain limit: an upper bound on the strain of edges.

C = |x1 - x2| - L (1 + max) ≤ 0, gradient n = (x1 - x2) / |x1 - x2| at x1 and -n at x2, α = 0, and
a force f ≤ 0 that only pulls (Provot 1995; doc/numerics.md 7.3):

    Δf = min(-C / (m1 + m2), -f),   x1 += m1 n Δf,   x2 -= m2 n Δf

with mobilities m = w H². The sought positions are the feasible ones nearest to those that the
elastic forces left, in the metric of the masses. On a grid whole lines are solved at once
(``constraints.inextensible_lines``), warp and weft in turn, until no edge exceeds its limit by
more than EASE. Edges of other meshes take accelerated passes (``constraints.inextensible_edges``).
One pass suffices where no edge is too long. The limit comes last in each iteration, after all
elastic constraints and before seams, contact and friction. Where these pull an edge beyond the
limit again, they and the limit are repeated in turn until they agree. The edges are those along
warp and weft of a grid, and all edges of any other mesh.

Limits: it dissipates energy, as an inelastic stop does. Its particles take steps of backward
Euler, since a history would make them rebound. Where pins and colliders leave the cloth no room,
edges stay longer: ``strain_over_limit`` is the largest excess. Shear of a grid's cells is not
limited.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import (
    alone,
    alone_on_device,
    turns,
    turns_on_device,
    wait,
    wait_on_device,
)
from xpbd_ros.sim.constraints import overextended_lines
from xpbd_ros.sim.constraints.inextensible_edges import EASE, FEW, FINE, shorten
from xpbd_ros.sim.constraints.inextensible_lines import tighten
from xpbd_ros.sim.constraints.line_solver import grid_lines, Lines
from xpbd_ros.sim.constraints.mesh_batches import pack, padded
from xpbd_ros.sim.constraints.pinned import hold
from xpbd_ros.sim.constraints.pinned_edges import EdgeStops, Held, react_edges, room
from xpbd_ros.sim.constraints.projection import zero_multipliers
from xpbd_ros.sim.effect import Built, by_kind, Effect, is_grid
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.history import invalidate_history
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.records import new_records
from xpbd_ros.sim.particles.state import places
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    are_inequalities_unmet,
    limit_motion,
    prepare,
    project_inequalities,
    stage,
)

NEAR = 3e-3
"""in a first pass edges of a line pull from this much below the limit on, relative"""
PASSES, PASSES_AGAIN = 200, 20
"""most passes over all lines, or pairs of passes over the edges of meshes, in an iteration; and in
each repetition"""
AGREED = 6e-3
"""largest excess over the limit after seams, contact and friction, relative"""
TURNS = 400
"""most repetitions in an iteration"""
PATIENCE = 20
"""repetitions in which the largest excess must halve; otherwise they end"""
PER_LOAD, MOST = 2.0, 6.0
"""time with a load (``BuiltStrainLimit._load``) of 1, over that without; largest load"""
SUBSTEPS = 8
"""least substeps with ``auto``: with fewer, passes cost more than substeps"""


@dataclass(frozen=True)
class Parameters:
    """The limit."""

    max: float = quantity(0.1, minimum=0.0, live=True,
                          doc='largest strain; 0.1 is ten per cent')


class Pulled(NamedTuple):
    """The edges one by one."""

    particles: np.ndarray
    """slots of both ends, shape (edges, 2)"""
    index: np.ndarray
    """index of each one's force, shape (edges,)"""
    longest: np.ndarray
    """L (1 + max) [m], shape (edges,)"""


class StrainLimit(NamedTuple):
    """Data of the kernels: grids."""

    lines: Lines
    """with their largest lengths"""
    force: np.ndarray
    """f [N], negative in tension, shape (2 grids * slots,)"""
    excess: np.ndarray
    """scratch of ``tighten``, shape (threads + 1,)"""
    pulled: Pulled
    """warp edges of the first grid, its weft edges, those of the next grid"""
    families: np.ndarray
    """first of each of these, and the number of edges; shape (2 grids + 1,)"""
    taut: overextended_lines.Taut | None
    """None in a scene without pins"""
    stops: EdgeStops | None
    """edges at pinned particles; None in a scene without pins"""
    trend: np.ndarray | None
    """repetitions in this iteration, the largest excess PATIENCE repetitions ago (relative), and 1
    where it has not halved; shape (3,); None in a scene without seams, contact and
    self_collision"""


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
    held: Held | None
    """edges at pinned particles; None in a scene without pins"""
    pull: np.ndarray | None
    """impulse on each pinned particle in this repetition, over h [N], shape (3, slots)"""
    pull_before: np.ndarray | None
    """the same after the last pair of passes"""
    trend: np.ndarray | None
    """as in ``StrainLimit``"""


@stage(prepare, StrainLimit, on_device=True)
@jit
def prepare_limit(limit, state, substep):
    """Zero the forces, except of overextended lines."""
    zero_multipliers(None, limit.force, state.team)
    wait_on_device(state.team)
    if alone_on_device(state.team):
        overextended_lines.straighten(limit.taut, limit.lines, limit.force, state)


@stage(prepare, MeshStrainLimit)
@jit
def prepare_edges(limit, state, substep):
    """Zero the forces."""
    zero_multipliers(None, limit.force, None)


@stage(project_inequalities, StrainLimit, shared=True)
@jit
def limit_lines(limit, state, substep):
    """Shorten lines until no edge is too long."""
    found = 0.0
    for k in range(most_passes(limit.trend)):
        most = tighten(limit.lines, limit.force, limit.stops, limit.excess, state, substep,
                       NEAR if k == 0 else 0.0)
        if k == 0:
            found = most
        if most <= (FINE if k < FEW else EASE):
            break
    if alone(state.team):
        note_turn(limit.trend, found)
    _stop_lines(limit, state)
    wait(state.team)


@stage(project_inequalities, MeshStrainLimit)
@jit
def limit_edges(limit, state, substep):
    """Shorten edges until none is too long."""
    found = shorten(limit, state, substep, most_passes(limit.trend))
    note_turn(limit.trend, found)
    for c in range(len(limit.pulled.index)):
        for end in range(2):
            _stop(limit.pulled, limit.force, state.history, c, end)


@jit(inline=True)
def most_passes(trend):
    """Return the most passes of this repetition."""
    if trend is None:
        return PASSES
    else:    # Numba prunes the branch that is not taken
        return PASSES if trend[0] == 0.0 else PASSES_AGAIN


@jit
def note_turn(trend, found):
    """Note the largest excess of a repetition; stop them where it does not halve in time."""
    if trend is not None:
        if trend[0] % PATIENCE == 1.0:
            trend[2] = trend[0] > 1.0 and found > 0.5 * trend[1]
            trend[1] = found
        trend[0] += 1.0


@stage(limit_motion, StrainLimit)
@stage(limit_motion, MeshStrainLimit)
@jit
def end_turns(limit, state, substep):
    """Prepare the next iteration."""
    forget_turns(limit.trend)


@jit
def forget_turns(trend):
    """Start counting repetitions again."""
    if trend is not None:
        trend[:] = 0.0


@stage(are_inequalities_unmet, StrainLimit)
@stage(are_inequalities_unmet, MeshStrainLimit)
@jit
def is_unmet(limit, state, turn):
    """Tell whether later effects have pulled an edge beyond its limit, and may be repeated."""
    particles, longest = limit.pulled.particles, limit.pulled.longest
    if may_turn(limit.trend, turn):
        x, w = state.x, state.inv_mass
        begin, end, step = turns_on_device(state.team, len(longest))
        for c in range(begin, end, step):
            a, b, most = particles[c, 0], particles[c, 1], (1.0 + AGREED) * longest[c]
            square = (x[0, a] - x[0, b])**2 + (x[1, a] - x[1, b])**2 + (x[2, a] - x[2, b])**2
            if square > most**2 and w[a] + w[b] > 0.0:
                return True
    return False


@jit(inline=True)
def may_turn(trend, turn):
    """Tell whether another repetition is allowed."""
    if trend is None:
        return False
    else:    # Numba prunes the branch that is not taken
        return turn <= TURNS and trend[2] == 0.0


@jit(inline=True)
def _stop(pulled, force, history, c, end):
    """Let one end of edge c, if that is taut, end the substep with backward Euler."""
    if force[pulled.index[c]] < 0.0:
        invalidate_history(history, pulled.particles[c, end])


@jit
def _stop_lines(limit, state):
    """Do so for all edges of lines; a particle is once at each end of those of a family."""
    if state.history is not None:
        for f in range(len(limit.families) - 1):
            first, last = limit.families[f], limit.families[f + 1]
            begin, past, turn = turns(state.team, last - first)
            for end in range(2):
                for c in range(first + begin, first + past, turn):
                    _stop(limit.pulled, limit.force, state.history, c, end)
                wait(state.team)


@stage(accumulate_reactions, StrainLimit)
@jit
def react_limit(limit, state, substep):
    """Add the forces of lines between pins too far apart; the others have been added."""
    react_edges(limit.stops.held, limit.force, state, substep)


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
        slots=world.slots, dtype=world.state.x.dtype, threads=world.threads)
    ends, index, longest = [], [], []
    for g, (block, (cloth, chosen))  in enumerate(zip(blocks, cloths)):
        slots = block.slots
        for along, (a, b) in enumerate(((slots[:, :-1], slots[:, 1:]), (slots[:-1], slots[1:]))):
            ends.append(np.stack([a.ravel(), b.ravel()], 1))
            index.append(lines.force[g, along] + a.ravel())
            longest.append(np.full(a.size, (1.0 + chosen.max) * cloth.mesh.spacing[along]))
    return StrainLimit(lines, zeros(2 * len(blocks) * world.slots, world.state.x.dtype),
                       np.zeros(world.threads + 1),
                       Pulled(np.concatenate(ends), *map(np.concatenate, (index, longest))),
                       np.cumsum([0, *map(len, index)]),
                       overextended_lines.room_for(blocks) if world.pins else None,
                       stops_of(sum(map(len, index))) if world.pins else None, None)


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
        Pulled(particles[order[index]].astype(np.int64), index, longest[order[index]]),
        room(len(order)) if world.pins else None,
        zeros((3, world.slots), dtype) if world.pins else None,
        zeros((3, world.slots), dtype) if world.pins else None, None)


def stops_of(count: int) -> EdgeStops:
    """Return room for so many edges at pinned particles."""
    return EdgeStops(room(count), np.zeros(0, np.int64), np.zeros((count, 3)), np.zeros(count))


class BuiltStrainLimit(Built):
    """The edges of all cloths with this effect, of grids and of other meshes."""

    incompatible_with = ('ndf2',)    # it damps too little for limits that engage abruptly
    ns_per_particle = 11.0
    explicit_velocity_lags = True

    def __init__(self, parameters, world):
        super().__init__()
        self.data, *self.also = [make(cloths, world) for make, cloths in zip(
            (_on_grids, _on_meshes), by_kind(parameters, is_grid)) if cloths]
        self._edges = []
        for cloth, chosen in parameters.items():
            edges, x = limited_edges(cloth.mesh), cloth.mesh.positions
            self._edges.append((cloth.slots[edges].T, length(x[edges[:, 0]] - x[edges[:, 1]]),
                                chosen.max))
        self._state = world.state
        if 'strain_limit' in world.before:
            self.pinned = world.before['strain_limit'].pinned
        else:
            self.pinned = np.zeros(world.slots, bool)
            """True for particles that the scene's pins hold at its start, shape (slots,)"""
            if 'pin' in world.built:
                self.pinned[world.built['pin'].particles_at(world.state.x)] = True
        self._blocks = [cloth.block for cloth in parameters if is_grid(cloth.mesh)]

    def hold(self, inv_mass):
        if self._blocks:
            overextended_lines.hold(self.data.taut, self._blocks, inv_mass)
        for part in self.parts:
            lists = part.stops if isinstance(part, StrainLimit) else part
            assert lists is not None
            hold(lists.held, part.pulled, inv_mass)

    def take_turns(self) -> None:
        """Enable repetitions, because effects that follow may pull edges beyond the limit."""
        self.data, *self.also = (part._replace(trend=np.zeros(3)) for part in self.parts)

    def particles_worth(self, effects, state, substeps):
        return np.count_nonzero(state.mass) * (1.0 + PER_LOAD * self._load(effects, state))

    def _load(self, effects, state) -> float:
        """Return the weight over the force of edges at pins at their limit, at most MOST."""
        limit, limited = np.zeros(len(state.mass)), np.zeros(len(state.mass), bool)
        for ends, _, most in self._edges:
            limit[ends], limited[ends] = most, True
        weight = np.linalg.norm(state.gravity) * state.mass[limited].sum()
        if weight == 0.0 or not (limited & self.pinned).any():
            return 0.0
        bears = 0.0
        if 'stretch' in effects:
            edges = effects['stretch'].constraints
            one, other = edges.particles.T
            at = limited[one] & (self.pinned[one] != self.pinned[other])
            with np.errstate(all='ignore'):    # rigid edges bear all
                bears = np.where(edges.compliance > 0.0, limit[one] * edges.rest_length
                                 / edges.compliance, np.inf)[at].sum()
        return min(weight / bears, MOST) if bears else MOST

    def least_substeps(self, frame_dt):
        return SUBSTEPS

    def stats(self):
        x, most = self._state.x, -np.inf
        for (i, j), rest, limit in self._edges:
            strain = length(places(x, i) - places(x, j)) / rest - 1.0
            most = max(most, float(strain.max(initial=-1.0)) - limit)
        return {'strain_over_limit': most}


EFFECT = Effect('strain_limit', Parameters, BuiltStrainLimit)
