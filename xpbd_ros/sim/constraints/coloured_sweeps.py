"""Sweeps in the coloured order (``constraints.coloured_batches``): colour after colour."""

from numba import types

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import any_lane, both, first, lanes, load
from xpbd_ros.sim.backend.threads import cells, first_cell, turns, wait, wait_within
from xpbd_ros.sim.constraints.coloured_batches import ColouredRuns
from xpbd_ros.sim.constraints.pinned import listed_range, listed_range_of
from xpbd_ros.sim.constraints.projection import zero_multipliers_at
from xpbd_ros.sim.constraints.sweeps import (
    constants_of,
    held_of,
    offsets_of,
    project_pack,
    project_run,
)
from xpbd_ros.sim.particles.accumulators import moves, record_moves, row
from xpbd_ros.sim.particles.records import shared_from_records, shared_to_records


def is_coloured(batch) -> bool:
    """Return True if a batch, given as Numba types it, is in the coloured order."""
    if 'runs' in batch.fields:
        return batch[batch.fields.index('runs')].instance_class is ColouredRuns
    return not isinstance(batch[batch.fields.index('colours')], types.NoneType)


def sweep_coloured_runs(batch, state, substep, reverse, fresh, share):
    """
    Project all constraints of grids once, the last colour first if ``reverse``.

    With ``fresh``, each multiplier becomes 0 before. ``share`` is that of W with which multipliers
    are solved for; None: all of it.
    """
    part, runs, held = substep.end - substep.begin, batch.runs, held_of(batch)
    mobility = state.mobility
    places, step = batch.compliance.shape[1], lanes(mobility)
    x = state.x[0], state.x[1], state.x[2]
    to = row(moves(state.apart), 0), row(moves(state.apart), 1), row(moves(state.apart), 2)
    errors = (row(moves(state.rounding), 0), row(moves(state.rounding), 1),
              row(moves(state.rounding), 2))
    colours = len(runs.colour) - 1
    for k in range(colours):
        colour = colours - 1 - k if reverse else k
        before = first_cell(state.team)
        for r in range(runs.colour[colour], runs.colour[colour + 1]):
            shape, offsets = runs.shape[r], offsets_of(batch, r)
            constants = constants_of(batch, shape)
            number, base, count = shape * places + runs.place[r], runs.base[r], runs.count[r]
            pinned, past = listed_range_of(batch.stops, r)
            columns = (count + step - 1) // step
            b, p, bottom, down, over = cells(state.team, runs.rows[r], columns, before)
            while b < bottom:
                anchor, q = runs.start[r] + b * runs.stride[r], p * step
                there = first(mobility, count - q)
                if any_lane(both(there, load(batch.compliance, number + q) >= 0.0)):
                    c, stop, on = base + anchor + q, pinned, pinned
                    if pinned < past:
                        stop = first_listed(held, pinned, past, c)
                        on = first_listed(held, stop, past, c + step)
                    if fresh:
                        zero_multipliers_at(state.apart, batch.force, c)
                    project_run(batch, state.apart, x, to, errors, mobility, anchor + q, offsets,
                                c, number + q, shape, there, constants, held, stop, on, part,
                                state.reaction, share)
                b, p = b + down, p + over
                if p >= columns:
                    b, p = b + 1, p - columns
            before = (b - bottom) * columns + p
            wait_within(state.team)
        wait(state.team)


def sweep_coloured_packs(batch, state, substep, reverse, fresh, share):
    """
    Project all constraints of meshes once, the last colour first if ``reverse``.

    With ``fresh``, each multiplier becomes 0 before. ``share`` is that of W with which multipliers
    are solved for; None: all of it.
    """
    part, records, held = substep.end - substep.begin, batch.records, held_of(batch)
    begin, end = batch.slots[0], batch.slots[1]
    shared_to_records(state, records, begin, end)
    step, errors, padding = lanes(records), record_moves(state.rounding), len(records) - 1
    pinned, past = listed_range(held)
    colours = len(batch.colours) - 1
    for k in range(colours):
        colour = colours - 1 - k if reverse else k
        first_, last = batch.colours[colour], batch.colours[colour + 1]
        left, right, over = turns(state.team, (last - first_) // step)
        for p in range(left, right, over):
            q = first_ + p * step
            if batch.particles[0, q] != padding:    # packs fill up from their first place
                stop, on = pinned, pinned
                if pinned < past:
                    stop = first_listed(held, pinned, past, q)
                    on = first_listed(held, stop, past, q + step)
                if fresh:
                    zero_multipliers_at(state.apart, batch.force, q)
                project_pack(batch, state.apart, errors, q, held, stop, on, part, state.reaction,
                             share)
        wait(state.team)
    shared_from_records(state, records, begin, end)


@jit
def first_listed(held, begin, end, c):
    """Return the first position of begin:end in a list whose multiplier is at c or after."""
    if held is None:
        return begin
    index = held.index
    while begin < end:
        middle = (begin + end) // 2
        if index[middle] < c:
            begin = middle + 1
        else:
            end = middle
    return begin
