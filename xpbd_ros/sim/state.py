"""Particle state, and the two kernels that integrate it (Macklin et al. 2016, algorithm 1)."""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.jit import jit


class State(NamedTuple):
    """All particles of a scene, cloth after cloth."""

    x: np.ndarray
    """positions [m], shape (particles, 3)"""
    x_prev: np.ndarray
    """positions at the substep's start [m], shape (particles, 3)"""
    v: np.ndarray
    """velocities [m/s], shape (particles, 3)"""
    mass: np.ndarray
    """[kg], shape (particles,); constant"""
    inv_mass: np.ndarray
    """[1/kg], shape (particles,); 0 while pinned"""
    gravity: np.ndarray
    """[m/s²], shape (3,)"""
    reaction: np.ndarray | None
    """constraint force on each pinned particle, mean over the frame [N], shape (particles, 3);
    None in a scene without pins"""


class Substep(NamedTuple):
    """One substep: its length and its place in the frame."""

    h: float
    """[s]"""
    begin: float
    """fraction of the frame at its start, 0 … 1"""
    end: float
    """fraction of the frame at its end"""


def new_state(x: np.ndarray, mass: np.ndarray, gravity, *, pins: bool = False) -> State:
    """
    Return particles at rest.

    Parameters
    ----------
    x : positions [m], shape (particles, 3)
    mass : [kg], shape (particles,), > 0
    gravity : [m/s²], 3 numbers
    pins : whether forces on pinned particles will be asked for

    """
    x = np.array(x, float, order='C')
    mass = np.array(mass, float)
    return State(x, x.copy(), np.zeros_like(x), mass, 1.0 / mass, np.array(gravity, float),
                 np.zeros_like(x) if pins else None)


@jit
def predict(state, substep):
    """x_prev = x;  v += h g;  x += h v, for every particle that is free."""
    h = substep.h
    for i in range(len(state.x)):
        for k in range(3):
            state.x_prev[i, k] = state.x[i, k]
            if state.inv_mass[i] > 0.0:
                state.v[i, k] += h * state.gravity[k]
                state.x[i, k] += h * state.v[i, k]


@jit
def update_velocity(state, substep):
    """v = (x - x_prev) / h."""
    for i in range(len(state.x)):
        for k in range(3):
            state.v[i, k] = (state.x[i, k] - state.x_prev[i, k]) / substep.h
