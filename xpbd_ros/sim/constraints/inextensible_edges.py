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
    root,
    select,
    splat,
    store,
)
from xpbd_ros.sim.backend.simd_records import load_records, store_records
from xpbd_ros.sim.constraints.inextensible_lines import per_euler
from xpbd_ros.sim.constraints.pinned import collect, segment, segment_count
from xpbd_ros.sim.constraints.pinned_edges import note_packs
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
    most, packs = 0.0, limit.packs
    for number in range(segment_count(packs)):
        begin, end, a, b = segment(packs, number, len(limit.longest), reverse)
        note_packs(packs, a, b, limit.records, None, limit.force)
        scale_gradients(packs, a, b, state)
        most = max(most, _project_edges(
            limit.records, limit.particles[0], limit.particles[1], limit.longest, limit.force,
            begin, end, reverse))
        collect(packs, a, b, limit.force, 1.0, limit.pull)
    return most


@jit
def scale_gradients(packs, first, last, state):
    """Scale the recorded gradients of a pack to forces (see ``per_euler``)."""
    if packs is not None:
        for k in range(first, last):
            i, j = packs.held.particles[k, 0], packs.held.particles[k, 1]
            share = per_euler(state, i, j)
            for p in range(2):
                for a in range(3):
                    packs.gradient[k - first, 0, p, a] *= share


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


@jit
def _project_edges(records, i, j, longest, force, begin, end, reverse):
    """Project the edges begin:end; return the largest relative excess over the limit found."""
    step, most = lanes(longest), splat(longest, 0.0)
    for p in range(begin, end, step):
        q = begin + end - step - p if reverse else p
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
