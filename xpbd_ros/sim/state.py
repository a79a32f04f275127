"""
Particle state, and the kernels that integrate it.

Both integrators read (NUMERICS 2.14; Macklin et al. 2016, algorithm 1 for backward Euler)

    x = x̄ + H v,   v = v̄ + H (g + forces / m),   then projections with mobilities w H²

    backward Euler   H = h       x̄ = x_n                      v̄ = v_n
    BDF2             H = 2h/3    x̄ = (4 x_n - x_{n-1}) / 3    v̄ = (4 v_n - v_{n-1}) / 3

and end with v = (x - x_n) / h or (3 x - 4 x_n + x_{n-1}) / (2 h). A particle without a history (at
the start, after a contact, a grasp, a release or a reset) takes a backward Euler step.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.layout import zeros
from xpbd_ros.sim.team import share, Team, wait
from xpbd_ros.sim.update import Explicit, inline, Jacobi
from xpbd_ros.sim.vector import both, lanes, load, select, splat, store


class History(NamedTuple):
    """What BDF2 remembers of the substep before."""

    x: np.ndarray
    """x_{n-1} [m], shape (3, slots)"""
    v: np.ndarray
    """v_{n-1} [m/s], shape (3, slots)"""
    fresh: np.ndarray
    """0: has a history; 1: has none, this substep; 2: touched in it; shape (slots,)"""


class State(NamedTuple):
    """All particles of a scene, by slot (``layout``)."""

    x: np.ndarray
    """positions [m], shape (3, slots)"""
    x_prev: np.ndarray
    """positions at the substep's start [m], shape (3, slots)"""
    v: np.ndarray
    """velocities [m/s], shape (3, slots)"""
    mass: np.ndarray
    """[kg], shape (slots,); constant; 0 in the padding"""
    inv_mass: np.ndarray
    """w [1/kg], shape (slots,); 0 while pinned, and in the padding"""
    mobility: np.ndarray
    """w H² of this substep [m/N], shape (slots,)"""
    gravity: np.ndarray
    """[m/s²], shape (3,)"""
    reaction: np.ndarray | None
    """constraint force on each pinned particle, mean over the frame [N], shape (3, slots);
    None in a scene without pins"""
    history: History | None
    """None with backward Euler"""
    apart: Jacobi | Explicit | None
    """where constraints add up their moves; None where each moves its particles at once"""
    team: Team | None = None
    """None where one thread does it all"""


class Substep(NamedTuple):
    """One substep: its length and its place in the frame."""

    h: float
    """[s]"""
    begin: float
    """fraction of the frame at its start, 0 … 1"""
    end: float
    """fraction of the frame at its end"""


def new_state(x: np.ndarray, mass: np.ndarray, gravity, slot: np.ndarray, slots: int, *,
              pins: bool = False, dtype=np.float64) -> State:
    """
    Return particles at rest.

    Parameters
    ----------
    x : positions [m], shape (particles, 3)
    mass : [kg], shape (particles,), > 0
    gravity : [m/s²], 3 numbers
    slot : where each particle goes, shape (particles,)
    slots : how many there are
    pins : whether forces on pinned particles will be asked for
    dtype : of all numbers

    """
    def vectors():
        return zeros((3, slots), dtype)

    def scalars():
        return zeros(slots, dtype)

    state = State(vectors(), vectors(), vectors(), scalars(), scalars(), scalars(),
                  np.array(gravity, dtype), vectors() if pins else None,
                  None, None)
    state.x[:, slot] = np.asarray(x).T
    state.x_prev[:] = state.x
    state.mass[slot] = mass
    state.inv_mass[slot] = 1.0 / state.mass[slot]
    return state


def solved_by(state: State, *, history: bool, apart: type | None, constraints) -> State:
    """
    Return the same particles, with what their solver needs besides.

    Parameters
    ----------
    state : of ``new_state``
    history : whether the integrator remembers a substep
    apart : Jacobi or Explicit, where moves are added up
    constraints : particles of all constraints, a list of (constraints, particles of one)

    """
    slots, dtype = state.x.shape[1], state.x.dtype

    def vectors():
        return zeros((3, slots), dtype)

    if history:
        state = state._replace(history=History(vectors(), vectors(), zeros(slots, dtype)))
        forget(state)
    if apart is not None:
        state = state._replace(apart=apart(
            vectors(), zeros((slots, 4), dtype),
            *([np.full(1, _most_constraints(constraints, state.mass > 0.0), dtype)]
              * (apart is Jacobi))))
    return state


def _most_constraints(constraints, there: np.ndarray) -> float:
    """
    Return the most constraints at a particle.

    With J M Jᵀ + α = A, x A x ≤ most · Σ x² diag(A), so Jacobi with ω = 1 / most never overshoots.
    """
    count = np.zeros(len(there))
    for particles in constraints:
        np.add.at(count, particles, 1.0)
    return count[there].max(initial=1.0)


def places(array: np.ndarray, slots=slice(None)) -> np.ndarray:
    """Return rows x, y, z of some slots, in float64; shape (slots, 3)."""
    return array[:, slots].T.astype(float)


def forget(state: State, particles=slice(None)) -> None:
    """Let particles start anew: their next substep is one of backward Euler."""
    if state.history is not None:
        state.history.fresh[particles] = 1.0


@jit
def lose_history(history, i):
    """Mark a particle as touched in this substep: it ends it with backward Euler."""
    if history is not None:
        history.fresh[i] = 2.0


@jit(inline=True)
def own(state):
    """Return the first of this thread's slots, and the one after its last."""
    count = lanes(state.inv_mass)
    first, last = share(state.team, len(state.inv_mass) // count)
    return first * count, last * count


@jit
def begin(state, substep):
    """x_prev = x_n;  v = v̄ + H g;  x = x̄ + H v;  mobility = w H²."""
    _begin(state, state.history, substep.h)
    wait(state.team)


@jit
def _begin(state, history, h):    # Numba prunes a branch on None where that is an argument
    if history is None:
        _begin_euler(state, h)
    else:
        _begin_bdf2(state, history, h)


@jit
def _begin_euler(state, h):
    x, v, w, slots = state.x, state.v, state.inv_mass, len(state.inv_mass)
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        wq = load(w, q)
        free = wq > 0.0
        store(state.mobility, q, wq * (h * h))
        for k in range(3):
            i = k * slots + q
            xi, vi = load(x, i), load(v, i)
            vi = select(free, vi + h * state.gravity[k], vi)
            store(state.x_prev, i, xi)
            store(v, i, vi)
            store(x, i, select(free, xi + h * vi, xi))


@jit
def _begin_bdf2(state, history, h):
    x, v, w, slots = state.x, state.v, state.inv_mass, len(state.inv_mass)
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        wq = load(w, q)
        free = wq > 0.0
        euler = load(history.fresh, q) > 0.5
        past = select(euler, splat(w, 0.0), splat(w, 1.0 / 3.0))
        step = select(euler, splat(w, h), splat(w, 2.0 / 3.0 * h))
        store(state.mobility, q, wq * (step * step))
        for k in range(3):
            i = k * slots + q
            xi, vi = load(x, i), load(v, i)
            x_mean = xi + past * (xi - load(history.x, i))
            v_mean = vi + past * (vi - load(history.v, i))
            moved = v_mean + step * state.gravity[k]
            store(state.x_prev, i, xi)
            store(history.v, i, vi)
            store(v, i, select(free, moved, vi))
            store(x, i, select(free, x_mean + step * moved, xi))


@jit
def step_of(history, w, q, h):
    """Return H of the particles from slot q on: a vector [s]."""
    if history is None:
        return splat(w, h)
    return select(load(history.fresh, q) > 0.5, splat(w, h), splat(w, 2.0 / 3.0 * h))


def velocity(v, now, start, step, plain):
    """
    Return v after a step of H that was predicted to end at start + H v and ends at ``now``.

    ``plain`` is what the formula of the integrator says, by differences of positions. It is the
    same but for rounding: the last bit of x, divided by H, is a large part of what gravity adds to
    v in a short step. So float32 goes on from the predicted v, which has all its bits.
    """


@inline(velocity)
def _velocity(v, now, start, step, plain):
    if v.lane.bitwidth < 64:
        return lambda v, now, start, step, plain: v + (now - (start + step * v)) / step
    return lambda v, now, start, step, plain: plain


@jit
def update_velocity(state, substep):
    """v = (x - x_n) / h or (3 x - 4 x_n + x_{n-1}) / (2 h); what was touched has no history."""
    _update_velocity(state, state.history, substep.h)
    wait(state.team)


@jit
def _update_velocity(state, history, h):
    if history is None:
        _update_euler(state, h)
    else:
        _update_bdf2(state, history, h)


@jit
def _update_euler(state, h):
    x, v, w, slots, per_h = state.x, state.v, state.inv_mass, len(state.inv_mass), 1.0 / h
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        free = load(w, q) > 0.0
        for k in range(3):
            i = k * slots + q
            xi, xp = load(x, i), load(state.x_prev, i)
            plain = (xi - xp) * per_h
            store(v, i, select(free, velocity(load(v, i), xi, xp, splat(w, h), plain), plain))


@jit
def _update_bdf2(state, history, h):
    v, w, slots, per_h = state.v, state.inv_mass, len(state.inv_mass), 1.0 / h
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        fresh, free = load(history.fresh, q), load(w, q) > 0.0
        as_predicted, smooth = both(free, fresh < 1.5), both(free, fresh < 0.5)
        part = select(smooth, splat(w, 0.5), splat(w, 0.0))
        past = select(smooth, splat(w, 1.0 / 3.0), splat(w, 0.0))
        step = select(smooth, splat(w, 2.0 / 3.0 * h), splat(w, h))
        store(history.fresh, q, select(fresh > 1.5, splat(w, 1.0), splat(w, 0.0)))
        for k in range(3):
            i = k * slots + q
            xi, xp = load(state.x, i), load(state.x_prev, i)
            now, before = xi - xp, xp - load(history.x, i)
            plain = (now + part * (now - before)) * per_h
            store(v, i, select(as_predicted, velocity(
                load(v, i), xi, xp + past * before, step, plain), plain))
            store(history.x, i, xp)


@jit
def at_start(state):
    """Return the state with the particles where the substep starts."""
    return State(state.x_prev, state.x_prev, state.v, state.mass, state.inv_mass, state.mobility,
                 state.gravity, state.reaction, state.history, state.apart, state.team)


@jit
def set_mobility(state, h):
    """Mobility = w h²."""
    first, last = own(state)
    for q in range(first, last, lanes(state.inv_mass)):
        store(state.mobility, q, load(state.inv_mass, q) * (h * h))


@jit
def clear_moves(state):
    """Begin to sum up moves."""
    move, slots = state.apart.move, len(state.inv_mass)
    first, last = own(state)
    for k in range(3):
        for i in range(k * slots + first, k * slots + last, lanes(move)):
            store(move, i, 0.0)
    wait(state.team)


@jit
def add_moves(state):
    """x += the moves that the constraints summed up."""
    x, move, slots = state.x, state.apart.move, len(state.inv_mass)
    first, last = own(state)
    for k in range(3):
        for i in range(k * slots + first, k * slots + last, lanes(x)):
            store(x, i, load(x, i) + load(move, i))
    wait(state.team)


@jit(inline=True)
def stay(state, i, h):
    """Have a particle keep its velocity in ``half_kick``."""
    for k in range(3):
        state.apart.move[k, i] = -h * h * state.gravity[k]


@jit
def half_kick(state, h, share):
    """v += share h a, with the moves h² F / m that were summed up; pinned particles keep v."""
    v, w, move, slots = state.v, state.inv_mass, state.apart.move, len(state.inv_mass)
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        free = load(w, q) > 0.0
        for k in range(3):
            i = k * slots + q
            vi = load(v, i)
            change = share / h * load(move, i) + share * h * state.gravity[k]
            store(v, i, select(free, vi + change, vi))
    wait(state.team)
