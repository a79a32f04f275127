"""Particle state: arrays of all particles by slot, and the storage of integrator and solver."""

from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.sim.backend.device_team import DeviceTeam
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import ThreadTeam
from xpbd_ros.sim.particles.accumulators import Explicit, Jacobi
from xpbd_ros.sim.particles.history import FULL, HALF, History, new_history, NONE
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.rounding import new_rounding, Rounding

SHORT = 4.5e-4
"""substep below which the moves of float32 are compensated [s]: with more than 37 in 1/60 s, their
rounding errors exceed a tenth of the error of the method"""


class State(NamedTuple):
    """All particles of a scene, by slot (``particles.memory_layout``)."""

    x: np.ndarray
    """positions [m], shape (3, slots)"""
    x_prev: np.ndarray
    """positions at this substep's start [m], shape (3, slots)"""
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
    None if forces are not requested"""
    history: History | None
    """None with backward Euler and leapfrog"""
    apart: Jacobi | Explicit | None
    """displacement accumulator; None with Gauss-Seidel methods"""
    team: ThreadTeam | DeviceTeam | None = None
    """None with one thread"""
    gap: np.ndarray | None = None
    """distance of neighbours [m], shape (slots,); None unless the integrator is NDF2"""
    rounding: Rounding | None = None
    """None in float64, and with substeps that are not short"""
    clock: Any = None
    """a measurement's, read after each part of a step (``stages.lap``); usually None"""


@jit(inline=True)
def in_team(state, team):
    """Return the state of a thread in a team."""
    return State(state.x, state.x_prev, state.v, state.mass, state.inv_mass, state.mobility,
                 state.gravity, state.reaction, state.history, state.apart, team, state.gap,
                 state.rounding, state.clock)


class Substep(NamedTuple):
    """Length of a substep and its position in the frame."""

    h: float
    """[s]"""
    begin: float
    """fraction of the frame at its start, 0 … 1"""
    end: float
    """fraction of the frame at its end"""
    iteration: int = 0
    """number of the solver iteration; the first zeroes the multipliers"""
    soft: float | None = None
    """stiffness over mass, times h², below which ``line`` sweeps once; None in other methods"""
    direction: int = 0
    """of what ``line`` sweeps once: 1 forward, -1 backward, 0 in neither, but both ways"""


def new_state(x: np.ndarray, mass: np.ndarray, gravity, slot: np.ndarray, slots: int, *,
              pins: bool = False, dtype=np.float64) -> State:
    """
    Return particles at rest.

    Parameters
    ----------
    x : positions [m], shape (particles, 3)
    mass : [kg], shape (particles,), > 0
    gravity : [m/s²], shape (3,)
    slot : slot of each particle, shape (particles,)
    slots : number of slots
    pins : True to allocate ``reaction``, the forces on pinned particles
    dtype : of all arrays

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


def with_solver_storage(state: State, *, integrator: str, apart: type | None, constraints,
                        gap=np.inf, compensates: bool = False) -> State:
    """
    Return the state with the storage of an integrator (history) and a method (accumulator).

    Parameters
    ----------
    state : from ``new_state``
    integrator : key of ``history.STEPS``
    apart : Jacobi, Explicit or None: type of the accumulator
    constraints : slots of all constraints, arrays of shape (constraints, particles of each)
    gap : distance of neighbours [m], shape (slots,) or a scalar
    compensates : True if the moves of float32 are compensated (``particles.rounding``)

    """
    slots, dtype = state.x.shape[1], state.x.dtype

    state = state._replace(history=new_history(integrator, slots, dtype))
    if integrator == 'ndf2':
        distance = zeros(slots, dtype)
        distance[:] = gap
        state = state._replace(gap=distance)
    if compensates and dtype == np.float32:
        state = state._replace(rounding=new_rounding(slots, dtype))
    if apart is not None:
        state = state._replace(apart=apart(
            zeros((3, slots), dtype), zeros((slots, 4), dtype),
            *([np.full(1, _most_constraints(constraints, state.mass > 0.0), dtype)]
              * (apart is Jacobi))))
    return state


def _most_constraints(constraints, there: np.ndarray) -> float:
    """
    Return the largest number n of constraints at a particle.

    With A = J M Jᵀ, xᵀ A x ≤ n Σ xᵢ² Aᵢᵢ, so Jacobi with ω = 1 / n never overshoots
    (doc/numerics.md 3.5).
    """
    count = np.zeros(len(there))
    for particles in constraints:
        np.add.at(count, particles, 1.0)
    return count[there].max(initial=1.0)


def places(array: np.ndarray, slots=slice(None)) -> np.ndarray:
    """Return vectors of an array (3, slots) for some slots as float64, shape (slots, 3)."""
    return array[:, slots].T.astype(float)


@jit
def gather(x, v, inv_mass, slots, natural_x, natural_v, natural_inv_mass):
    """
    Write the state of some slots in float64.

    Parameters
    ----------
    x, v, inv_mass : arrays of the state
    slots : shape (n,)
    natural_x, natural_v : output, shape (n, 3)
    natural_inv_mass : output, shape (n,)

    """
    for i in range(len(slots)):
        slot = slots[i]
        for k in range(3):
            natural_x[i, k] = x[k, slot]
            natural_v[i, k] = v[k, slot]
        natural_inv_mass[i] = inv_mass[slot]


def history_arrays(state: State) -> list[np.ndarray]:
    """Return the arrays besides x and v that determine the next substep, each (3, slots)."""
    if state.history is None:
        return []
    last = [state.x_prev, state.history.v]
    if state.history.older_v is None:
        return last
    return [*last, state.history.x, state.history.older_v]


def full_history(state: State) -> list[np.ndarray]:
    """Return all arrays besides x, v and inv_mass that determine the next substep."""
    fresh = [] if state.history is None else [state.history.fresh]
    return [*history_arrays(state), *fresh]


def take_integrator(state: State, integrator: str) -> None:
    """Take an integrator that the storage of the history serves, with a cleared history."""
    if state.history is not None and state.history.fullest is not None:
        state.history.fullest[0] = FULL if integrator == 'ndf2' else HALF


def forget(state: State, particles=slice(None)) -> None:
    """Clear the history of particles: their next substep is a backward Euler step."""
    if state.history is not None:
        state.history.fresh[particles] = NONE


