"""
Time integration: backward Euler, BDF2 and NDF2 in one form.

All integrators read (doc/numerics.md 2.1; Macklin et al. 2016, algorithm 1 for backward Euler)

    x = x̄ + H v,   v = v̄ + H (g + forces / m),   then projections with mobilities w H²

and end with v = (x - x̄) / H. Backward Euler has H = h, x̄ = x_n, v̄ = v_n; ``particles.history``
has the formulas of the others. A particle without a history (at the start, after a contact, a
grasp, a release or a reset) takes a backward Euler step.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import lanes, load, select, store
from xpbd_ros.sim.backend.threads import turns, turns_on_device, wait
from xpbd_ros.sim.particles.accumulators import moves
from xpbd_ros.sim.particles.history import (
    age,
    earlier_positions,
    end_age,
    mean,
    restore_history,
    rotate_history,
    velocities,
    weights,
    with_order_reduction,
)
from xpbd_ros.sim.particles.rounding import clear, with_errors
from xpbd_ros.sim.particles.state import State


@jit(inline=True)
def own(state):
    """Return the first slot that this thread updates, the end, and the step to its next vector."""
    count = lanes(state.inv_mass)
    first, last, step = turns(state.team, len(state.inv_mass) // count)
    return first * count, last * count, step * count


@jit(inline=True)
def turned(state):
    """
    Return the state of the next substep with its buffers rotated: x becomes x_prev, and so on.

    The oldest arrays are reused for the new values; nothing is copied.
    """
    x, x_prev, v, history = rotate_history(state.history, state.x, state.x_prev, state.v)
    return State(x, x_prev, v, state.mass, state.inv_mass, state.mobility, state.gravity,
                 state.reaction, history, state.apart, state.team, state.gap, state.rounding,
                 state.clock)


@jit
def begin(state, substep):
    """v = v̄ + H g;  x = x̄ + H v;  mobility = w H²; after ``turned``."""
    first, last, step = own(state)
    for q in range(first, last, step):
        _begin(state, state.history, q, substep.h)
    wait(state.team)


@jit
def predict(state, substep):
    """
    x = x̄ + H v, after forces changed v; x = x_n + h v where they invalidated the history.

    In a short substep a force moves x by less than its last bit. A displacement added to x would
    be lost to rounding, and the change of v with it, since v is recomputed from x at the end.
    """
    first, last, step = own(state)
    for q in range(first, last, step):
        _predict(state, state.history, q, substep.h)
    wait(state.team)


@jit
def update_velocity(state, substep):
    """v = (x - x̄) / H; v = (x - x_n) / h for pinned and touched particles."""
    first, last, step = own(state)
    for q in range(first, last, step):
        _update_velocity(state, state.history, q, substep.h)
    wait(state.team)


@jit
def update_velocity_and_begin(state, substep):
    """Apply ``update_velocity``, ``turned`` and ``begin`` in one pass over memory."""
    after = turned(state)
    first, last, step = own(state)
    for q in range(first, last, step):
        _update_velocity(state, state.history, q, substep.h)
        _begin(after, after.history, q, substep.h)
    wait(state.team)


@jit(inline=True)
def load_rows(x, q):
    """Return the vectors of x, y and z at slot q; before any is stored: a GPU waits once."""
    slots = x.shape[1]
    return load(x, q), load(x, slots + q), load(x, 2 * slots + q)


@jit(inline=True)
def store_rows(x, q, values):
    """Store vectors of x, y and z at slot q."""
    slots = x.shape[1]
    store(x, q, values[0])
    store(x, slots + q, values[1])
    store(x, 2 * slots + q, values[2])


@jit(inline=True)
def mean_rows(values, past, slots, q, a, b):
    """Return ``history.mean`` of vectors of x, y and z at slot q."""
    return (mean(values[0], past, q, a, b), mean(values[1], past, slots + q, a, b),
            mean(values[2], past, 2 * slots + q, a, b))


@jit(inline=True)
def _begin(state, history, q, h):
    slots = len(state.inv_mass)
    w = load(state.inv_mass, q)
    free = w > 0.0
    past, (v, past_v) = earlier_positions(history), velocities(history, state.v)
    fresh = with_order_reduction(history, v, past_v, state.gap, q, h)
    step, a, b = weights(past, state.inv_mass, fresh, h)
    x0, y0, z0 = load_rows(state.x_prev, q)
    x, y, z = mean_rows((x0, y0, z0), past, slots, q, a, b)
    vx, vy, vz = load_rows(v, q)
    ux, uy, uz = mean_rows((vx, vy, vz), past_v, slots, q, a, b)
    g = state.gravity
    ux, uy, uz = ux + step * g[0], uy + step * g[1], uz + step * g[2]
    store(state.mobility, q, w * (step * step))
    store_rows(state.v, q, (select(free, ux, vx), select(free, uy, vy), select(free, uz, vz)))
    store_rows(state.x, q, (select(free, x + step * ux, x0), select(free, y + step * uy, y0),
                            select(free, z + step * uz, z0)))
    for k in range(3):
        clear(moves(state.rounding), k * slots + q)


@jit(inline=True)
def _predict(state, history, q, h):
    free, slots = load(state.inv_mass, q) > 0.0, len(state.inv_mass)
    past = earlier_positions(history)
    step, a, b = weights(past, state.inv_mass, age(history, q), h)
    for k in range(3):
        i = k * slots + q
        start = mean(load(state.x_prev, i), past, i, a, b)
        store(state.x, i, select(free, start + step * load(state.v, i), load(state.x, i)))


@jit(inline=True)
def velocity(v, now, start, step, per_step, errors, i):
    """
    Return v + (now - (start + H v)) / H: the velocity after a step of H from ``start`` to ``now``.

    It is (now - start) / H up to rounding. The rounding error of x divided by H is a considerable
    part of the velocity that gravity adds in a short step, and accumulates, in float32 or far from
    the origin. A correction of the predicted v keeps the bits of v. ``per_step`` is 1 / H;
    ``errors`` are those of ``particles.rounding`` at i.
    """
    return v + with_errors(now - (start + step * v), errors, i) * per_step


@jit(inline=True)
def _update_velocity(state, history, q, h):
    v, slots = state.v, len(state.inv_mass)
    past = earlier_positions(history)
    as_predicted, fresh = end_age(history, state.inv_mass, q)
    step, a, b = weights(past, state.inv_mass, fresh, h)
    per_step, errors = 1.0 / step, moves(state.rounding)
    x, y, z = load_rows(state.x, q)
    x0, y0, z0 = mean_rows(load_rows(state.x_prev, q), past, slots, q, a, b)
    vx, vy, vz = load_rows(v, q)
    ux = velocity(vx, x, x0, step, per_step, errors, q)
    uy = velocity(vy, y, y0, step, per_step, errors, slots + q)
    uz = velocity(vz, z, z0, step, per_step, errors, 2 * slots + q)
    store_rows(v, q, (select(as_predicted, ux, (x - x0) * per_step),
                      select(as_predicted, uy, (y - y0) * per_step),
                      select(as_predicted, uz, (z - z0) * per_step)))


@jit
def write_starts(state, target, h):
    """Write x̄ of all particles to ``target`` [m], shape (3, slots)."""
    count = lanes(state.inv_mass)
    first, last, step = turns_on_device(state.team, len(state.inv_mass) // count)
    for n in range(first, last, step):
        _write_start(state, state.history, target, n * count, h)


@jit(inline=True)
def _write_start(state, history, target, q, h):
    past = earlier_positions(history)
    _, a, b = weights(past, state.inv_mass, age(history, q), h)
    for k in range(3):
        i = k * len(state.inv_mass) + q
        store(target, i, mean(load(state.x_prev, i), past, i, a, b))


@jit
def restore_buffers(home, state):
    """Copy a frame's final state into the arrays of ``home``, which ``turned`` has exchanged."""
    slots = len(state.inv_mass)
    first, last, step = own(state)
    for q in range(first, last, step):
        for k in range(3):
            _restore_buffers(home, home.history, state, state.history, k * slots + q)
    wait(state.team)


@jit(inline=True)
def _restore_buffers(home, home_history, state, history, i):
    x, x_prev = load(state.x, i), load(state.x_prev, i)
    if history is not None:
        restore_history(home_history, home.v, history, history.older_v, state.v, i)
    store(home.x, i, x)
    store(home.x_prev, i, x_prev)


@jit
def set_mobility(state, h):
    """Mobility = w h²."""
    first, last, step = own(state)
    for q in range(first, last, step):
        store(state.mobility, q, load(state.inv_mass, q) * (h * h))
    wait(state.team)
