"""
Pressure: gas in a closed surface, one volume constraint per surface.

C = V - V*,   V = Σ x_i·(x_j×x_k) / 6 over the triangles,   ∇_i = Σ x_j×x_k / 6

(Müller et al. 2006, eq 14). V* is the volume at which the gas has the pressure outside, and the
gas law there, p ~ V^-κ, gives α = V* / (κ outside) [m³/Pa]. ``amount`` of gas is relative to the
amount that fills the rest volume V0 at the outside pressure, so V* = V0 amount^(1/κ). The
multiplier f is the overpressure [Pa], f ∇C the force. κ is 1.4 for air without heat exchange, 1 at
constant temperature. Corners are taken relative to the first particle, and sums over triangles run
in groups of sixteen, in the same order whatever the width of a vector.

A taut surface that floats would begin to rotate, since gas and skin are solved one after the
other; that rotation is undone (``constraints.spin_correction``; doc/numerics.md 5.10).

Limits: the tangent of the gas law at V*: the relative error of the overpressure is about the
overpressure over the outside pressure (2 % at 2 kPa). The surface must be closed and in one piece.
All particles move at once: a surface with little other stiffness may fold through itself.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import fma, lanes, load, splat, store
from xpbd_ros.sim.backend.simd_records import load_records, PACK, store_records
from xpbd_ros.sim.constraints.mesh_batches import pack, padded
from xpbd_ros.sim.constraints.projection import (
    at_the_end,
    denominator,
    keep,
    put,
    recall,
    xpbd_residual,
)
from xpbd_ros.sim.constraints.spin_correction import keep_places, resume, set_aside, turn_back
from xpbd_ros.sim.effect import Built, Effect, sides_of
from xpbd_ros.sim.geometry.mesh import cross, dot
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.accumulators import moves, row
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.stepping.stages import (
    limit_motion,
    prepare,
    project,
    project_back,
    project_inequalities,
    stage,
)

AIR = 101325.0
"""[Pa]"""


@dataclass(frozen=True)
class Parameters:
    """The gas, and the pressure outside."""

    amount: float = quantity(1.0, above=0.0, live=True,
                             doc='gas inside, relative to what fills the rest volume')
    outside: float = quantity(AIR, unit='Pa', above=0.0, live=True, doc='pressure outside')
    kappa: float = quantity(1.4, minimum=1.0, live=True,
                            doc='adiabatic exponent; 1 at constant temperature')


class Pressure(NamedTuple):
    """One closed surface."""

    slots: np.ndarray
    """first and last + 1 of the particles' slots, padding included, shape (2,)"""
    origin: np.ndarray
    """slot of the particle that corners are taken from, shape (1,)"""
    particles: np.ndarray
    """slots of the triangles' corners, in packs, shape (3, triangles)"""
    rest_volume: np.ndarray
    """V* [m³], shape (1,)"""
    compliance: np.ndarray
    """α [m³/Pa], shape (1,)"""
    force: np.ndarray
    """f, overpressure [Pa], the same in all lanes, shape (PACK,)"""
    here: np.ndarray
    """corners as records, shape (slots, 4)"""
    slope: np.ndarray
    """6 ∇C as records [m²], shape (slots, 4)"""
    gradient: np.ndarray
    """∇C [m²], shape (3, slots)"""
    sums: np.ndarray
    """of 6 V, by lane, shape (PACK,)"""
    before: np.ndarray
    """positions before the constraints moved the particles; while ``turned``, less those after
    it [m], shape (3, slots)"""
    turned: np.ndarray
    """True if the rotation that they made in this iteration is undone, shape (1,)"""


@stage(prepare, Pressure)
@jit
def prepare_pressure(pressure, state, substep):
    """Zero the multiplier, and note the positions before the constraints move the particles."""
    pressure.force[:] = 0.0
    keep_places(state.x, pressure.slots[0], pressure.slots[1], pressure.before)
    pressure.turned[0] = False


@stage(project_inequalities, Pressure)
@jit
def turn_surface_back(pressure, state, substep):
    """
    Undo the rotation that the constraints made.

    In further turns of the inequalities there is none of theirs: what contacts turn stays.
    """
    first, last = pressure.slots[0], pressure.slots[1]
    if at_the_end(state.apart) and not pressure.turned[0]:
        turn_back(state.x, state.rounding, state.mobility, state.mass, first, last,
                  pressure.before)
        set_aside(state.x, first, last, pressure.before)
        pressure.turned[0] = True


@stage(limit_motion, Pressure)
@jit
def begin_next_iteration(pressure, state, substep):
    """Go on with the displacements by the constraints alone, those of all iterations."""
    if pressure.turned[0]:
        resume(state.x, pressure.slots[0], pressure.slots[1], pressure.before)
        pressure.turned[0] = False


@jit
def differentiate(pressure, state):
    """Compute ∇C of all particles, and return V."""
    first, last = pressure.slots[0], pressure.slots[1]
    here, slope, sums, origin = pressure.here, pressure.slope, pressure.sums, pressure.origin[0]
    for i in range(first, last):
        for k in range(3):
            here[i, k] = state.x[k, i] - state.x[k, origin]
            slope[i, k] = 0.0
    sums[:] = 0.0
    _sum_packs(here, slope, sums, pressure.particles)
    for i in range(first, last):
        for k in range(3):
            pressure.gradient[k, i] = slope[i, k] / 6.0
    total = 0.0
    for lane in range(len(sums)):
        total += sums[lane]
    return total / 6.0


@jit
def _sum_packs(here, slope, sums, particles):
    p0, p1, p2 = particles[0], particles[1], particles[2]
    for q in range(0, len(p0), lanes(here)):
        x0, y0, z0, m0 = load_records(here, p0, q)
        x1, y1, z1, m1 = load_records(here, p1, q)
        x2, y2, z2, m2 = load_records(here, p2, q)
        ax, ay, az = y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2
        bx, by, bz = y2 * z0 - z2 * y0, z2 * x0 - x2 * z0, x2 * y0 - y2 * x0
        cx, cy, cz = y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1
        lane = q % len(sums)
        store(sums, lane, load(sums, lane) + fma(x0, ax, fma(y0, ay, z0 * az)))
        x0, y0, z0, m0 = load_records(slope, p0, q)
        x1, y1, z1, m1 = load_records(slope, p1, q)
        x2, y2, z2, m2 = load_records(slope, p2, q)
        store_records(slope, p0, q, x0 + ax, y0 + ay, z0 + az, m0)
        store_records(slope, p1, q, x1 + bx, y1 + by, z1 + bz, m1)
        store_records(slope, p2, q, x2 + cx, y2 + cy, z2 + cz, m2)


@stage(project, Pressure)
@stage(project_back, Pressure)
@jit
def project_pressure(pressure, state, substep):
    """Project the constraint of the surface."""
    first, last, gradient = pressure.slots[0], pressure.slots[1], pressure.gradient
    mobility, force = state.mobility, pressure.force
    residual = differentiate(pressure, state) - pressure.rest_volume[0]
    weight = 0.0
    for i in range(first, last):
        x, y, z = gradient[0, i], gradient[1, i], gradient[2, i]
        weight += mobility[i] * (x * x + y * y + z * z)
    alpha, f = splat(mobility, pressure.compliance[0]), recall(state.apart, force, 0)
    before = force[0] if at_the_end(state.apart) else 0.0
    df = -xpbd_residual(splat(mobility, residual), alpha, f) / denominator(
        state.apart, splat(mobility, weight), alpha)
    for lane in range(0, len(force), lanes(mobility)):
        keep(force, lane, f, df)
    for k in range(3):
        _move(state.x[k], row(moves(state.apart), k), row(moves(state.rounding), k), mobility,
              gradient[k], first, last, df)
    _press(pressure, state.inv_mass, (substep.end - substep.begin) * (force[0] - before),
           state.reaction)


@jit
def _move(x, to, errors, mobility, gradient, first, last, df):
    for i in range(first, last, lanes(x)):
        put(x, to, errors, i, load(x, i), load(mobility, i) * df, load(gradient, i))


@jit
def _press(pressure, inv_mass, df, reaction):
    """Add the forces on pinned particles: Δf ∇C."""
    if reaction is not None:
        for i in range(pressure.slots[0], pressure.slots[1]):
            if inv_mass[i] == 0.0:
                for k in range(3):
                    reaction[k, i] += df * pressure.gradient[k, i]


class Gas:
    """The constraints one by one, in sweep order: the definition in NumPy."""

    stretch = True
    """the substeps must resolve it, unlike bending"""

    def __init__(self, particles, index, triangles, rest_volume, compliance):
        self.particles = particles
        """slots of each surface; rows of small ones end in the last slot, which is empty"""
        self.index = index
        self.triangles = triangles
        self.rest_volume = rest_volume
        self.compliance = compliance

    def volumes(self, x: np.ndarray) -> np.ndarray:
        """Return V [m³], shape (surfaces,); x has shape (3, slots)."""
        found = []
        for triangles in self.triangles:
            a, b, c = (x.T[triangles[:, k]].astype(float) for k in range(3))
            found.append(dot(a, cross(b, c)).sum() / 6.0)
        return np.array(found)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C [m³], shape (surfaces,), from the definition."""
        return self.volumes(x) - self.rest_volume

    def energy(self, x: np.ndarray) -> float:
        """Return Σ C² / (2 α) [J]."""
        return float((0.5 * self.residual(x)**2 / self.compliance).sum())

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """Return |∇i| Σ |∇j| / α at each particle [N/m], shape (slots, 3, 3)."""
        total = np.zeros(x.shape[1])
        for slopes, alpha in zip(self.slopes(x), self.compliance):
            total += slopes * slopes.sum() / alpha
        return total[:, None, None] * np.eye(3)

    def slopes(self, x: np.ndarray) -> list[np.ndarray]:
        """Return |∇i| of each surface [m²], each of shape (slots,)."""
        found = []
        for triangles in self.triangles:
            gradient = np.zeros((x.shape[1], 3))
            for k in range(3):
                j, l = x.T[triangles[:, k - 2]], x.T[triangles[:, k - 1]]
                np.add.at(gradient, triangles[:, k], cross(j - x.T[triangles[0, 0]],
                                                           l - x.T[triangles[0, 0]]) / 6.0)
            found.append(np.sqrt(dot(gradient, gradient)))
        return found


def rest_volume(name: str, mesh) -> float:
    """Return the volume of a closed surface [m³]; raise InputError if it is not closed."""
    def refuse(why):
        raise InputError(f'cloths.{name}.effects.pressure: needs a closed surface, and {why}')

    triangles = mesh.triangles
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    keys, back = sides @ [len(mesh.positions), 1], sides @ [1, len(mesh.positions)]
    open_ = ~np.isin(keys, back)
    if mesh.grid is not None or open_.any():
        refuse('a grid is open' if mesh.grid is not None else
               f'this one has {open_.sum()} open edges, the first between particles '
               f'{sides[open_][0][0]} and {sides[open_][0][1]}; fill the holes in the program '
               'that made the file')
    if len(np.unique(keys)) != len(keys):
        refuse('this one meets itself along an edge; split it there')
    piece = connected_components(coo_matrix(
        (np.ones(len(sides)), sides.T), shape=[len(mesh.positions)] * 2), directed=False)[1]
    pieces = len(np.unique(piece[triangles]))
    if pieces > 1:
        refuse(f'this one is in {pieces} pieces; make each a cloth of its own')
    a, b, c = ((mesh.positions - mesh.positions[0])[triangles[:, k]] for k in range(3))
    volume = float(dot(a, cross(b, c)).sum() / 6.0)
    if not volume > 0.0:
        refuse(f'this one is inside out (its volume is {volume:.3g} m³); turn its triangles over')
    return volume


class BuiltPressure(Built):
    """The gas in all cloths with this effect."""

    def __init__(self, parameters, world):
        super().__init__()
        dtype, slots = world.state.x.dtype, world.slots
        here, slope = zeros((slots, 4), dtype), zeros((slots, 4), dtype)
        gradient, before = zeros((3, slots), dtype), zeros((3, slots), dtype)
        parts, listed, volumes, compliance = [], [], [], []
        for cloth, chosen in parameters.items():
            volume = rest_volume(cloth.name, cloth.mesh) * chosen.amount**(1.0 / chosen.kappa)
            alpha = world.compliance_scale * volume / (chosen.kappa * chosen.outside)
            triangles = cloth.slots[cloth.mesh.triangles]
            first = int(cloth.slots.min())
            parts.append(Pressure(
                np.array([first, first + cloth.block.size]), triangles[0, :1].copy(),
                padded(triangles, pack(triangles), slots - 1, np.int32).T.copy(),
                np.array([volume], dtype), np.array([alpha], dtype), zeros(PACK, dtype),
                here, slope, gradient, zeros(PACK, dtype), before,
                np.zeros(1, np.bool_)))
            listed.append(triangles)
            volumes.append(volume)
            compliance.append(alpha)
        self.data, *self.also = parts
        most = max(len(cloth.slots) for cloth in parameters)
        particles = np.full((len(parts), most), slots - 1)
        for slots_of, cloth in zip(particles, parameters):
            slots_of[:len(cloth.slots)] = cloth.slots
        self._names = [cloth.name for cloth in parameters]
        self.constraints = Gas(particles, np.zeros(len(parts), np.int64), listed,
                               np.array(volumes), np.array(compliance))
        self.sides = sides_of(parameters)

    def load(self, state):
        """Return bounds of the force of the gas."""
        force, acceleration, there = 0.0, 0.0, state.mass > 0.0
        pressure = np.abs(self.constraints.residual(state.x) / self.constraints.compliance)
        for p, slopes in zip(pressure, self.constraints.slopes(state.x)):
            force += float(p * slopes.sum())
            acceleration = max(acceleration, float(p * (slopes[there] / state.mass[there]).max()))
        return force, acceleration

    def read_by_stats(self):
        return [part.force for part in self.parts]

    def stats(self):
        return {f'overpressure_{name}_pa': float(part.force[0])
                for name, part in zip(self._names, self.parts)}


EFFECT = Effect('pressure', Parameters, BuiltPressure)
