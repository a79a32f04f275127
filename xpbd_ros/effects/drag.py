"""
Drag: aerodynamic force of still air or ``wind`` on each triangle, normal and tangential.

A triangle of area A and unit normal n, with u the velocity of the air relative to the mean of its
particles', receives

    F = ½ ρ A (normal |u·n| (u·n) n + 2 tangential |u_t| u_t),   u_t = u - (u·n) n,

which is c_n (u·n) n + c_t u_t and includes both sides of the cloth. Each of its particles i takes
a third of c_n n nᵀ + c_t (1 - n nᵀ), times its own relative velocity u_i: together F, and sawtooth
motion has drag as well. (On a grid, where diagonals alternate, the third is replaced by the
fraction that makes its area that of its mass, so that a flat sheet stays flat.) With D_i, the sum
of these matrices at a particle, Z = H w D_i and u_i at the velocity that is expected where the
force acts, a substep adds

    Δv = Z u_i / max(1, trace Z).

So cloth that is held feels the whole force, and no particle gains more than u_i, whatever the
step: light cloth in a storm takes on the wind's velocity and keeps it, where an explicit force
would overshoot (doc/numerics.md 6.2). A step with trace Z > 1 is too long, and its force too small
by that factor. ``auto`` chooses the substeps so that trace Z stays below RESOLVED in the scene's
wind; particles above it take steps of backward Euler, since the v̄ of BDF2 would overshoot.

The expected velocity continues the present acceleration. A step of BDF2 or NDF2 starts from v̄,
which a constant acceleration has at t_n + h - H, so at the end it has v_n + h / (h - H) (v̄ - v_n).
The leapfrog has v_n-1/2 + (v_n-1/2 - v_n-3/2) / 2 at x_n. So the force is of second order in time.
Where Z is large it would overshoot, so from half of RESOLVED on it changes to u_i at v̄, of first
order, as it is with backward Euler.

Limits: no lift from separated flow, no lee, no added mass of air. A strip of one row has no
triangles.
"""

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import inline, jit
from xpbd_ros.sim.backend.simd import fma, highest, lanes, larger, root, select
from xpbd_ros.sim.backend.simd_records import load_records, store_records
from xpbd_ros.sim.backend.threads import is_on_device, turns, turns_on_device, wait, wait_on_device
from xpbd_ros.sim.constraints.mesh_batches import pack, padded
from xpbd_ros.sim.constraints.projection import at_the_end
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.geometry.mesh import triangle_areas
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.explicit_updates import half_of
from xpbd_ros.sim.particles.history import discard_history, step_at
from xpbd_ros.sim.particles.memory_layout import zeros
from xpbd_ros.sim.particles.records import new_records
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    add_explicit_forces,
    force,
    react_to_half_kick,
    stage,
)

RESOLVED = 0.5
"""largest trace Z that ``auto`` allows in the scene's wind; beyond it a particle's history ends"""


@dataclass(frozen=True)
class Parameters:
    """The density of the air, and the drag coefficients of the cloth."""

    density: float = quantity(1.2, unit='kg/m³', minimum=0.0, live=True, doc='density of the air')
    normal: float = quantity(1.2, minimum=0.0, live=True, doc='drag coefficient across the cloth')
    tangential: float = quantity(0.01, minimum=0.0, live=True,
                                 doc='drag coefficient along the cloth, of each side')


class Gathered(NamedTuple):
    """The triangles of each particle, on a GPU."""

    first: np.ndarray
    """row offsets into ``triangle`` (CSR), shape (slots + 1,)"""
    triangle: np.ndarray
    """indices of the triangles of each particle, ascending in each row"""
    matrix: np.ndarray
    """xx, yy, zz, yz, zx, xy of each triangle's D [kg/s], shape (triangles, 6)"""


def gather_triangles(particles: np.ndarray, slots: int, dtype) -> Gathered:
    """Return the triangles of each of so many slots; ``particles``: of shape (3, triangles)."""
    order = np.argsort(particles.T.ravel(), kind='stable')
    count = np.bincount(particles.ravel(), minlength=slots)
    return Gathered(np.concatenate([[0], np.cumsum(count)]), order // 3,
                    zeros((particles.shape[1], 6), dtype))


class Drag(NamedTuple):
    """Data of the kernels."""

    wind: np.ndarray | None
    """velocity of the air [m/s], shape (3,); None in still air"""
    coefficient: np.ndarray
    """ρ normal / 4 and ρ tangential / 2 [kg/m³], shape (2,)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots of the corners, shape (3, triangles)"""
    share: np.ndarray
    """fraction of its triangles' force that each particle takes, shape (slots,)"""
    area: np.ndarray
    """of each particle [m²], shape (slots,)"""
    past: np.ndarray | None
    """velocities before the last substep [m/s], shape (3, slots); None without ``explicit``"""
    gathered: Gathered | None
    """None on a CPU"""
    x: np.ndarray
    """positions as records, shape (slots, 4)"""
    u: np.ndarray
    """velocities of the air relative to the particles as records [m/s], shape (slots, 4)"""
    along: np.ndarray
    """xx, yy, zz of Σ D as records [kg/s], shape (slots, 4)"""
    across: np.ndarray
    """yz, zx, xy of Σ D as records [kg/s], shape (slots, 4)"""


@jit
def _air(wind, k):    # Numba prunes a branch on None where that is an argument
    if wind is None:
        return 0.0
    return wind[k]


@stage(force, Drag, on_device=True)
@jit
def drag_triangles(drag, state, substep):
    """Sum the matrices of the triangles, then change the velocity of each particle."""
    x, lead = state.x, 0.0
    if not at_the_end(state.apart):
        x, lead = state.x_prev, -1.0 if substep.begin == 0.0 else 0.5    # first, the frame's v
    _add_up(drag, state, x, substep.h, 1.0, lead)
    begin, end, turn = turns_on_device(state.team, drag.slots[1] - drag.slots[0])
    for n in range(begin, end, turn):
        i = drag.slots[0] + n
        step = step_at(state.history, i, substep.h)
        (dx, dy, dz), trace = _change(drag, state, i, step)
        if trace > RESOLVED:
            if step < substep.h:
                _begin_again(state.history, drag, state, i, substep.h)
                (dx, dy, dz), _ = _change(drag, state, i, substep.h)
            discard_history(state.history, i)
        state.v[0, i] += dx
        state.v[1, i] += dy
        state.v[2, i] += dz


@jit
def _begin_again(history, drag, state, i, h):
    """Predict the velocity of a particle by backward Euler, v_n + h g, with its mobility and u."""
    if history is not None:
        state.mobility[i] = state.inv_mass[i] * (h * h)
        for k in range(3):
            v = history.v[k, i]
            state.v[k, i] = v + h * state.gravity[k]
            drag.u[i, k] = _air(drag.wind, k) - v


@stage(add_explicit_forces, Drag)
@jit
def kick_drag(drag, state, substep):
    """H² F / m at an end of a frame."""
    _add_up(drag, state, state.x, substep.h, 0.0, 0.0 if half_of(substep) < 0.0 else 0.5)
    move = state.apart.move
    for i in range(drag.slots[0], drag.slots[1]):
        (dx, dy, dz), _ = _change(drag, state, i, substep.h)
        move[0, i] += substep.h * dx
        move[1, i] += substep.h * dy
        move[2, i] += substep.h * dz


@jit
def _add_up(drag, state, x, h, fallen, lead):
    """
    Write Σ D and u.

    Parameters
    ----------
    drag, state : data and particles
    x : positions where the force acts [m], shape (3, slots)
    h : substep [s]
    fallen : 1 where gravity over H has been added to v, 0 at an end of a frame
    lead : of the leapfrog, the change of v since the last substep to be added once more

    """
    first, last = drag.slots[0], drag.slots[1]
    wind = _air(drag.wind, 0), _air(drag.wind, 1), _air(drag.wind, 2)
    begin, end, turn = turns_on_device(state.team, last - first)
    for n in range(begin, end, turn):
        i = first + n
        _load_velocity(drag, state, wind, i, h, fallen, lead)
        for k in range(3):
            drag.x[i, k] = x[k, i]
        for k in range(4):
            drag.along[i, k] = 0.0
            drag.across[i, k] = 0.0
    wait_on_device(state.team)
    sum_triangles(drag, state.team)
    wait_on_device(state.team)


@jit(inline=True)
def _load_velocity(drag, state, wind, i, h, fallen, lead):
    """Write u of a particle, from the velocity that is expected where the force acts."""
    w, step = state.inv_mass[i], step_at(state.history, i, h)
    fall, ahead, square = 0.0, 0.0, 0.0
    if w > 0.0:
        fall, ahead = step * fallen, _lead_of(state.history, step, h, lead)
    for k in range(3):
        v = state.v[k, i] - fall * state.gravity[k]
        square += (wind[k] - v)**2
        drag.u[i, k] = v
    ahead *= _trust(drag, step * w, i, square)
    for k in range(3):
        v = drag.u[i, k]
        drag.u[i, k] = wind[k] - (v + ahead * (v - _earlier(state.history, drag.past, i, k)))
        _keep(state.history, drag.past, i, k, v)


@jit(inline=True)
def _lead_of(history, step, h, lead):
    """Return by how much of its change since an earlier velocity v continues."""
    if history is None:
        return lead
    return step / (h - step) if step < h else 0.0


@jit(inline=True)
def _earlier(history, past, i, k):
    """Return that earlier velocity of a particle: v_n, or of the leapfrog the one before."""
    if history is not None:
        return history.v[k, i]
    if past is not None:
        return past[k, i]
    return 0.0


@jit(inline=True)
def _keep(history, past, i, k, v):
    """Keep v for the next substep of the leapfrog."""
    if history is not None:    # Numba prunes the branches
        return
    if past is not None:
        past[k, i] = v


@jit(inline=True)
def _trust(drag, per_mass, i, square):
    """Return 1 where a bound of trace Z is below half of RESOLVED, 0 above RESOLVED."""
    grip = drag.area[i] * (2.0 * drag.coefficient[0] + 4.0 * drag.coefficient[1])
    return min(1.0, max(0.0, 2.0 - 2.0 / RESOLVED * per_mass * grip * sqrt(square)))


def sum_triangles(drag, team):
    """Add the matrices of all triangles to those of their particles."""


@inline(sum_triangles)
def _sum_triangles(drag, team):
    if is_on_device(team):
        return lambda drag, team: _sum_by_particle(drag, drag.gathered, team)
    return lambda drag, team: _sum_by_triangle(drag)


@jit
def _sum_by_triangle(drag):
    particles = drag.particles
    p0, p1, p2 = particles[0], particles[1], particles[2]
    for q in range(0, particles.shape[1], lanes(drag.x)):
        xx, yy, zz, yz, zx, xy = _matrix(drag.coefficient, particles, drag.x, drag.u, q)
        _add(drag.along, p0, q, xx, yy, zz)
        _add(drag.along, p1, q, xx, yy, zz)
        _add(drag.along, p2, q, xx, yy, zz)
        _add(drag.across, p0, q, yz, zx, xy)
        _add(drag.across, p1, q, yz, zx, xy)
        _add(drag.across, p2, q, yz, zx, xy)


@jit
def _sum_by_particle(drag, gathered, team):
    """Do so on a GPU, in the same order for each particle."""
    begin, end, step = turns(team, drag.particles.shape[1])
    for q in range(begin, end, step):
        matrix = _matrix(drag.coefficient, drag.particles, drag.x, drag.u, q)
        for k in range(6):
            gathered.matrix[q, k] = highest(matrix[k])
    wait(team)
    begin, end, step = turns(team, drag.slots[1] - drag.slots[0])
    for each in range(begin, end, step):
        i = drag.slots[0] + each
        for n in range(gathered.first[i], gathered.first[i + 1]):
            for k in range(3):
                drag.along[i, k] += gathered.matrix[gathered.triangle[n], k]
                drag.across[i, k] += gathered.matrix[gathered.triangle[n], 3 + k]


@jit(inline=True)
def _matrix(coefficient, particles, x, u, q):
    """Return xx, yy, zz, yz, zx, xy of the matrices of triangles by lanes."""
    p0, p1, p2 = particles[0], particles[1], particles[2]
    x0, y0, z0, _ = load_records(x, p0, q)
    x1, y1, z1, _ = load_records(x, p1, q)
    x2, y2, z2, _ = load_records(x, p2, q)
    ax, ay, az = x1 - x0, y1 - y0, z1 - z0
    bx, by, bz = x2 - x0, y2 - y0, z2 - z0
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    twice = root(fma(nx, nx, fma(ny, ny, nz * nz)))
    there = twice > 0.0
    per = 1.0 / select(there, twice, 1.0)
    nx, ny, nz = nx * per, ny * per, nz * per
    u0, v0, w0, _ = load_records(u, p0, q)
    u1, v1, w1, _ = load_records(u, p1, q)
    u2, v2, w2, _ = load_records(u, p2, q)
    ux, uy, uz = (u0 + u1 + u2) / 3.0, (v0 + v1 + v2) / 3.0, (w0 + w1 + w2) / 3.0
    un = fma(ux, nx, fma(uy, ny, uz * nz))
    tx, ty, tz = ux - un * nx, uy - un * ny, uz - un * nz
    ct = coefficient[1] * twice * root(fma(tx, tx, fma(ty, ty, tz * tz)))
    cn = coefficient[0] * twice * larger(un, -un) - ct
    gx, gy, gz = cn * nx, cn * ny, cn * nz
    return (fma(gx, nx, ct), fma(gy, ny, ct), fma(gz, nz, ct), gy * nz, gz * nx, gx * ny)


@jit(inline=True)
def _add(records, index, start, a, b, c):
    x, y, z, m = load_records(records, index, start)
    store_records(records, index, start, x + a, y + b, z + c, m)


@jit(inline=True)
def _times(z, x, y, w):
    """Return Z (x, y, w) of a symmetric matrix Z, given as xx, yy, zz, yz, zx, xy."""
    return (z[0] * x + z[5] * y + z[4] * w, z[5] * x + z[1] * y + z[3] * w,
            z[4] * x + z[3] * y + z[2] * w)


@jit(inline=True)
def _change(drag, state, i, step):
    """Return Δv = Z u / max(1, trace Z) and trace Z."""
    s = step * state.inv_mass[i] * drag.share[i]
    a, b, u = drag.along[i], drag.across[i], drag.u[i]
    trace = s * (a[0] + a[1] + a[2])
    s /= max(1.0, trace)
    dx, dy, dz = _times((a[0], a[1], a[2], b[0], b[1], b[2]), u[0], u[1], u[2])
    return (s * dx, s * dy, s * dz), trace


@stage(react_to_half_kick, Drag)
@stage(accumulate_reactions, Drag)
@jit
def react_drag(drag, state, substep):
    """Force on pinned particles: D_i u_i."""
    part = substep.end - substep.begin
    for i in range(drag.slots[0], drag.slots[1]):
        if state.inv_mass[i] == 0.0:
            a, b, u, share = drag.along[i], drag.across[i], drag.u[i], part * drag.share[i]
            fx, fy, fz = _times((a[0], a[1], a[2], b[0], b[1], b[2]), u[0], u[1], u[2])
            state.reaction[0, i] += share * fx
            state.reaction[1, i] += share * fy
            state.reaction[2, i] += share * fz


def areas(mesh) -> np.ndarray:
    """Return the area of each particle's triangles at rest [m²], shape (particles,)."""
    area = triangle_areas(mesh.positions[mesh.triangles])
    return np.bincount(mesh.triangles.ravel(), np.repeat(area, 3), len(mesh.positions))


def shares(mesh) -> np.ndarray:
    """Return the fraction that each particle takes of its triangles, shape (particles,)."""
    total = areas(mesh)
    if mesh.grid is None:
        return np.full(len(total), 1.0 / 3.0)
    return np.divide(mesh.area, total, out=np.zeros(len(total)), where=total > 0.0)


class BuiltDrag(Built):
    """The triangles of all cloths."""

    ns_per_particle = 55.0

    def __init__(self, parameters, world):
        super().__init__()
        dtype, wind = world.state.x.dtype, world.built.get('wind')
        triangles = np.concatenate([cloth.slots[cloth.mesh.triangles] for cloth in world.cloths])
        order, share = pack(triangles), zeros(world.slots, dtype)
        area = np.zeros(world.slots)
        for cloth in world.cloths:
            share[cloth.slots] = shares(cloth.mesh)
            area[cloth.slots] = shares(cloth.mesh) * areas(cloth.mesh)
        particles = padded(triangles, order, world.slots - 1, np.int32).T.copy()
        self.data = Drag(
            None if wind is None else wind.data.now,
            parameters.density * np.array([0.25 * parameters.normal, 0.5 * parameters.tangential]),
            np.array([triangles.min(initial=0), triangles.max(initial=-1) + 1]),
            particles, share, area,
            zeros((3, world.slots), dtype) if world.explicit else None,
            gather_triangles(particles, world.slots, dtype) if world.on_device else None,
            *(new_records(world.slots, dtype) for _ in range(4)))
        self._wind = None if wind is None else wind.data
        self._parameters = parameters
        there = world.state.mass > 0.0
        self._area_per_mass = float((area[there] / world.state.mass[there]).max())
        """largest of a particle [m²/kg]"""
        self._speed = 0.0
        """largest speed of the scene's wind [m/s]"""
        if wind is not None:
            self._speed = sum(float(np.linalg.norm(velocity)) for velocity in (
                wind.parameters.velocity, wind.parameters.gust))

        self.pulls_taut = self._speed > 0.0

    def load(self, state):
        """Return bounds of the force of the wind, which still air does not have."""
        moving = self._wind
        if moving is None or not (moving.goal.any() or moving.start.any()):
            return 0.0, 0.0
        keys = self._parameters
        wind = max(np.linalg.norm(moving.start), np.linalg.norm(moving.goal))
        speed = float(wind + np.sqrt((state.v.astype(float)**2).sum(0).max()))
        pressure = 0.5 * keys.density * (keys.normal + 2.0 * keys.tangential) * speed**2
        return pressure * float(self.data.area.sum()), pressure * self._area_per_mass

    def least_substeps(self, frame_dt):
        """Return the substeps for trace Z ≤ RESOLVED at rest in the scene's wind."""
        keys = self._parameters
        grip = keys.density * self._speed * (0.5 * keys.normal + 2.0 * keys.tangential)
        return frame_dt * grip * self._area_per_mass / RESOLVED


EFFECT = Effect('drag', Parameters, BuiltDrag)
