"""
Distance constraints: C = |x1 - x2| - L, the physics of every effect that is an elastic edge.

Gradient: n = (x1 - x2) / |x1 - x2| at x1, -n at x2 (Müller et al. 2006, eq 10-11). In force form:
with f = λ / h² [N] and W = (w1 + w2) h²,

    Δf = -(C + α f) / (W + α),   x1 += w1 h² n Δf,   x2 -= w2 h² n Δf

which is Macklin et al. 2016, eq 18 and 17, times h². α is in m/N; 0 is rigid. f < 0 is tension.
Where two particles coincide the gradient is undefined: they part along an axis picked by the
constraint's index, which keeps momentum and is the same in every run.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.batch import colour_order, SOFTEST
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.mesh import length


class Distance(NamedTuple):
    """A batch of elastic edges, sorted by colour."""

    particles: np.ndarray
    """shape (edges, 2)"""
    rest_length: np.ndarray
    """[m], shape (edges,)"""
    compliance: np.ndarray
    """[m/N], shape (edges,)"""
    force: np.ndarray
    """multiplier over h² [N], negative in tension, shape (edges,)"""
    held: np.ndarray
    """count and list of the edges at a pinned particle, shape (edges + 1,); (1,) without pins"""
    colours: np.ndarray
    """where each colour starts, and the end, shape (colours + 1,)"""


def distance_batch(particles, rest_length, compliance, particle_count: int, *,
                   pins: bool) -> Distance:
    """Sort edges by colour and give each its multiplier."""
    particles = np.asarray(particles, np.int64).reshape(-1, 2)
    order, colours = colour_order(particles, particle_count)
    compliance = np.minimum(np.asarray(compliance, float), SOFTEST)
    return Distance(np.ascontiguousarray(particles[order]), np.asarray(rest_length, float)[order],
                    compliance[order], np.zeros(len(order)),
                    np.zeros(len(order) + 1 if pins else 1, np.int64), colours)


@jit
def release_forces(edges):
    """Zero the multipliers: once per substep, never per iteration (algorithm 1, line 4)."""
    for c in range(len(edges.force)):
        edges.force[c] = 0.0


@jit
def direction(x, i, j, c):
    """Return the unit vector from j to i, and their distance; an axis where they coincide."""
    dx = x[i, 0] - x[j, 0]
    dy = x[i, 1] - x[j, 1]
    dz = x[i, 2] - x[j, 2]
    l = np.sqrt(dx * dx + dy * dy + dz * dz)
    if l > 0.0:
        return dx / l, dy / l, dz / l, l
    return (1.0, 0.0, 0.0, 0.0) if c % 3 == 0 else (
        (0.0, 1.0, 0.0, 0.0) if c % 3 == 1 else (0.0, 0.0, 1.0, 0.0))


@jit
def project_edges(edges, state, substep):
    """One Gauss-Seidel pass over all edges, colour after colour."""
    x, w, h2 = state.x, state.inv_mass, substep.h * substep.h
    for c in range(len(edges.force)):
        i, j = edges.particles[c, 0], edges.particles[c, 1]
        alpha = edges.compliance[c]
        wi, wj = w[i] * h2, w[j] * h2
        if wi + wj == 0.0:
            continue
        nx, ny, nz, l = direction(x, i, j, c)
        df = -(l - edges.rest_length[c] + alpha * edges.force[c]) / (wi + wj + alpha)
        edges.force[c] += df
        x[i, 0] += wi * df * nx
        x[i, 1] += wi * df * ny
        x[i, 2] += wi * df * nz
        x[j, 0] -= wj * df * nx
        x[j, 1] -= wj * df * ny
        x[j, 2] -= wj * df * nz


@jit
def react_edges(edges, state, substep):
    """Force on a pinned particle: f n; an edge between two pinned ones pulls with -C / α."""
    weight = substep.end - substep.begin
    for k in range(1, edges.held[0] + 1):
        c = edges.held[k]
        i, j = edges.particles[c, 0], edges.particles[c, 1]
        nx, ny, nz, l = direction(state.x, i, j, c)
        f = edges.force[c]
        if state.inv_mass[i] + state.inv_mass[j] == 0.0 and edges.compliance[c] > 0.0:
            f = -(l - edges.rest_length[c]) / edges.compliance[c]
        f *= weight
        state.reaction[i, 0] += f * nx
        state.reaction[i, 1] += f * ny
        state.reaction[i, 2] += f * nz
        state.reaction[j, 0] -= f * nx
        state.reaction[j, 1] -= f * ny
        state.reaction[j, 2] -= f * nz


def residual(edges: Distance, x: np.ndarray) -> np.ndarray:
    """Return C [m], shape (edges,), straight from the definition."""
    i, j = edges.particles.T
    return length(x[i] - x[j]) - edges.rest_length


def energy(edges: Distance, x: np.ndarray) -> float:
    """Return Σ C² / (2 α) [J]; a rigid edge stores none."""
    elastic = edges.compliance > 0.0
    return float((0.5 * residual(edges, x)[elastic]**2 / edges.compliance[elastic]).sum())
