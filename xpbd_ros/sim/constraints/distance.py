"""
Distance constraints: C = |x1 - x2| - L, for every effect with elastic edges.

Gradient: n = (x1 - x2) / |x1 - x2| at x1, -n at x2 (Müller et al. 2006, eq 10-11). In force form,
with f = λ / H² [N], mobilities m = w H² and W = m1 + m2,

    Δf = -(C + α f) / (W + α),   x1 += m1 n Δf,   x2 -= m2 n Δf

which is Macklin et al. 2016, eq 18 and 17, times H². α is in m/N; 0 is rigid. f < 0 is tension.
Where two particles coincide the gradient is undefined: they separate along a fixed axis, one for
each shape of edge, which conserves momentum and is deterministic.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, load, select
from xpbd_ros.sim.backend.simd_vector3 import vector3
from xpbd_ros.sim.constraints.builders import Packing, Rows
from xpbd_ros.sim.constraints.damping import (
    apart_before,
    damped,
    Damping,
    gamma_of,
    gammas_of,
    lag,
    records_before,
)
from xpbd_ros.sim.constraints.definitions import Constraints, isotropic
from xpbd_ros.sim.constraints.grid_batches import Runs
from xpbd_ros.sim.constraints.pinned_edges import edge_stops_for, EdgeStops, Held, room
from xpbd_ros.sim.constraints.projection import denominator, keep, recall, xpbd_residual
from xpbd_ros.sim.constraints.sweeps import projection
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.particles.memory_layout import Block

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class GridEdges(NamedTuple):
    """Elastic edges of grids, in runs (``constraints.grid_batches``)."""

    runs: Runs
    compliance: np.ndarray
    """[m/N], by shape of edge and place in a row, ABSENT where there is no edge; shape
    (shapes, places)"""
    force: np.ndarray | None
    """f, multiplier over H² [N], negative in tension, shape (families * slots,); None if
    multipliers are not kept"""
    stops: EdgeStops | None
    """None in a scene without pins"""
    rest_length: np.ndarray
    """[m], of each shape of edge, shape (shapes,)"""
    axis: np.ndarray
    """direction of coincident particles, of each shape of edge, shape (shapes, 3)"""
    damping: Damping | None
    """None in a scene without ``rayleigh``"""


class MeshEdges(NamedTuple):
    """Elastic edges of meshes, in packs (``constraints.mesh_batches``)."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots of both ends, shape (2, edges)"""
    force: np.ndarray | None
    """f [N], shape (edges,); None if multipliers are not kept"""
    held: Held | None
    """edges at pinned particles; None in a scene without pins"""
    colours: np.ndarray | None
    """first constraint of each colour, and the number of places, shape (colours + 1,); None in
    sequential order"""
    rest_length: np.ndarray
    """[m], shape (edges,)"""
    compliance: np.ndarray
    """[m/N], shape (edges,)"""
    damping: Damping | None
    """None in a scene without ``rayleigh``"""


@dataclass(eq=False)
class Edges(Constraints):
    """Edges one by one: the definition in NumPy."""

    rest_length: np.ndarray
    """[m], shape (edges,)"""

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C [m], shape (edges,); x: positions [m], (3, slots)."""
        i, j = self.particles.T
        return length((x[:, i] - x[:, j]).T.astype(float)) - self.rest_length

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """
        Return 2 Σ 1 / α at each particle, an upper bound of the stiffness K [N/m], (slots, 3, 3).

        The bound holds for any direction of the edges: warp and weft of a sheet that hangs from
        its corners can become parallel.
        """
        with np.errstate(divide='ignore'):
            return isotropic(x, self.particles.T, 2.0 / self.compliance)


def grid_edges(blocks: list[Block], shapes_of: Callable, rest_length: list, compliance: list, *,
               world, time: list | None = None) -> GridEdges:
    """
    Return the edges of grids for the kernels.

    Parameters
    ----------
    blocks, shapes_of : as of ``builders.Rows``
    rest_length : of each grid's shapes of edge [m]
    compliance : of each grid, by its shapes and places in a row [m/N], (shapes, places) or (…, 1)
    world : build context
    time : relaxation time of each grid [s]; None without ``rayleigh``

    """
    rows, dtype = Rows(blocks, shapes_of, world), world.state.x.dtype
    common = rows.common(compliance, stops=edge_stops_for)
    if time is not None:
        time = np.concatenate([np.full(len(a), t) for a, t in zip(rest_length, time)])
    return GridEdges(
        **common, rest_length=np.concatenate(rest_length).astype(dtype),
        axis=np.array([AXES[k % 3] for k in rows.families], dtype).reshape(-1, 3),
        damping=damping(world, time, (common['compliance'] == 0.0).any(1), dtype))


def mesh_edges(particles: list, rest_length: list, compliance: list, *, world,
               time: list | None = None, order: np.ndarray | None = None) -> MeshEdges:
    """
    Return the edges of meshes for the kernels.

    Parameters
    ----------
    particles : slots of each mesh's edges, shape (edges, 2)
    rest_length : of each mesh's edges [m], shape (edges,)
    compliance : of each mesh's edges [m/N], shape (edges,)
    world : build context
    time : relaxation time of each mesh [s]; None without ``rayleigh``
    order : as of ``builders.Packing``

    """
    packing, dtype = Packing(particles, world, order), world.state.x.dtype
    if time is not None:
        time = packing.column([np.full(len(a), t) for a, t in zip(particles, time)])
    return MeshEdges(
        **packing.common(room=room), rest_length=packing.column(rest_length),
        compliance=packing.compliance(compliance),
        damping=damping(world, time, packing.column(compliance, 1.0) == 0.0, dtype))


def damping(world, time, rigid: np.ndarray, dtype) -> Damping | None:
    """
    Return the damping of constraints with relaxation times [s]; None if there are none.

    Constraints where ``rigid`` is True are not damped.
    """
    if time is None:
        return None
    return Damping(world.built['rayleigh'].past, np.where(rigid, 0.0, time).astype(dtype))


def times(cloths: list, world) -> list[float] | None:
    """Return the relaxation times of (cloth, parameters) [s]; None without ``rayleigh``."""
    if 'rayleigh' not in world.built:
        return None
    return [world.built['rayleigh'].time(cloth) for cloth, _ in cloths]


@jit(inline=True)
def pull(apart, d, total, rest, alpha, f, there, axis, gamma, before):
    """
    Return s and d of a vector of edges, where d = x1 - x2 and n Δf = -s d, and Δf.

    The form needs one division, s = (C + α f) / (|d| (W + α)).

    Parameters
    ----------
    apart : accumulator of the method or None
    d : x1 - x2 [m]
    total : W [m/N]
    rest, alpha, f : L [m], α [m/N] and f [N] (None: 0)
    there : lanes that hold an edge
    axis : direction of coincident particles (x, y, z)
    gamma, before : γ and x̄1 - x̄2 of damping (``constraints.damping``), or None

    """
    l = length(d)
    far = l > 0.0
    l_or_1 = select(far, l, 1.0)
    wrong = lag(xpbd_residual(l - rest, alpha, f), gamma, before, d, l_or_1)
    s = select(both(total > 0.0, there),
               wrong / (l_or_1 * denominator(apart, damped(total, gamma), alpha)), 0.0)
    return s, vector3(select(far, d.x, axis[0]), select(far, d.y, axis[1]),
                      select(far, d.z, axis[2])), -(s * l_or_1)


@jit(inline=True)
def _of_shape(edges, shape):
    axis = edges.axis
    return (edges.rest_length[shape], (axis[shape, 0], axis[shape, 1], axis[shape, 2]),
            gamma_of(edges.damping, shape))


@projection(GridEdges, particles=2, constants=_of_shape)
@jit(inline=True)
def solve_grid_edges(edges, apart, at, x, m):
    """Solve a vector of edges of one shape."""
    rest, axis, gamma = at.constants
    alpha, f = load(edges.compliance, at.number), recall(apart, edges.force, at.c)
    s, d, df = pull(apart, x[0] - x[1], m[0] + m[1], rest, alpha, f,
                    both(alpha >= 0.0, at.there), axis, gamma,
                    apart_before(edges.damping, at.slots[0], at.slots[1]))
    keep(edges.force, at.c, f, df)
    return (-s, d), (s, d)


@projection(MeshEdges, particles=2)
@jit(inline=True)
def solve_mesh_edges(edges, apart, c, x, m):
    """Solve a vector of edges from index c on."""
    alpha, f = load(edges.compliance, c), recall(apart, edges.force, c)
    s, d, df = pull(apart, x[0] - x[1], m[0] + m[1], load(edges.rest_length, c), alpha, f,
                    alpha >= 0.0, (1.0, 0.0, 0.0), gammas_of(edges.damping, c),
                    records_before(edges.damping, edges.particles, c))
    keep(edges.force, c, f, df)
    return (-s, d), (s, d)
