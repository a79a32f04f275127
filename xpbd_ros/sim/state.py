"""
Particle state, and the kernels that integrate it.

All integrators read (NUMERICS 2.14; Macklin et al. 2016, algorithm 1 for backward Euler)

    x = x̄ + H v,   v = v̄ + H (g + forces / m),   then projections with mobilities w H²

and end with v = (x - x̄) / H. Backward Euler has H = h, x̄ = x_n, v̄ = v_n; ``multistep`` has the
others. A particle without a history (at the start, after a contact, a grasp, a release or a reset)
takes a backward Euler step.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.layout import zeros
from xpbd_ros.sim.multistep import (
    aged,
    History,
    mean,
    new_history,
    NONE,
    remember,
    TOUCHED,
    weights,
)
from xpbd_ros.sim.team import share, Team, wait
from xpbd_ros.sim.update import Explicit, Jacobi
from xpbd_ros.sim.vector import lanes, load, select, store


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


def solved_by(state: State, *, integrator: str, apart: type | None, constraints) -> State:
    """
    Return the same particles, with what their solver needs besides.

    Parameters
    ----------
    state : of ``new_state``
    integrator : says what is remembered of earlier substeps
    apart : Jacobi or Explicit, where moves are added up
    constraints : particles of all constraints, a list of (constraints, particles of one)

    """
    slots, dtype = state.x.shape[1], state.x.dtype

    state = state._replace(history=new_history(integrator, slots, dtype))
    if apart is not None:
        state = state._replace(apart=apart(
            zeros((3, slots), dtype), zeros((slots, 4), dtype),
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


@jit
def gather(array, slots, found):
    """Write rows x, y, z of some slots, in float64, into ``found``, shape (slots, 3)."""
    for i in range(len(slots)):
        for k in range(3):
            found[i, k] = array[k, slots[i]]


def forget(state: State, particles=slice(None)) -> None:
    """Let particles start anew: their next substep is one of backward Euler."""
    if state.history is not None:
        state.history.fresh[particles] = NONE


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
        _begin_multistep(state, history, history.older_x, history.older_v, h)


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
def _begin_multistep(state, history, older_x, older_v, h):
    x, v, w, slots = state.x, state.v, state.inv_mass, len(state.inv_mass)
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        wq = load(w, q)
        free = wq > 0.0
        step, a, b = weights(older_x, w, load(history.fresh, q), h)
        store(state.mobility, q, wq * (step * step))
        for k in range(3):
            i = k * slots + q
            xi, vi = load(x, i), load(v, i)
            x_mean = mean(xi, history.x, older_x, i, a, b)
            moved = mean(vi, history.v, older_v, i, a, b) + step * state.gravity[k]
            store(state.x_prev, i, xi)
            remember(vi, history.v, older_v, i)
            store(v, i, select(free, moved, vi))
            store(x, i, select(free, x_mean + step * moved, xi))


@jit(inline=True)
def velocity(v, now, start, step, per_step):
    """
    Return v after a step of H that was predicted to end at start + H v and ends at ``now``.

    It is what differences of positions say but for rounding: the last bit of x, divided by H, is a
    part of what gravity adds to v in a short step that adds up, in float32 or far from the origin.
    So it goes on from the predicted v, which has all its bits.
    """
    return v + (now - (start + step * v)) * per_step


@jit
def update_velocity(state, substep):
    """v = (x - x̄) / H; what was touched has no history."""
    _update_velocity(state, state.history, substep.h)
    wait(state.team)


@jit
def _update_velocity(state, history, h):
    if history is None:
        _update_euler(state, h)
    else:
        _update_multistep(state, history, history.older_x, h)


@jit
def _update_euler(state, h):
    x, v, w, slots, per_h = state.x, state.v, state.inv_mass, len(state.inv_mass), 1.0 / h
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        free = load(w, q) > 0.0
        for k in range(3):
            i = k * slots + q
            xi, xp = load(x, i), load(state.x_prev, i)
            store(v, i, select(free, velocity(load(v, i), xi, xp, h, per_h), (xi - xp) * per_h))


@jit
def _update_multistep(state, history, older_x, h):
    v, w, slots = state.v, state.inv_mass, len(state.inv_mass)
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        fresh = load(history.fresh, q)
        store(history.fresh, q, aged(older_x, w, fresh))
        fresh = select(load(w, q) > 0.0, fresh, TOUCHED)    # what is pinned goes as its pin does
        as_predicted = fresh < TOUCHED
        step, a, b = weights(older_x, w, fresh, h)
        per_step = 1.0 / step
        for k in range(3):
            i = k * slots + q
            xi, xp = load(state.x, i), load(state.x_prev, i)
            start = mean(xp, history.x, older_x, i, a, b)
            store(v, i, select(as_predicted, velocity(load(v, i), xi, start, step, per_step),
                               (xi - start) * per_step))
            remember(xp, history.x, older_x, i)


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
