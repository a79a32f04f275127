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
    put_back_history,
    steadied,
    TOUCHED,
    turned_history,
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
    """positions at the last substep's start [m], shape (3, slots)"""
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
    gap: np.ndarray | None = None
    """distance of neighbours [m], shape (slots,); None where nobody asks"""


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


def solved_by(state: State, *, integrator: str, apart: type | None, constraints,
              gap=np.inf) -> State:
    """
    Return the same particles, with what their solver needs besides.

    Parameters
    ----------
    state : of ``new_state``
    integrator : says what is remembered of earlier substeps
    apart : Jacobi or Explicit, where moves are added up
    constraints : particles of all constraints, a list of (constraints, particles of one)
    gap : distance of neighbours [m], at each slot or everywhere

    """
    slots, dtype = state.x.shape[1], state.x.dtype

    state = state._replace(history=new_history(integrator, slots, dtype))
    if integrator == 'ndf2':
        state = state._replace(gap=zeros(slots, dtype))
        state.gap[:] = gap
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
def gather(x, v, inv_mass, slots, natural_x, natural_v, natural_inv_mass):
    """Write some slots, one after another, in float64: x and v of shape (slots, 3)."""
    for i in range(len(slots)):
        slot = slots[i]
        for k in range(3):
            natural_x[i, k] = x[k, slot]
            natural_v[i, k] = v[k, slot]
        natural_inv_mass[i] = inv_mass[slot]


def remembered(state: State) -> list[np.ndarray]:
    """Return what the next substep starts from besides x and v; each of shape (3, slots)."""
    if state.history is None:
        return []
    last = [state.x_prev, state.history.v]
    if state.history.older_v is None:
        return last
    return [*last, state.history.x, state.history.older_v]


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


@jit(inline=True)
def turned(state):
    """
    Return the state of the next substep, before it begins: what was now is before.

    The arrays trade places; what was oldest makes room for what comes.
    """
    x, x_prev, v, history = turned_history(state.history, state.x, state.x_prev, state.v)
    return State(x, x_prev, v, state.mass, state.inv_mass, state.mobility, state.gravity,
                 state.reaction, history, state.apart, state.team, state.gap)


@jit
def begin(state, substep):
    """v = v̄ + H g;  x = x̄ + H v;  mobility = w H²; the state is ``turned``."""
    first, last = own(state)
    for q in range(first, last, lanes(state.inv_mass)):
        _begin(state, state.history, q, substep.h)
    wait(state.team)


@jit
def predict(state, substep):
    """
    x = x̄ + H v, where forces changed v since the substep began; what they touched has no history.

    A force moves x by less than the last bit of it in a short substep. Added to x that would be
    lost, and to v with it, which is made to fit x in the end.
    """
    first, last = own(state)
    for q in range(first, last, lanes(state.inv_mass)):
        _predict(state, state.history, q, substep.h)
    wait(state.team)


@jit
def update_velocity(state, substep):
    """v = (x - x̄) / H; what was touched has no history."""
    first, last = own(state)
    for q in range(first, last, lanes(state.inv_mass)):
        _update_velocity(state, state.history, q, substep.h)
    wait(state.team)


@jit
def update_velocity_and_begin(state, substep):
    """End a substep and begin the next, in one pass over memory."""
    after = turned(state)
    first, last = own(state)
    for q in range(first, last, lanes(state.inv_mass)):
        _update_velocity(state, state.history, q, substep.h)
        _begin(after, after.history, q, substep.h)
    wait(state.team)


@jit(inline=True)
def _begin(state, history, q, h):
    if history is None:
        _begin_euler(state, q, h)
    else:
        _begin_multistep(state, history, history.older_x, history.older_v, q, h)


@jit(inline=True)
def _begin_euler(state, q, h):
    v, slots = state.v, len(state.inv_mass)
    w = load(state.inv_mass, q)
    free = w > 0.0
    store(state.mobility, q, w * (h * h))
    for k in range(3):
        i = k * slots + q
        xi, vi = load(state.x_prev, i), load(v, i)
        vi = select(free, vi + h * state.gravity[k], vi)
        store(v, i, vi)
        store(state.x, i, select(free, xi + h * vi, xi))


@jit(inline=True)
def _begin_multistep(state, history, older_x, older_v, q, h):
    w, slots = load(state.inv_mass, q), len(state.inv_mass)
    free = w > 0.0
    fresh = steadied(history.fresh, history.v, older_v, state.v, state.gap, q, h)
    step, a, b = weights(older_x, state.inv_mass, fresh, h)
    store(state.mobility, q, w * (step * step))
    for k in range(3):
        i = k * slots + q
        xi, vi = load(state.x_prev, i), load(history.v, i)
        x_mean = mean(xi, history.x, older_x, i, a, b)
        moved = _mean_velocity(vi, older_v, state.v, i, a, b) + step * state.gravity[k]
        store(state.v, i, select(free, moved, vi))
        store(state.x, i, select(free, x_mean + step * moved, xi))


@jit(inline=True)
def _predict(state, history, q, h):
    if history is None:
        _predict_euler(state, q, h)
    else:
        _predict_multistep(state, history, history.older_x, q, h)


@jit(inline=True)
def _predict_euler(state, q, h):
    free, slots = load(state.inv_mass, q) > 0.0, len(state.inv_mass)
    for k in range(3):
        i = k * slots + q
        moved = load(state.x_prev, i) + h * load(state.v, i)
        store(state.x, i, select(free, moved, load(state.x, i)))


@jit(inline=True)
def _predict_multistep(state, history, older_x, q, h):
    free, slots = load(state.inv_mass, q) > 0.0, len(state.inv_mass)
    step, a, b = weights(older_x, state.inv_mass, load(history.fresh, q), h)
    for k in range(3):
        i = k * slots + q
        start = mean(load(state.x_prev, i), history.x, older_x, i, a, b)
        store(state.x, i, select(free, start + step * load(state.v, i), load(state.x, i)))


@jit(inline=True)
def _mean_velocity(now, older_v, oldest, i, a, b):
    if older_v is None:
        return mean(now, oldest, None, i, a, b)
    else:
        return mean(now, older_v, oldest, i, a, b)


@jit(inline=True)
def velocity(v, now, start, step, per_step):
    """
    Return v after a step of H that was predicted to end at start + H v and ends at ``now``.

    It is what differences of positions say but for rounding: the last bit of x, divided by H, is a
    part of what gravity adds to v in a short step that adds up, in float32 or far from the origin.
    So it goes on from the predicted v, which has all its bits.
    """
    return v + (now - (start + step * v)) * per_step


@jit(inline=True)
def _update_velocity(state, history, q, h):
    if history is None:
        _update_euler(state, q, h)
    else:
        _update_multistep(state, history, history.older_x, q, h)


@jit(inline=True)
def _update_euler(state, q, h):
    v, slots, per_h = state.v, len(state.inv_mass), 1.0 / h
    free = load(state.inv_mass, q) > 0.0
    for k in range(3):
        i = k * slots + q
        xi, xp = load(state.x, i), load(state.x_prev, i)
        store(v, i, select(free, velocity(load(v, i), xi, xp, h, per_h), (xi - xp) * per_h))


@jit(inline=True)
def _update_multistep(state, history, older_x, q, h):
    v, w, slots = state.v, state.inv_mass, len(state.inv_mass)
    fresh = load(history.fresh, q)
    store(history.fresh, q, aged(older_x, w, fresh))
    fresh = select(load(w, q) > 0.0, fresh, TOUCHED)    # what is pinned goes as its pin does
    as_predicted = fresh < TOUCHED
    step, a, b = weights(older_x, w, fresh, h)
    per_step = 1.0 / step
    for k in range(3):
        i = k * slots + q
        xi, start = load(state.x, i), mean(load(state.x_prev, i), history.x, older_x, i, a, b)
        store(v, i, select(as_predicted, velocity(load(v, i), xi, start, step, per_step),
                           (xi - start) * per_step))


@jit
def write_starts(state, target, h):
    """Write x̄ of all particles, shape (3, slots)."""
    for q in range(0, len(state.inv_mass), lanes(state.inv_mass)):
        _write_start(state, state.history, target, q, h)


@jit(inline=True)
def _write_start(state, history, target, q, h):
    if history is None:
        for k in range(3):
            i = k * len(state.inv_mass) + q
            store(target, i, load(state.x_prev, i))
    else:
        _write_mean(state, history, history.older_x, target, q, h)


@jit(inline=True)
def _write_mean(state, history, older_x, target, q, h):
    _, a, b = weights(older_x, state.inv_mass, load(history.fresh, q), h)
    for k in range(3):
        i = k * len(state.inv_mass) + q
        store(target, i, mean(load(state.x_prev, i), history.x, older_x, i, a, b))


@jit
def put_back(home, state):
    """Write what ``turned`` moved to where it was."""
    slots = len(state.inv_mass)
    first, last = own(state)
    for q in range(first, last, lanes(state.inv_mass)):
        for k in range(3):
            _put_back(home, home.history, state, state.history, k * slots + q)
    wait(state.team)


@jit(inline=True)
def _put_back(home, home_history, state, history, i):
    x, x_prev = load(state.x, i), load(state.x_prev, i)
    if history is not None:
        put_back_history(home_history, home.v, history, history.older_v, state.v, i)
    store(home.x, i, x)
    store(home.x_prev, i, x_prev)


@jit
def at_start(state):
    """Return the state with the particles where the substep starts."""
    return State(state.x_prev, state.x_prev, state.v, state.mass, state.inv_mass, state.mobility,
                 state.gravity, state.reaction, state.history, state.apart, state.team,
                 state.gap)


@jit
def set_mobility(state, h):
    """Mobility = w h²."""
    first, last = own(state)
    for q in range(first, last, lanes(state.inv_mass)):
        store(state.mobility, q, load(state.inv_mass, q) * (h * h))
    wait(state.team)


@jit(inline=True)
def _taken(move, i):
    """Return moves from index i on, and begin to sum up anew."""
    found = load(move, i)
    store(move, i, 0.0)
    return found


@jit
def add_moves(state):
    """x += the moves that the constraints summed up."""
    x, move, slots = state.x, state.apart.move, len(state.inv_mass)
    first, last = own(state)
    for k in range(3):
        for i in range(k * slots + first, k * slots + last, lanes(x)):
            store(x, i, load(x, i) + _taken(move, i))
    wait(state.team)


@jit
def kick_on(state, substep):
    """
    v += h F / m, with the moves h² F / m that were summed up, and x as v then says.

    The moves themselves, added to x, would lose what is below its last bit, and v with it. What
    moved x since it was predicted (soft pins) is kept.
    """
    w, v, move, slots = state.inv_mass, state.v, state.apart.move, len(state.inv_mass)
    h = substep.h
    first, last = own(state)
    for q in range(first, last, lanes(w)):
        free = load(w, q) > 0.0
        for k in range(3):
            i = k * slots + q
            xi, start, vi = load(state.x, i), load(state.x_prev, i), load(v, i)
            moved = xi - (start + h * vi)
            vi = vi + _taken(move, i) * (1.0 / h)
            store(v, i, select(free, vi, load(v, i)))
            store(state.x, i, select(free, start + h * vi + moved, xi))
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
            change = share / h * _taken(move, i) + share * h * state.gravity[k]
            store(v, i, select(free, vi + change, vi))
    wait(state.team)
