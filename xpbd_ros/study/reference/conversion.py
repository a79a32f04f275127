"""
Convert a compiled simulation to a problem of the reference solver.

Only this module depends on how the simulation stores particles and constraints. It reads numbers,
and calls no code of the simulation except the motion of pins.
"""

import copy
import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from xpbd_ros.errors import InputError
from xpbd_ros.study.numbering import natural_indices
from xpbd_ros.study.reference.elements import (
    Areas,
    Edges,
    Elements,
    Gas,
    Hinges,
    LinearSums,
    Membranes,
    Slants,
    Tetrahedra,
)
from xpbd_ros.study.reference.problem import Array, Problem

NO_ENERGY = {
    'contact': 'an inequality', 'self_collision': 'an inequality', 'friction': 'dissipation',
    'tether': 'an inequality', 'strain_limit': 'an inequality', 'drag': 'dissipation',
    'wind': 'dissipation', 'rayleigh': 'dissipation'}
"""effects without an energy, with the reason"""


def problem_of(simulation: Any) -> Problem:
    """
    Return the problem that a compiled simulation solves from its present state on.

    Pins move as without further commands, linearly within each frame. For a pin with compliance,
    the target of each of its particles is a further pinned particle, behind all others.

    Raises
    ------
    InputError : for an effect or a pin that the reference solver cannot handle

    """
    for name in simulation.effects:
        if name in NO_ENERGY:
            raise InputError(f'effects.{name}: has no energy, being {NO_ENERGY[name]}')
    numbers = natural_indices(simulation)
    elements = []
    for name, built in simulation.effects.items():
        elements += _elements(name, built, numbers)
    frame = simulation.frame()
    slot, state = simulation.slot, simulation.state
    pin = simulation.effects.get('pin')
    x, v, mass, pinned = frame.x, frame.v, state.mass[slot], frame.inv_mass == 0.0
    rows, moving = np.cumsum(pinned) - 1, []
    for name, held in (pin.held if pin else {}).items():
        if held.slip is not None:
            raise InputError(f'pins.{name}: the reference solver has no slip; leave it out')
        if held.motion.target.orientation != held.motion.pose.orientation:
            raise InputError(f'pins.{name}: the reference solver cannot turn a pin')
        mine = numbers[held.particles]
        if held.compliance:
            places = held.motion.pose.position + Rotation.from_quat(
                held.motion.pose.orientation).apply(held.offsets)
            ghosts = len(x) + np.arange(len(mine))
            elements.append(_springs(mine, ghosts, np.full(
                len(mine), len(mine) * held.compliance * pin.scale)))
            x, v = np.concatenate([x, places]), np.concatenate([v, 0.0 * places])
            mass = np.concatenate([mass, np.ones(len(mine))])
            pinned = np.concatenate([pinned, np.ones(len(mine), bool)])
            rows, mine = np.cumsum(pinned) - 1, ghosts
        motion = held.motion
        if motion.keyframes is not None or motion.target != motion.pose:
            moving.append((rows[mine], copy.deepcopy(motion)))
    if pinned.all():
        raise InputError('pins: no particle is free')
    path = _Path(simulation, x[pinned], moving) if moving else None
    damping, force = simulation.effects.get('damping'), simulation.effects.get('force')
    push = np.zeros(x.shape)
    if force is not None:
        push[:len(slot)] = force.data.f[:, slot].T
    return Problem(
        x=x, v=v, mass=mass, pinned=pinned, gravity=state.gravity, motion=path,
        interval=simulation.frame_dt if path else None, force=push,
        damping=float(damping.data.rate[0]) if damping is not None else 0.0,
        elements=tuple(elements))


def _elements(name: str, built: Any, numbers: Array) -> list[Elements]:
    """Return the elastic elements of an effect; empty for pins, damping and forces."""
    if name == 'seam':
        return [_springs(numbers[data.first], numbers[data.second], data.compliance)
                for data in built.parts]
    if name in ('pin', 'damping', 'force'):
        return []
    unknown, found = f'effects.{name}: the reference solver does not have it', built.constraints
    if found is None:
        raise InputError(unknown)
    if name == 'pressure':
        return [Gas(particles=numbers[triangles], rest_volume=volume, compliance=alpha)
                for triangles, volume, alpha in zip(found.triangles, found.rest_volume,
                                                    found.compliance)]
    if name == 'shear':
        return [Edges(particles=numbers[these.particles], rest_length=these.rest_length,
                      stiffness=_inverse(name, these.compliance))
                if these.particles.shape[1] == 2 else
                Slants(particles=numbers[these.particles],
                       stiffness=_inverse(name, these.compliance)) for these in built.by_part]
    particles = numbers[found.particles]
    if name in ('stretch', 'cross_bend'):
        return [Edges(particles=particles, rest_length=found.rest_length,
                      stiffness=_inverse(name, found.compliance))]
    if name == 'bend':
        return [LinearSums(particles=particles, weight=found.weight,
                           stiffness=1.0 / found.compliance)]
    if name == 'membrane':
        return [Membranes(particles=particles, inverse=found.inverse.reshape(-1, 2, 2),
                          moduli=np.linalg.inv(found.block))]
    if name == 'hinge':
        return [Hinges(particles=particles, rest_angle=found.rest_angle,
                       stiffness=1.0 / found.compliance)]
    if name == 'area':
        return [Areas(particles=particles, rest_area=found.rest_area,
                      stiffness=1.0 / found.compliance)]
    if name == 'volume':
        shear, bulk = (1.0 / found.compliance).T
        return [Tetrahedra(particles=particles, inverse=found.inverse, shear=shear, bulk=bulk)]
    raise InputError(unknown)


def _springs(one: Array, other: Array, compliance: Array) -> LinearSums:
    """Return springs of zero length between pairs of particles."""
    return LinearSums(particles=np.stack([one, other], 1),
                      weight=np.tile([1.0, -1.0], (len(one), 1)),
                      stiffness=_inverse('seam', compliance))


def _inverse(name: str, compliance: Array) -> Array:
    if (compliance == 0.0).any():
        raise InputError(f'effects.{name}: the reference solver has no rigid constraints; '
                         'compliance must be > 0 m/N (got 0)')
    return 1.0 / compliance


class _Path:
    """The positions of pinned particles over time, linear within each frame."""

    def __init__(self, simulation: Any, x: Array, moving: list):
        self._knots = [x]
        self._moving = moving
        self._index, self._age = simulation.index, simulation.age
        self._dt = simulation.frame_dt
        self._time_ns = simulation.time_ns

    def __call__(self, t: float) -> Array:
        """Return the positions at a time since the start [s], shape (p, 3) [m]."""
        frame = max(0, math.ceil(t / self._dt - 1e-9) - 1)
        while len(self._knots) < frame + 2:
            self._advance()
        a, b = self._knots[frame], self._knots[frame + 1]
        return a + (t / self._dt - frame) * (b - a)

    def _advance(self) -> None:
        knot = self._knots[-1].copy()
        for rows, motion in self._moving:
            motion.advance(self._time_ns(self._index + len(self._knots)), self._dt,
                           self._time_ns(self._age + len(self._knots)))
            knot[rows] += np.subtract(motion.pose.position, motion.start.position)
        self._knots.append(knot)
