"""
Inextensible edges of meshes: accelerated Gauss-Seidel passes over unilateral constraints.

An edge longer than its limit is projected onto it, with f ≤ 0 (tension only). A net that hangs by
a corner would take thousands of passes, so each pair of a forward and a backward pass starts from
an extrapolation of the last two (Nesterov 1983),

    x + β (x - x_before),   f + β (f - f_before),   β = (k - 1) / (k + 2),

with k restarted when the largest excess has grown (O'Donoghue and Candès 2015). Grids solve whole
lines instead (``constraints.inextensible_lines``).
"""

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    both,
    fma,
    highest,
    lanes,
    larger,
    load,
    select,
    splat,
    store,
)
from xpbd_ros.sim.backend.simd_records import load_records, store_records
from xpbd_ros.sim.backend.simd_vector3 import lane_of, length, vector3
from xpbd_ros.sim.constraints.inextensible_lines import per_euler
from xpbd_ros.sim.constraints.pinned import listed_between, listed_range
from xpbd_ros.sim.particles.records import to_positions, to_records

EASE = 3e-3
"""tolerance: relative excess over the limit at which passes end"""
FINE, FEW = 1e-5, 8
"""tolerance of the first FEW pairs of passes: a remaining excess makes forces oscillate"""
GROWTH = 1.2
"""growth of the largest excess at which k restarts"""


@jit
def shorten(limit, state, substep, passes):
    """
    Project the edges of meshes until none is too long; return the initial largest excess.

    Parameters
    ----------
    limit : ``MeshStrainLimit`` of the effect ``strain_limit``
    passes : largest number of pairs of passes

    Returns
    -------
    largest (|x1 - x2| - longest) / longest found by the first pass

    """
    first, last, count = limit.slots[0], limit.slots[1], len(limit.force)
    to_records(state, limit.records, first, last)
    clear_reactions(limit.pull)
    step, before, found = 0.0, np.inf, 0.0
    for k in range(passes):
        if k > 0:
            share = max(step - 1.0, 0.0) / (step + 2.0)
            _extrapolate(limit.records, limit.before, 4 * first, 4 * last, share)
            _extrapolate(limit.force, limit.force_before, 0, count, share)
            extrapolate_reactions(limit.pull, limit.pull_before, share)
        most = _sweep(limit, state, False)
        if k == 0:
            found = most
        if most <= (FINE if k < FEW else EASE):
            break
        if k == 0:
            _extrapolate(limit.records, limit.before, 4 * first, 4 * last, 0.0)
            _extrapolate(limit.force, limit.force_before, 0, count, 0.0)
            extrapolate_reactions(limit.pull, limit.pull_before, 0.0)
        _sweep(limit, state, True)
        step = 0.0 if most > GROWTH * before else step + 1.0
        before = most
    to_positions(state, limit.records, first, last)
    add_reactions(limit.pull, substep.end - substep.begin, state.reaction)
    return found


@jit
def _sweep(limit, state, reverse):
    """Project all edges once; return the largest relative excess over the limit found."""
    records, particles, longest, force = (limit.records, limit.particles, limit.longest,
                                          limit.force)
    step, most = lanes(longest), splat(longest, 0.0)
    next_, past = listed_range(limit.held)
    for p in range(0, len(longest), step):
        q = len(longest) - step - p if reverse else p
        xi, yi, zi, mi = load_records(records, particles[0], q)
        xj, yj, zj, mj = load_records(records, particles[1], q)
        d, total = vector3(xi - xj, yi - yj, zi - zj), mi + mj
        limit_, l, f = load(longest, q), length(d), load(force, q)
        moves = both(l > 0.0, total > 0.0)
        over = select(moves, l - limit_, 0.0)
        most = larger(most, over / limit_)
        pulled = f - over / select(moves, total, 1.0)
        pulled = select(both(moves, pulled < 0.0), pulled, 0.0)
        g = (pulled - f) / select(moves, l, 1.0)
        gi, gj = g * mi, -g * mj
        store_records(records, particles[0], q, fma(gi, d.x, xi), fma(gi, d.y, yi),
                      fma(gi, d.z, zi), mi)
        store_records(records, particles[1], q, fma(gj, d.x, xj), fma(gj, d.y, yj),
                      fma(gj, d.z, zj), mj)
        store(force, q, pulled)
        if next_ < past:
            stop, on = listed_between(limit.held, next_, past, q, q + step, reverse)
            _pull(limit.held, stop, on, q, g * d, state, limit.pull)
            next_, past = (next_, stop) if reverse else (on, past)
    return highest(most)


@jit
def _pull(held, first, last, start, impulse, state, pull):
    """Add the forces of the listed edges first:last on pinned particles (see ``per_euler``)."""
    if held is not None:
        for k in range(first, last):
            i, j, lane = held.particles[k, 0], held.particles[k, 1], held.index[k] - start
            share = per_euler(state, i, j)
            for a, each in enumerate((impulse.x, impulse.y, impulse.z)):
                change = share * lane_of(each, lane)
                pull[a, i] += change
                pull[a, j] -= change


@jit
def clear_reactions(pull):
    """Zero the forces on pinned particles of one call of ``shorten`` [N], shape (3, slots)."""
    if pull is not None:
        pull[:] = 0.0


@jit
def extrapolate_reactions(pull, before, share):
    """Extrapolate the forces on pinned particles as the multipliers that exert them."""
    if pull is not None:
        for a in range(3):
            _extrapolate(pull[a], before[a], 0, pull.shape[1], share)


@jit
def add_reactions(pull, part, reaction):
    """Add the forces of one call of ``shorten`` to the mean over the frame."""
    if pull is not None:
        for a in range(3):
            for i in range(pull.shape[1]):
                reaction[a, i] += part * pull[a, i]


@jit
def _extrapolate(numbers, before, first, last, share):
    """
    Extrapolate: numbers += share (numbers - before), for indices first:last.

    ``before`` receives the values before extrapolation.
    """
    for q in range(first, last, lanes(numbers)):
        now = load(numbers, q)
        if share > 0.0:    # 0 · nan would be nan
            store(numbers, q, fma(share, now - load(before, q), now))
        store(before, q, now)
