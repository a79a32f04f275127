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
from xpbd_ros.sim.vector import both, lanes, load, select, splat, store


class History(NamedTuple):
    """What BDF2 remembers of the substep before."""

    x: np.ndarray
    """x_{n-1} [m], shape (3, slots)"""
    v: np.ndarray
    """v_{n-1} [m/s], shape (3, slots)"""
    fresh: np.ndarray
    """0: has a history; 1: has none, this substep; 2: touched in it; shape (slots,)"""
    step: np.ndarray
    """H of this substep [s], shape (slots,)"""


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


class Substep(NamedTuple):
    """One substep: its length and its place in the frame."""

    h: float
    """[s]"""
    begin: float
    """fraction of the frame at its start, 0 … 1"""
    end: float
    """fraction of the frame at its end"""


def new_state(x: np.ndarray, mass: np.ndarray, gravity, slot: np.ndarray, slots: int, *,
              pins: bool = False, history: bool = False, dtype=np.float64) -> State:
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
    history : whether the integrator remembers a substep
    dtype : of all numbers

    """
    def zeros(*shape):
        return np.zeros((*shape, slots), dtype)

    state = State(zeros(3), zeros(3), zeros(3), zeros(), zeros(), zeros(),
                  np.array(gravity, dtype), zeros(3) if pins else None,
                  History(zeros(3), zeros(3), zeros(), zeros()) if history else None)
    state.x[:, slot] = np.asarray(x).T
    state.x_prev[:] = state.x
    state.mass[slot] = mass
    state.inv_mass[slot] = 1.0 / state.mass[slot]
    forget(state)
    return state


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


@jit
def begin(state, substep):
    """x_prev = x_n;  x = x̄;  v = v̄ + H g;  mobility = w H²."""
    for k in range(3):
        _begin(state.x[k], state.x_prev[k], state.v[k], state.gravity[k], state.inv_mass,
               state.mobility, state.history, k, substep.h)


@jit
def _begin(x, x_prev, v, g, w, mobility, history, k, h):
    """Do one axis."""
    for q in range(0, len(w), lanes(w)):
        free = load(w, q) > 0.0
        xq, vq = load(x, q), load(v, q)
        store(x_prev, q, xq)
        if history is None:
            store(v, q, select(free, vq + h * g, vq))
            store(mobility, q, load(w, q) * (h * h))
        else:
            euler = load(history.fresh, q) > 0.5
            step = select(euler, splat(w, h), splat(w, 2.0 / 3.0 * h))
            x_before, v_before = history.x[k], history.v[k]
            x_mean = select(euler, xq, (4.0 * xq - load(x_before, q)) / 3.0)
            v_mean = select(euler, vq, (4.0 * vq - load(v_before, q)) / 3.0)
            store(v_before, q, vq)
            store(x, q, select(free, x_mean, xq))
            store(v, q, select(free, v_mean + step * g, vq))
            store(history.step, q, step)
            store(mobility, q, load(w, q) * (step * step))


@jit
def move(state, substep):
    """x += H v, for every particle that is free."""
    for k in range(3):
        _move(state.x[k], state.v[k], state.inv_mass, state.history, substep.h)


@jit
def _move(x, v, w, history, h):
    """Do one axis."""
    for q in range(0, len(w), lanes(w)):
        xq, vq = load(x, q), load(v, q)
        if history is None:
            moved = xq + h * vq
        else:
            moved = xq + load(history.step, q) * vq
        store(x, q, select(load(w, q) > 0.0, moved, xq))


@jit
def update_velocity(state, substep):
    """v = (x - x_n) / h or (3 x - 4 x_n + x_{n-1}) / (2 h); what was touched has no history."""
    for k in range(3):
        _velocity(state.x[k], state.x_prev[k], state.v[k], state.inv_mass, state.history, k,
                  substep.h)
    _age(state.history)


@jit
def _velocity(x, x_prev, v, w, history, k, h):
    """Do one axis."""
    for q in range(0, len(w), lanes(w)):
        xq, xp = load(x, q), load(x_prev, q)
        slope = (xq - xp) / h
        if history is not None:
            x_before = history.x[k]
            curve = (3.0 * xq - 4.0 * xp + load(x_before, q)) / (2.0 * h)
            smooth = both(load(w, q) > 0.0, load(history.fresh, q) < 0.5)
            slope = select(smooth, curve, slope)
            store(x_before, q, xp)
        store(v, q, slope)


@jit
def _age(history):
    """A particle has a history after a substep in which nothing touched it."""
    if history is not None:
        fresh = history.fresh
        for q in range(0, len(fresh), lanes(fresh)):
            touched = load(fresh, q) > 1.5
            store(fresh, q, select(touched, splat(fresh, 1.0), splat(fresh, 0.0)))
