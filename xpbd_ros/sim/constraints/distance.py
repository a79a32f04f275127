"""
Distance constraints: C = |x1 - x2| - L, for every effect with elastic edges.

Gradient: n = (x1 - x2) / |x1 - x2| at x1, -n at x2 (Müller et al. 2006, eq 10-11). In force form,
with f = λ / H² [N], mobilities m = w H² and W = m1 + m2,

    Δf = -(C + α f) / (W + α),   x1 += m1 n Δf,   x2 -= m2 n Δf

which is Macklin et al. 2016, eq 18 and 17, times H². α is in m/N; 0 is rigid. f < 0 is tension.
Where two particles coincide the gradient is undefined: they separate along a fixed axis, one for
each shape of edge, which conserves momentum and is deterministic.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, first, fma, lane_count, lanes, load, root, select
from xpbd_ros.sim.backend.simd_records import load_records
from xpbd_ros.sim.backend.threads import wait
from xpbd_ros.sim.constraints.damping import (
    apart_before,
    Damping,
    gamma_of,
    gammas_of,
    lag,
    records_before,
    shared,
)
from xpbd_ros.sim.constraints.grid_batches import first_of_runs, listed, PHASES, Runs, share_of
from xpbd_ros.sim.constraints.mesh_batches import pack, padded
from xpbd_ros.sim.constraints.pinned import (
    collect,
    hold,
    hold_packs,
    Packs,
    packs_for,
    segment,
    segment_count,
)
from xpbd_ros.sim.constraints.pinned_edges import (
    gather_reaction,
    note,
    note_packs,
    room,
    Stops,
    stops_for,
)
from xpbd_ros.sim.constraints.projection import (
    denominator,
    keep,
    moves,
    put,
    recall,
    row,
    xpbd_residual,
)
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.records import from_records, put_records, to_records

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
ABSENT = -1.0
"""compliance where there is no edge"""


class GridEdges(NamedTuple):
    """Elastic edges of grids, in runs (``constraints.grid_batches``)."""

    runs: Runs
    rest_length: np.ndarray
    """[m], of each shape of edge, shape (shapes,)"""
    compliance: np.ndarray
    """[m/N], by shape of edge and place in a row, ABSENT where there is no edge; shape
    (shapes, places)"""
    axis: np.ndarray
    """direction of coincident particles, of each shape of edge, shape (shapes, 3)"""
    force: np.ndarray | None
    """f, multiplier over H² [N], negative in tension, shape (families * slots,); None if
    multipliers are not kept"""
    stops: Stops | None
    """None in a scene without pins"""
    damping: Damping | None = None
    """None in a scene without ``rayleigh``"""


class MeshEdges(NamedTuple):
    """Elastic edges of meshes, in packs (``constraints.mesh_batches``)."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots of both ends, shape (2, edges)"""
    rest_length: np.ndarray
    """[m], shape (edges,)"""
    compliance: np.ndarray
    """[m/N], shape (edges,)"""
    force: np.ndarray | None
    """f [N], shape (edges,); None if multipliers are not kept"""
    packs: Packs | None
    """edges at pinned particles; None in a scene without pins"""
    damping: Damping | None = None
    """None in a scene without ``rayleigh``"""


class Edges:
    """
    Edges as NumPy arrays, in sweep order: the reference definition of C, energy and stiffness.

    Parameters
    ----------
    particles : slots of both ends, shape (edges, 2)
    index : position of each edge's multiplier in ``force``, shape (edges,)
    rest_length : [m], shape (edges,)
    compliance : [m/N], shape (edges,)

    """

    def __init__(self, particles, index, rest_length, compliance):
        self.particles = particles
        self.index = index
        self.rest_length = rest_length.astype(float)
        self.compliance = compliance.astype(float)

    @staticmethod
    def of(batch: 'GridEdges | MeshEdges') -> 'Edges':
        """Return the edges of a batch."""
        if isinstance(batch, MeshEdges):
            index = np.flatnonzero(batch.particles[0] != batch.particles[1])
            return Edges(batch.particles[:, index].T.astype(np.int64), index,
                         batch.rest_length[index], batch.compliance[index])
        particles, index, shape, place = listed(batch.runs)
        return Edges(particles, index, batch.rest_length[shape], batch.compliance[shape, place])

    @staticmethod
    def joined(lists: list['Edges']) -> 'Edges':
        """Return the edges of several batches; ``index`` refers to each one's own batch."""
        return Edges(*(np.concatenate([getattr(edges, name) for edges in lists]) for name in (
            'particles', 'index', 'rest_length', 'compliance')))

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C [m], shape (edges,), by its definition; x: positions [m], (3, slots)."""
        i, j = self.particles.T
        return length((x[:, i] - x[:, j]).T.astype(float)) - self.rest_length

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """
        Return 2 Σ 1 / α at each particle, an upper bound of the stiffness K [N/m], (slots, 3, 3).

        The bound holds for any direction of the edges: warp and weft of a sheet that hangs from
        its corners can become parallel.
        """
        found = np.zeros(x.shape[1])
        with np.errstate(divide='ignore'):
            stiffness = 2.0 / self.compliance
        np.add.at(found, self.particles[:, 0], stiffness)
        np.add.at(found, self.particles[:, 1], stiffness)
        return found[:, None, None] * np.eye(3)

    def energy(self, x: np.ndarray) -> float:
        """Return Σ C² / (2 α) [J]; a rigid edge stores none."""
        elastic = self.compliance > 0.0
        return float((0.5 * self.residual(x)[elastic]**2 / self.compliance[elastic]).sum())


def max_compliance(dtype) -> float:
    """Return the largest compliance [m/N]: finite, so that its product with a zero f is 0."""
    return float(np.sqrt(np.finfo(dtype).max))


def by_place(runs: Runs, compliance: list, dtype) -> np.ndarray:
    """
    Return the compliances of grids as one table, ABSENT where there is no constraint.

    Parameters
    ----------
    runs : runs of all grids
    compliance : of each grid, by its shapes and places in a row, (shapes, places) or (shapes, 1)
    dtype : of the table

    Returns
    -------
    shape (shapes, places), padded by a vector

    """
    table = zeros((len(runs.present), runs.present.shape[1] + lane_count(dtype)), dtype)
    table[:] = ABSENT
    first_ = 0
    for each in compliance:
        each = np.minimum(each, max_compliance(dtype))
        there = np.s_[first_:first_ + len(each), :runs.present.shape[1]]
        width = each.shape[1] if each.shape[1] > 1 else runs.present.shape[1]
        table[there][:, :width] = each
        first_ += len(each)
    table[:, :runs.present.shape[1]][~runs.present] = ABSENT
    return table


def grid_edges(runs: Runs, family, rest_length, compliance: list, *, world,
               time=None) -> GridEdges:
    """
    Return the edges of grids for the kernels.

    Parameters
    ----------
    runs : runs of all grids
    family : of each shape of edge, shape (shapes,)
    rest_length : of each shape of edge [m], shape (shapes,)
    compliance : of each grid, by its shapes and places in a row [m/N], (shapes, places) or (…, 1)
    world : build context
    time : relaxation time of each shape [s], shape (shapes,); None without ``rayleigh``

    """
    dtype, family = world.state.x.dtype, np.asarray(family)
    force = zeros((family.max(initial=0) + 1) * world.slots, dtype) if world.forces else None
    table = by_place(runs, compliance, dtype)
    return GridEdges(runs, np.array(rest_length, dtype), table,
                     np.array([AXES[k % 3] for k in family], dtype).reshape(-1, 3), force,
                     stops_for(runs) if world.pins else None,
                     damping(world, time, (table == 0.0).any(1), dtype))


def mesh_edges(particles: np.ndarray, rest_length: np.ndarray, compliance: np.ndarray, *,
               world, time=None) -> MeshEdges:
    """
    Return the edges of meshes for the kernels.

    Parameters
    ----------
    particles : slots, shape (edges, 2)
    rest_length : [m], shape (edges,)
    compliance : [m/N], shape (edges,)
    world : build context
    time : relaxation time [s], shape (edges,); None without ``rayleigh``

    """
    dtype = world.state.x.dtype
    order = pack(particles)
    count = len(order)
    return MeshEdges(
        world.records, np.array([particles.min(initial=0), particles.max(initial=-1) + 1]),
        padded(particles, order, world.slots - 1, np.int32).T.copy(),
        padded(rest_length, order, 0.0, dtype),
        padded(np.minimum(compliance, max_compliance(dtype)), order, max_compliance(dtype), dtype),
        zeros(count, dtype) if world.forces else None,
        packs_for(room(count)) if world.pins else None,
        None if time is None else damping(world, padded(time, order, 0.0, dtype),
                                          padded(compliance, order, 1.0, dtype) == 0.0, dtype))


def damping(world, time, rigid: np.ndarray, dtype) -> Damping | None:
    """
    Return the damping of constraints with relaxation times [s]; None if there are none.

    Constraints where ``rigid`` is True are not damped.
    """
    if time is None:
        return None
    return Damping(world.built['rayleigh'].past, np.where(rigid, 0.0, time).astype(dtype))


def times(found: list) -> np.ndarray | None:
    """Return relaxation times [s] as an array; None if any of them is None."""
    return None if None in found else np.array(found)


def relaxation(world, cloth) -> float | None:
    """Return the relaxation time of a cloth [s]; None in a scene without ``rayleigh``."""
    return world.built['rayleigh'].time(cloth) if 'rayleigh' in world.built else None


def hold_edges(edges: 'GridEdges | MeshEdges', listed_: Edges, inv_mass: np.ndarray) -> None:
    """
    Update the lists of edges at pinned particles.

    Parameters
    ----------
    edges, listed_ : a batch and the same edges as arrays
    inv_mass : 0 where pinned, shape (slots,)

    """
    if isinstance(edges, MeshEdges):
        assert edges.packs is not None
        hold_packs(edges.packs, listed_, inv_mass, edges.particles.shape[1])
    else:
        assert edges.stops is not None
        found = hold(edges.stops.held, listed_, inv_mass)
        edges.stops.first[:] = np.searchsorted(found, first_of_runs(edges.runs))


@jit(inline=True)
def pull(apart, dx, dy, dz, total, rest, alpha, f, there, ux, uy, uz, gamma, before):
    """
    Return s, d and Δf of a vector of edges, where d = x1 - x2 and n Δf = -s d.

    The form needs one division, s = (C + α f) / (|d| (W + α)).

    Parameters
    ----------
    apart : accumulator of the method or None
    dx, dy, dz : x1 - x2 [m]
    total : W [m/N]
    rest, alpha, f : L [m], α [m/N] and f [N] (None: 0)
    there : lanes that hold an edge
    ux, uy, uz : direction of coincident particles
    gamma, before : γ and x̄1 - x̄2 of damping (``constraints.damping``), or None

    """
    l = root(fma(dx, dx, fma(dy, dy, dz * dz)))
    apart_ = l > 0.0
    l_or_1 = select(apart_, l, 1.0)
    wrong = lag(xpbd_residual(l - rest, alpha, f), gamma, before, dx, dy, dz, l_or_1)
    s = select(both(total > 0.0, there),
               wrong / (l_or_1 * denominator(apart, shared(total, gamma), alpha)), 0.0)
    return (s, select(apart_, dx, ux), select(apart_, dy, uy), select(apart_, dz, uz),
            -(s * l_or_1))


@jit(inline=True)
def stops_of(stops, run):
    """Return the range (first, last + 1) of a run's edges at pinned particles."""
    if stops is None:
        return 0, 0
    else:
        return stops.first[run], stops.first[run + 1]


@jit
def stops_between(stops, first, last, begin, end, reverse):
    """
    Return the part of the range first:last whose multipliers are in force[begin:end].

    A sweep calls it vector by vector: the part begins at ``first``, or ends at ``last`` if
    ``reverse``.
    """
    if stops is None:
        return 0, 0
    else:
        index = stops.held.index
        if reverse:
            k = last
            while k > first and index[k - 1] >= begin:
                k -= 1
            return k, last
        k = first
        while k < last and index[k] < end:
            k += 1
        return first, k


@jit
def project_edges(edges, state, substep, reverse):
    """Project all edges of grids once, run by run, in reverse order if ``reverse``."""
    part = substep.end - substep.begin
    for phase in range(PHASES):
        begin, end = share_of(edges.runs, state.team, phase, reverse)
        _project(state.x[0], state.x[1], state.x[2], state.mobility, state.apart,
                 row(moves(state.apart), 0), row(moves(state.apart), 1),
                 row(moves(state.apart), 2), edges.runs, edges.rest_length, edges.compliance,
                 edges.force, edges.axis, edges.damping, edges.stops, part, state.reaction, begin,
                 end, reverse)
        wait(state.team)


@jit
def _project(x, y, z, mobility, apart, tx, ty, tz, runs, rest_length, compliance, force, axis,
             damping, stops, part, reaction, begin, end, reverse):
    places = compliance.shape[1]
    for a in range(end - begin):
        r = end - 1 - a if reverse else begin + a
        shape = runs.shape[r]
        to_i, to_j, base = runs.offset[r, 0], runs.offset[r, 1], runs.base[r]
        ux, uy, uz = axis[shape, 0], axis[shape, 1], axis[shape, 2]
        gamma = gamma_of(damping, shape)
        rest, numbers = rest_length[shape], shape * places + runs.place[r]
        next_, past = stops_of(stops, r)
        for b in range(runs.rows[r]):
            row = runs.rows[r] - 1 - b if reverse else b
            anchor = runs.start[r] + row * runs.stride[r]
            last = (runs.count[r] - 1) // lanes(x) * lanes(x)
            for p in range(0, runs.count[r], lanes(x)):
                q = last - p if reverse else p
                i, j, c = anchor + to_i + q, anchor + to_j + q, base + anchor + q
                xi, yi, zi, mi = load(x, i), load(y, i), load(z, i), load(mobility, i)
                xj, yj, zj, mj = load(x, j), load(y, j), load(z, j), load(mobility, j)
                stop, on = next_, next_
                if next_ < past:
                    stop, on = stops_between(stops, next_, past, c, c + lanes(x), reverse)
                    note(stops, stop, on, x, y, z, apart, force)
                alpha, f = load(compliance, numbers + q), recall(apart, force, c)
                there = both(alpha >= 0.0, first(x, runs.count[r] - q))
                s, dx, dy, dz, df = pull(apart, xi - xj, yi - yj, zi - zj, mi + mj, rest, alpha,
                                         f, there, ux, uy, uz, gamma,
                                         apart_before(damping, i, j))
                keep(force, c, f, df)
                gi, gj = -(s * mi), s * mj
                put(x, tx, i, xi, gi, dx)
                put(y, ty, i, yi, gi, dy)
                put(z, tz, i, zi, gi, dz)
                put(x, tx, j, xj, gj, dx)
                put(y, ty, j, yj, gj, dy)
                put(z, tz, j, zj, gj, dz)
                if stop < on:
                    gather_reaction(stops, stop, on, mobility, force, part, reaction)
                    next_, past = (next_, stop) if reverse else (on, past)


@jit
def project_packs(edges, state, substep, reverse):
    """Project all edges of meshes once, pack by pack, in reverse order if ``reverse``."""
    first_, last = edges.slots[0], edges.slots[1]
    to_records(state, edges.records, first_, last)
    for number in range(segment_count(edges.packs)):
        begin, end, a, b = segment(edges.packs, number, len(edges.rest_length), reverse)
        note_packs(edges.packs, a, b, edges.records, state.apart, edges.force)
        _project_packs(edges.records, state.apart, edges.particles[0],
                       edges.particles[1], edges.rest_length, edges.compliance, edges.force,
                       edges.damping, begin, end, reverse)
        collect(edges.packs, a, b, edges.force, substep.end - substep.begin, state.reaction)
    from_records(state, edges.records, first_, last)


@jit
def _project_packs(records, apart, i, j, rest_length, compliance, force, damping, begin, end,
                   reverse):
    step = lanes(rest_length)
    for p in range(begin, end, step):
        q = begin + end - step - p if reverse else p
        xi, yi, zi, mi = load_records(records, i, q)
        xj, yj, zj, mj = load_records(records, j, q)
        alpha, f = load(compliance, q), recall(apart, force, q)
        s, dx, dy, dz, df = pull(apart, xi - xj, yi - yj, zi - zj, mi + mj,
                                 load(rest_length, q), alpha, f, alpha >= 0.0, 1.0, 0.0, 0.0,
                                 gammas_of(damping, q), records_before(damping, i, j, q))
        keep(force, q, f, df)
        gi, gj = -(s * mi), s * mj
        put_records(records, apart, i, q, xi, yi, zi, mi, gi, dx, dy, dz)
        put_records(records, apart, j, q, xj, yj, zj, mj, gj, dx, dy, dz)


