"""
Strain limit: no edge is ever longer than a given part more than at rest.

C = |x1 - x2| - L (1 + max) ≤ 0, gradient n = (x1 - x2) / |x1 - x2| at x1 and -n at x2, α = 0: an
edge that is too long is put back,

    Δf = -C / (m1 + m2) where C > 0,   x1 += m1 n Δf,   x2 -= m2 n Δf,

with mobilities m = w H² (Provot 1995; NUMERICS 2.12). It comes last in each iteration, after all
that is elastic and before contact. Edges are those along warp and weft of a grid, and all of any
other mesh.

Limits: it takes energy away, as an inelastic stop does. A pass mends an edge after another, so a
net of them holds better with more substeps. Shear of a grid's cells is not limited.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.layout import zeros
from xpbd_ros.sim.mesh import length
from xpbd_ros.sim.packs import pack, padded
from xpbd_ros.sim.records import load_records, store_records, to_positions, to_records
from xpbd_ros.sim.stages import prepare, react, stage, touch
from xpbd_ros.sim.update import release_forces
from xpbd_ros.sim.vector import both, fma, lanes, load, root, select, store


@dataclass(frozen=True)
class Parameters:
    """The limit."""

    max: float = quantity(0.1, minimum=0.0, live=True,
                          doc='largest strain; 0.1 is ten per cent')


class StrainLimit(NamedTuple):
    """Data of the kernels: edges in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots of both ends, shape (2, edges)"""
    longest: np.ndarray
    """L (1 + max) [m], shape (edges,)"""
    force: np.ndarray | None
    """f [N], negative in tension, shape (edges,); None in a scene without pins"""


@stage(prepare, StrainLimit)
@jit
def prepare_limit(limit, state, substep):
    """Zero the forces."""
    release_forces(None, limit.force)


@stage(touch, StrainLimit)
@jit
def limit_strain(limit, state, substep):
    """Put edges that are too long back, pack after pack."""
    to_records(state, limit.records, limit.slots[0], limit.slots[1])
    _put_back(limit.records, limit.particles[0], limit.particles[1], limit.longest, limit.force)
    to_positions(state, limit.records, limit.slots[0], limit.slots[1])


@jit
def _put_back(records, i, j, longest, force):
    for q in range(0, len(longest), lanes(longest)):
        xi, yi, zi, mi = load_records(records, i, q)
        xj, yj, zj, mj = load_records(records, j, q)
        dx, dy, dz, total, most = xi - xj, yi - yj, zi - zj, mi + mj, load(longest, q)
        l = root(fma(dx, dx, fma(dy, dy, dz * dz)))
        long = both(l > most, total > 0.0)
        df = select(long, (most - l) / select(long, total, 1.0), 0.0)
        g = df / select(long, l, 1.0)
        gi, gj = g * mi, -g * mj
        store_records(records, i, q, fma(gi, dx, xi), fma(gi, dy, yi), fma(gi, dz, zi), mi)
        store_records(records, j, q, fma(gj, dx, xj), fma(gj, dy, yj), fma(gj, dz, zj), mj)
        _note(force, q, df)


@jit(inline=True)
def _note(force, q, df):
    if force is not None:
        store(force, q, load(force, q) + df)


@stage(react, StrainLimit)
@jit
def react_limit(limit, state, substep):
    """Force on pinned particles: f n."""
    part, x = substep.end - substep.begin, state.x
    for c in range(len(limit.longest)):
        i, j, f = limit.particles[0, c], limit.particles[1, c], limit.force[c]
        if f != 0.0 and (state.inv_mass[i] == 0.0 or state.inv_mass[j] == 0.0):
            dx, dy, dz = x[0, i] - x[0, j], x[1, i] - x[1, j], x[2, i] - x[2, j]
            f *= part / np.sqrt(dx * dx + dy * dy + dz * dz)
            for k, d in enumerate((dx, dy, dz)):
                state.reaction[k, i] += f * d
                state.reaction[k, j] -= f * d


def limited_edges(mesh) -> np.ndarray:
    """Return the edges along warp and weft of a grid, or all edges; shape (edges, 2)."""
    if mesh.grid is None:
        return mesh.edges
    grid = mesh.grid
    return np.concatenate([np.stack([grid[:, :-1], grid[:, 1:]], -1).reshape(-1, 2),
                           np.stack([grid[:-1], grid[1:]], -1).reshape(-1, 2)])


class BuiltStrainLimit(Built):
    """The edges of every cloth that has a limit."""

    not_with = ('ndf2',)    # it damps too little for what sets in and lets go at once

    def __init__(self, parameters, world):
        super().__init__()
        particles, longest = [], []
        for cloth, chosen in parameters.items():
            edges, x = limited_edges(cloth.mesh), cloth.mesh.positions
            particles.append(cloth.slots[edges])
            longest.append((1.0 + chosen.max) * length(x[edges[:, 0]] - x[edges[:, 1]]))
        particles, longest = np.concatenate(particles), np.concatenate(longest)
        order, dtype = pack(particles), world.state.x.dtype
        self.data = StrainLimit(
            world.records,
            np.array([particles.min(initial=0), particles.max(initial=-1) + 1]),
            padded(particles, order, world.slots - 1, np.int32).T.copy(),
            padded(longest, order, 1.0, dtype),
            zeros(len(order), dtype) if world.pins else None)


EFFECT = Effect('strain_limit', Parameters, BuiltStrainLimit)
