"""
Inextensible lines: whole lines of unilateral edges (tension only), solved at once.

As in ``constraints.line_solver`` with α = 0, but an edge is active only if it is longer than its
limit or already in tension (f < 0), and f > 0 is set to 0: one step of an active set method per
line. An inactive edge decouples the two parts of its line. Warp and weft lines share particles, so
the caller repeats the solves until no edge is too long.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import (
    after,
    both,
    either,
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
from xpbd_ros.sim.backend.threads import alone, turns_of_few, wait, worker, workers
from xpbd_ros.sim.constraints.line_solver import gather_rows, scatter_rows
from xpbd_ros.sim.constraints.pinned_edges import gather_reaction, note
from xpbd_ros.sim.particles.history import weights_at


@jit
def tighten(lines, force, stops, excess, state, substep, near):
    """
    Solve every warp line, then every weft line; threads share the lines of each.

    Parameters
    ----------
    lines : their ``rest_length`` is the limit of each edge's length [m]
    force : multipliers f [N]
    stops : edges at pinned particles, or None; their forces are added to ``state.reaction``
    excess : scratch: the largest excess that each thread found, and of all; shape (threads + 1,)
    near : edges shorter than the limit by less than this fraction are active too, a first guess of
        the active set: without it the tension of a hanging line would grow by one edge per solve

    Returns
    -------
    largest relative excess found, on all threads

    """
    most, part = 0.0, substep.end - substep.begin
    for g in range(len(lines.first)):
        _note(stops, lines.force[g, 0], state, force)
        most = max(most, _warp(lines, g, force, state, near))
        _gather(stops, lines.force[g, 0], state, force, part)
        _note(stops, lines.force[g, 1], state, force)
        most = max(most, _weft(lines, g, force, state, near))
        _gather(stops, lines.force[g, 1], state, force, part)
    return _largest(state.team, excess, most)


@jit
def _largest(team, excess, most):
    """Return the largest of the threads' numbers, none negative, on all of them."""
    threads = min(workers(team), len(excess) - 1)
    if worker(team) < threads:    # others of a GPU have solved no line
        excess[worker(team)] = most
    wait(team)
    if alone(team):
        for k in range(threads):
            most = max(most, excess[k])
        excess[-1] = most
    wait(team)
    return excess[-1]


@jit(inline=True)
def per_euler(state, i, j):
    """
    Return (H / h)²: the force of an edge on a pinned particle over its f.

    f displaces the edge's free particle by w H² f. That particle ends the substep with backward
    Euler, v = (x - x_n) / h, as under a force f H² / h².
    """
    share = weights_at(state.history, i if state.inv_mass[i] > 0.0 else j)[0]
    return share * share


@jit
def _note(stops, base, state, force):
    """Record the edges at pinned particles of one family; its multipliers begin at ``base``."""
    if stops is not None:
        held, x = stops.held, state.x
        if alone(state.team):
            for k in range(held.count[0]):
                if base <= held.index[k] < base + x.shape[1]:
                    note(stops, k, k + 1, x[0], x[1], x[2], None, force)
                    share = per_euler(state, held.particles[k, 0], held.particles[k, 1])
                    for a in range(3):
                        stops.direction[k, a] *= share
        wait(state.team)


@jit
def _gather(stops, base, state, force, part):
    """Add the forces that these edges exerted since ``_note``; the others need not wait."""
    if stops is not None and alone(state.team):
        for k in range(stops.held.count[0]):
            if base <= stops.held.index[k] < base + state.x.shape[1]:
                gather_reaction(stops, k, k + 1, state.mobility, force, part, state.reaction)


@jit
def _warp(lines, g, force, state, near):
    x, y, z, m = state.x[0], state.x[1], state.x[2], state.mobility
    work, tile = lines.work[worker(state.team)], lines.tile[worker(state.team)]
    count, most = lanes(x), splat(x, 0.0)
    start, rows, columns = lines.first[g], lines.rows[g], lines.columns[g]
    part, stride, parts = lines.part[g], lines.stride[g], lines.parts[g]
    if columns > 1:
        tiles = max(1, rows // count)
        one, other, over = turns_of_few(state.team, tiles, len(lines.work))
        for begin in range(one * count, rows if other == tiles else other * count, over * count):
            row = max(0, min(begin, rows - count))    # the last tile overlaps the one before
            top, at = start + row * stride, lines.force[g, 0] + start + row * stride
            gather_rows(x, top, parts, part, stride, tile[0])
            gather_rows(y, top, parts, part, stride, tile[1])
            gather_rows(z, top, parts, part, stride, tile[2])
            gather_rows(m, top, parts, part, stride, tile[3])
            gather_rows(force, at, parts, part, stride, tile[4])
            most = larger(most, _solve(
                tile[0], tile[1], tile[2], tile[3], tile[4], 0, 0, count, columns, begin - row,
                lines.rest_length[g, 0], work, lines.tiny, near))
            scatter_rows(tile[0], x, top, parts, part, stride)
            scatter_rows(tile[1], y, top, parts, part, stride)
            scatter_rows(tile[2], z, top, parts, part, stride)
            scatter_rows(tile[4], force, at, parts, part, stride)
        wait(state.team)
    return highest(most)


@jit
def _weft(lines, g, force, state, near):
    x, y, z, m = state.x[0], state.x[1], state.x[2], state.mobility
    work, most = lines.work[worker(state.team)], splat(x, 0.0)
    count = lanes(x)
    if lines.rows[g] > 1:
        one, other, over = turns_of_few(state.team, lines.parts[g] * lines.part[g] // count,
                                        len(lines.work))
        for q in range(one * count, other * count, over * count):
            at = lines.first[g] + q
            most = larger(most, _solve(
                x, y, z, m, force, at, lines.force[g, 1] + at, lines.stride[g], lines.rows[g], 0,
                lines.rest_length[g, 1], work, lines.tiny, near))
        wait(state.team)
    return highest(most)


@jit
def _solve(x, y, z, m, force, start, edge, stride, nodes, done, longest, work, tiny, near):
    """
    Solve one line per lane, except in the first ``done`` lanes; return the excess of each lane.

    Particle k of the lines is at start + k stride, and the multiplier of the edge from k to k + 1
    at edge + k stride.
    """
    n = lanes(x)
    long, ratio, step = work[0], work[1], work[2]
    zero, there, most = splat(x, 0.0), after(x, done), splat(x, 0.0)
    xa, ya, za, ma = load(x, start), load(y, start), load(z, start), load(m, start)
    vx, vy, vz, pivot, right = zero, zero, zero, zero, zero
    for k in range(nodes - 1):
        i, c, o = start + (k + 1) * stride, edge + k * stride, k * n
        xb, yb, zb, mb = load(x, i), load(y, i), load(z, i), load(m, i)
        f, total = load(force, c), ma + mb
        dx, dy, dz = xb - xa, yb - ya, zb - za
        square = fma(dx, dx, fma(dy, dy, dz * dz))
        l = root(square)
        over = l - longest
        moves = both(both(l > 0.0, total > 0.0), there)
        most = larger(most, select(moves, over / longest, 0.0))
        off = -ma * fma(dx, vx, fma(dy, vy, dz * vz))
        link = off * pivot
        bottom = fma(-link, off, (total + tiny * total) * square)
        pulls = both(moves, both(either(over > -near * longest, f < 0.0), bottom > 0.0))
        pivot = 1.0 / select(pulls, bottom, 1.0)
        right = select(pulls, (-over * l - off * right) * pivot, 0.0)
        store(long, o, select(moves, l, 1.0))
        store(ratio, o, link)
        store(step, o, right)
        vx, vy, vz = select(pulls, dx, 0.0), select(pulls, dy, 0.0), select(pulls, dz, 0.0)
        xa, ya, za, ma = xb, yb, zb, mb
    # right is now s of the last edge; going back, s_k = right_k - (off_{k+1} pivot_k) s_{k+1}
    s, above, wx, wy, wz = zero, zero, zero, zero, zero
    for k in range(nodes - 2, -1, -1):
        i, c, o = start + (k + 1) * stride, edge + k * stride, k * n
        xb, yb, zb, mb = xa, ya, za, load(m, i)
        xa, ya, za = load(x, i - stride), load(y, i - stride), load(z, i - stride)
        l, f = load(long, o), load(force, c)
        s = load(step, o) - above * s
        pulled = fma(s, l, f)
        s = select(pulled < 0.0, s, -f / l)
        store(force, c, select(pulled < 0.0, pulled, 0.0))
        gx, gy, gz = s * (xb - xa), s * (yb - ya), s * (zb - za)
        store(x, i, fma(mb, gx - wx, xb))
        store(y, i, fma(mb, gy - wy, yb))
        store(z, i, fma(mb, gz - wz, zb))
        above = load(ratio, o)
        wx, wy, wz = gx, gy, gz
    mb = load(m, start)
    store(x, start, xa - mb * wx)
    store(y, start, ya - mb * wy)
    store(z, start, za - mb * wz)
    return most
