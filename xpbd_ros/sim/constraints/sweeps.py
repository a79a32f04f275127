"""
Sweeps: one pass over a batch of constraints, forth or back, for constraints of any kind.

A kind of constraint is a kernel for one vector of them, registered for the type of its batch:

    @projection(Area, particles=3)
    @jit(inline=True)
    def solve_area(area, apart, c, x, m):

It gets the positions x_i and mobilities m_i of the particles, keeps the multipliers, and returns
for each particle a pair (s_i, g_i), whose product is the impulse ∇C_i Δf. The sweep applies it,

    x_i += (m_i s_i) g_i,

and adds the impulses on pinned particles to ``state.reaction``. On meshes c is the index of the
first constraint (``sweep_packs``), on grids an ``At`` (``sweep_runs``).
"""

from collections.abc import Callable
import operator
from typing import Any, NamedTuple

from numba import types

from xpbd_ros.sim.backend.emit import written_out
from xpbd_ros.sim.backend.jit import inline
from xpbd_ros.sim.backend.simd import first, lanes, load
from xpbd_ros.sim.backend.simd_records import load_records
from xpbd_ros.sim.backend.simd_vector3 import AXES, vector3
from xpbd_ros.sim.backend.threads import wait
from xpbd_ros.sim.constraints.grid_batches import PHASES, share_of
from xpbd_ros.sim.constraints.pinned import (
    add_reactions,
    listed_between,
    listed_range,
    listed_range_of,
)
from xpbd_ros.sim.constraints.projection import zero_multipliers_at
from xpbd_ros.sim.particles.accumulators import moves, record_moves, row
from xpbd_ros.sim.particles.records import from_records, to_records
from xpbd_ros.sim.particles.rounding import store_moved, store_moved_records


class Projection(NamedTuple):
    """The projection kernel of one constraint type."""

    kernel: Callable
    """function that projects a vector of constraints"""
    particles: int
    """number of particles of a constraint"""
    constants: Callable | None
    """function of a grid batch and a shape index: returns the values that a run's constraints
    share; None if there are none"""


class At(NamedTuple):
    """A vector of constraints of a run, and what the run shares."""

    c: int
    """index of the first multiplier"""
    number: int
    """index of the first entry in the table of compliances"""
    shape: int
    """index of the run's shape"""
    there: Any
    """mask of the lanes within the run"""
    slots: tuple
    """first slot of each particle"""
    constants: Any
    """of the run's shape, as registered"""


_PROJECTIONS: dict[type, Projection] = {}


def projection(kind: type, *, particles: int, constants: Callable | None = None) -> Callable:
    """Register the kernel for a vector of constraints of one type."""
    def register(kernel):
        _PROJECTIONS[kind] = Projection(kernel, particles, constants)
        return kernel
    return register


def batch_of(data):
    """Return the batch of an effect's data: its ``edges``, or itself."""


@inline(batch_of)
def _batch_of(data):
    if 'edges' in data.fields:
        return lambda data: data.edges
    return lambda data: data


def batch_type(data):
    """Return the type of ``batch_of``, from the type of the data."""
    return data[data.fields.index('edges')] if 'edges' in data.fields else data


def held_of(batch):
    """Return the list of a batch's constraints at pinned particles."""


@inline(held_of)
def _held_of(batch):
    if 'stops' not in batch.fields:
        return lambda batch: batch.held
    none = isinstance(batch[batch.fields.index('stops')], types.NoneType)
    return (lambda batch: None) if none else (lambda batch: batch.stops.held)


def sweep_packs(batch, state, substep, reverse, fresh, share):
    """
    Project all constraints of meshes once, pack by pack, in reverse order if ``reverse``.

    With ``fresh``, each multiplier becomes 0 before: it is in the cache then. ``share`` is that of
    W with which multipliers are solved for; None: all of it.
    """
    part, records, held = substep.end - substep.begin, batch.records, held_of(batch)
    begin, end = batch.slots[0], batch.slots[1]
    to_records(state, records, begin, end)
    count, step, errors = (batch.particles.shape[1], lanes(records),
                           record_moves(state.rounding))
    next_, past = listed_range(held)
    for p in range(0, count, step):
        q = count - step - p if reverse else p
        stop, on = next_, next_
        if next_ < past:
            stop, on = listed_between(held, next_, past, q, q + step, reverse)
        if fresh:
            zero_multipliers_at(state.apart, batch.force, q)
        project_pack(batch, state.apart, errors, q, held, stop, on, part, state.reaction,
                     share)
        if stop < on:
            next_, past = (next_, stop) if reverse else (on, past)
    from_records(state, records, begin, end)


def sweep_runs(batch, state, substep, reverse, fresh, share):
    """
    Project all constraints of grids once, run by run, in reverse order if ``reverse``.

    With ``fresh``, each multiplier becomes 0 before: it is in the cache then. ``share`` is that of
    W with which multipliers are solved for; None: all of it.
    """
    part, runs, held = substep.end - substep.begin, batch.runs, held_of(batch)
    mobility = state.mobility
    places, step = batch.compliance.shape[1], lanes(mobility)
    x = state.x[0], state.x[1], state.x[2]
    to = row(moves(state.apart), 0), row(moves(state.apart), 1), row(moves(state.apart), 2)
    errors = (row(moves(state.rounding), 0), row(moves(state.rounding), 1),
              row(moves(state.rounding), 2))
    for phase in range(PHASES):
        begin, end = share_of(runs, state.team, phase, reverse)
        for a in range(end - begin):
            r = end - 1 - a if reverse else begin + a
            shape, offsets = runs.shape[r], offsets_of(batch, r)
            constants = constants_of(batch, shape)
            number, base = shape * places + runs.place[r], runs.base[r]
            last = (runs.count[r] - 1) // step * step
            next_, past = listed_range_of(batch.stops, r)
            for b in range(runs.rows[r]):
                anchor = runs.start[r] + (runs.rows[r] - 1 - b if reverse else b) * runs.stride[r]
                for p in range(0, runs.count[r], step):
                    q = last - p if reverse else p
                    c, stop, on = base + anchor + q, next_, next_
                    if next_ < past:
                        stop, on = listed_between(held, next_, past, c, c + step, reverse)
                    if fresh:    # past the end of a run is padding
                        zero_multipliers_at(state.apart, batch.force, c)
                    project_run(batch, state.apart, x, to, errors, mobility, anchor + q, offsets,
                                c, number + q, shape, first(mobility, runs.count[r] - q),
                                constants, held, stop, on, part, state.reaction, share)
                    if stop < on:
                        next_, past = (next_, stop) if reverse else (on, past)
        wait(state.team)


def offsets_of(batch, run):
    """Return the slot of each particle of a run's constraints, relative to the anchor."""


def constants_of(batch, shape):
    """Return what the constraints of a shape share, as registered."""


@inline(offsets_of)
def _offsets_of(batch, run):
    return {2: lambda batch, run: (batch.runs.offset[run, 0], batch.runs.offset[run, 1]),
            3: lambda batch, run: (batch.runs.offset[run, 0], batch.runs.offset[run, 1],
                                   batch.runs.offset[run, 2]),
            4: lambda batch, run: (batch.runs.offset[run, 0], batch.runs.offset[run, 1],
                                   batch.runs.offset[run, 2], batch.runs.offset[run, 3])}[
        _PROJECTIONS[batch.instance_class].particles]


@inline(constants_of)
def _constants_of(batch, shape):
    kernel = _PROJECTIONS[batch.instance_class].constants
    if kernel is None:
        return lambda batch, shape: None
    return lambda batch, shape: kernel(batch, shape)


def project_pack(batch, apart, errors, q, held, stop, on, part, reaction, share):
    """
    Project the constraints of a pack from index q on, as many as a vector has lanes.

    Those listed from ``stop`` to ``on`` act on pinned particles.
    """


def project_run(batch, apart, x, to, errors, mobility, anchor, offsets, c, number, shape, there,
                constants, held, stop, on, part, reaction, share):
    """
    Project the constraints of a run from an anchor on, as many as a vector has lanes.

    Parameters
    ----------
    batch, apart : the constraints, and the accumulator of the method or None
    x, to, errors : rows of the positions, and of the accumulator and of rounding errors or None
    mobility : shape (slots,)
    anchor, offsets : slot of the first anchor, and of the particles relative to it
    c, number, shape, there, constants : as in ``At``
    held, stop, on : the list of constraints at pinned particles, and the range of those among them
    part, reaction : as in ``add_reactions``
    share : as in ``sweep_runs``

    """


@written_out(project_pack)
def _project_pack(writer, batch, apart, errors, q, held, stop, on, part, reaction, share):
    kernel, width, _ = _PROJECTIONS[batch[0].instance_class]
    records, particles = writer.item(batch, 'records'), writer.item(batch, 'particles')
    index = [writer.call(operator.getitem, particles, writer.integer(k)) for k in range(width)]
    x, m = [], []
    for each in index:
        loaded = writer.call(load_records, records, each, q)
        x.append(writer.call(vector3, *(writer.item(loaded, k) for k in range(3))))
        m.append(writer.item(loaded, 3))
    found = writer.call(kernel, batch, apart, q, writer.tuple(x), _shared_out(writer, share, m))
    changes = [[writer.item(writer.item(found, k), n) for n in range(2)] for k in range(width)]
    target = records if isinstance(apart[0], types.NoneType) else writer.item(apart, 'records')
    for (scale, way), each, xk, mk in zip(changes, index, x, m):
        rest = mk
        if target is not records:
            loaded = writer.call(load_records, target, each, q)
            xk = writer.call(vector3, *(writer.item(loaded, n) for n in range(3)))
            rest = writer.item(loaded, 3)
        writer.call(store_moved_records, target, errors, each, q, xk,
                    writer.call(operator.mul, mk, scale), way, rest)
    _react(writer, held, changes, q, stop, on, part, reaction)


@written_out(project_run)
def _project_run(writer, batch, apart, x, to, errors, mobility, anchor, offsets, c, number, shape,
                 there, constants, held, stop, on, part, reaction, share):
    kernel, width, _ = _PROJECTIONS[batch[0].instance_class]
    rows, targets, left = ([writer.item(each, k) for k in range(3)] for each in (x, to, errors))
    slots = [writer.call(operator.add, anchor, writer.item(offsets, k)) for k in range(width)]
    m = [writer.call(load, mobility, slot) for slot in slots]
    places = [writer.call(vector3, *(writer.call(load, each, slot) for each in rows))
              for slot in slots]
    at = writer.named(At, c, number, shape, there, writer.tuple(slots), constants)
    found = writer.call(kernel, batch, apart, at, writer.tuple(places),
                        _shared_out(writer, share, m))
    changes = [[writer.item(writer.item(found, k), n) for n in range(2)] for k in range(width)]
    for (scale, way), slot, xk, mk in zip(changes, slots, places, m):
        if not isinstance(apart[0], types.NoneType):
            rows, xk = targets, writer.call(
                vector3, *(writer.call(load, each, slot) for each in targets))
        step = writer.call(operator.mul, mk, scale)
        for each, lost, now, along in zip(rows, left, _components(writer, xk),
                                          _components(writer, way)):
            writer.call(store_moved, each, lost, slot, now, step, along)
    _react(writer, held, changes, c, stop, on, part, reaction)


def _shared_out(writer, share, m):
    """Return a tuple of the shares of mobilities."""
    if isinstance(share[0], types.NoneType):
        return writer.tuple(m)
    return writer.tuple([writer.call(operator.mul, each, share) for each in m])


def _components(writer, value):
    """Return x, y and z of a Vector3."""
    kind, found = value
    return [(kind.vector, writer.builder.extract_value(found, k)) for k in range(len(AXES))]


def _react(writer, held, changes, start, stop, on, part, reaction):
    """Write out the impulses on pinned particles, for the constraints of a vector at ``start``."""
    if isinstance(held[0], types.NoneType):
        return
    particles, index = writer.item(held, 'particles'), writer.item(held, 'index')
    with writer.only_if(writer.call(operator.lt, stop, on)):
        for k, (scale, way) in enumerate(changes):
            writer.call(add_reactions, particles, index, writer.integer(k), stop, on, start, part,
                        writer.call(operator.mul, way, scale), reaction)
