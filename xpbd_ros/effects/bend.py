"""
Bend: isometric bending of each hinge as one linear vector constraint.

For the hinge (x0, x1) with opposite particles x2, x3 and rest areas A0, A1,

    C = Σ K_i x_i / sqrt(A0 + A1)  in R³,   K = (c03+c04, c01+c02, -c01-c03, -c02-c04),

with c01 = cot(e, x2-x0), c02 = cot(e, x3-x0), c03 = cot(-e, x2-x1), c04 = cot(-e, x3-x1) at rest
(Bergou et al. 2006; K x = 2 |e| sin(θ/2) for a hinge of dihedral angle θ). The energy is
B |C|² / 2, so α = 1 / B [1/(N m)]. The gradient is constant: no singularity, no wrap at 180°. In
force form, with W = Σ w_i K_i² h² / (A0 + A1) and a 3-vector f = λ / h²,

    Δf = -(C + α f) / (W + α),   x_i += w_i h² K_i Δf / sqrt(A0 + A1).

The diagonals of a grid count half, which makes the sheet's bending stiffness the same about both
axes (NUMERICS 2.5).

Limits: a flat rest shape, deformations that keep lengths.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.batch import colour_order, SOFTEST
from xpbd_ros.sim.effect import Constraints, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.mesh import cross, dot, hinges, length
from xpbd_ros.sim.stages import prepare, project, react, stage


@dataclass(frozen=True)
class Parameters:
    """The bending rigidity."""

    stiffness: float = quantity(unit='N m', above=0.0, live=True, doc='bending rigidity B')


class Bend(NamedTuple):
    """Data of the kernels: hinges sorted by colour."""

    particles: np.ndarray
    """edge start, edge end, opposite, opposite; shape (hinges, 4)"""
    weight: np.ndarray
    """K_i / sqrt(A0 + A1) [1/m], shape (hinges, 4)"""
    compliance: np.ndarray
    """1 / B [1/(N m)], shape (hinges,)"""
    force: np.ndarray
    """multiplier over h² [N m], shape (hinges, 3)"""
    held: np.ndarray
    """count and list of the hinges at a pinned particle, shape (hinges + 1,)"""
    colours: np.ndarray
    """where each colour starts, and the end"""


@stage(prepare, Bend)
@jit
def prepare_bend(bend, state, substep):
    """Zero the multipliers."""
    for c in range(len(bend.force)):
        for k in range(3):
            bend.force[c, k] = 0.0


@stage(project, Bend)
@jit
def project_bend(bend, state, substep):
    """One Gauss-Seidel pass over all hinges, colour after colour."""
    x, w, h2 = state.x, state.inv_mass, substep.h * substep.h
    for c in range(len(bend.force)):
        hinge, weight = bend.particles[c], bend.weight[c]
        i0, i1, i2, i3 = hinge[0], hinge[1], hinge[2], hinge[3]
        k0, k1, k2, k3 = weight[0], weight[1], weight[2], weight[3]
        w0, w1, w2, w3 = w[i0] * h2 * k0, w[i1] * h2 * k1, w[i2] * h2 * k2, w[i3] * h2 * k3
        alpha = bend.compliance[c]
        total = w0 * k0 + w1 * k1 + w2 * k2 + w3 * k3
        if total == 0.0:
            continue
        for k in range(3):
            residual = k0 * x[i0, k] + k1 * x[i1, k] + k2 * x[i2, k] + k3 * x[i3, k]
            df = -(residual + alpha * bend.force[c, k]) / (total + alpha)
            bend.force[c, k] += df
            x[i0, k] += w0 * df
            x[i1, k] += w1 * df
            x[i2, k] += w2 * df
            x[i3, k] += w3 * df


@stage(react, Bend)
@jit
def react_bend(bend, state, substep):
    """Forces on pinned particles: K_i f / sqrt(A0 + A1)."""
    part = substep.end - substep.begin
    for q in range(1, bend.held[0] + 1):
        c = bend.held[q]
        for p in range(4):
            i = bend.particles[c, p]
            for k in range(3):
                state.reaction[i, k] += part * bend.weight[c, p] * bend.force[c, k]


def build(parameters, world) -> Constraints:
    """Find the hinges of every cloth that bends."""
    particles, weight, compliance = [], [], []
    for cloth, chosen in parameters.items():
        hinge = hinges(cloth.mesh.triangles)
        particles.append(hinge + cloth.first)
        weight.append(isometric_weights(cloth.mesh, hinge))
        alpha = min(world.compliance_scale / chosen.stiffness, SOFTEST)
        compliance.append(np.full(len(hinge), alpha))
    particles = np.concatenate(particles)
    order, colours = colour_order(particles, len(world.state.x))
    data = Bend(np.ascontiguousarray(particles[order], np.int64),
                np.ascontiguousarray(np.concatenate(weight)[order]),
                np.concatenate(compliance)[order], np.zeros((len(order), 3)),
                np.zeros(len(order) + 1 if world.pins else 1, np.int64), colours)
    return Constraints(data, data)


def isometric_weights(mesh, hinge: np.ndarray) -> np.ndarray:
    """Return K_i / sqrt(A0 + A1) [1/m], shape (hinges, 4), with half weight on diagonals."""
    x0, x1, x2, x3 = (mesh.positions[hinge[:, k]] for k in range(4))
    e = x1 - x0

    def cot(u, v):
        return dot(u, v) / length(cross(u, v))

    c01, c02, c03, c04 = cot(e, x2 - x0), cot(e, x3 - x0), cot(-e, x2 - x1), cot(-e, x3 - x1)
    area = 0.5 * (length(cross(e, x2 - x0)) + length(cross(e, x3 - x0)))
    diagonal = (np.abs(e[:, 0]) > 0.0) & (np.abs(e[:, 1]) > 0.0)
    scale = np.sqrt(np.where(diagonal, 0.5, 1.0) / area)
    return np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], 1) * scale[:, None]


def residual(data: Bend, x: np.ndarray) -> np.ndarray:
    """Return C, shape (hinges, 3), straight from the definition."""
    return (data.weight[:, :, None] * x[data.particles]).sum(1)


def energy(data: Bend, x: np.ndarray) -> float:
    """Return Σ B |C|² / 2 [J]."""
    return float((0.5 * residual(data, x)**2 / data.compliance[:, None]).sum())


EFFECT = Effect('bend', Parameters, build, residual=residual, energy=energy)
