"""
Shear: elastic edges along both diagonals of every cell, C = |x1 - x2| - L (``sim.distance``).

On cells of dx × dy with diagonals of length l, each has the stiffness
k = stiffness l² / (2 dx dy) [N/m], which gives the sheet the shear modulus C66 = stiffness and
adds as much to C12 (NUMERICS 2.7); on square cells k = stiffness.

Limits: it also adds stiffness (dx/dy)² to C11 and stiffness (dy/dx)² to C22.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim import distance
from xpbd_ros.sim.effect import Constraints, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.stages import prepare, project, react, stage


@dataclass(frozen=True)
class Parameters:
    """The shear modulus."""

    stiffness: float = quantity(unit='N/m', above=0.0, live=True, doc='shear modulus C66')


class Shear(NamedTuple):
    """Data of the kernels."""

    edges: distance.Distance


@stage(prepare, Shear)
@jit
def prepare_shear(shear, state, substep):
    """Zero the multipliers."""
    distance.release_forces(shear.edges)


@stage(project, Shear)
@jit
def project_shear(shear, state, substep):
    """One pass over all diagonals."""
    distance.project_edges(shear.edges, state, substep)


@stage(react, Shear)
@jit
def react_shear(shear, state, substep):
    """Forces on pinned particles."""
    distance.react_edges(shear.edges, state, substep)


def build(parameters, world) -> Constraints:
    """Lay out the rising diagonals of every cloth that shears, then the falling ones."""
    edges, rest, compliance = [], [], []
    for cloth, chosen in parameters.items():
        grid, (dx, dy) = cloth.grid, cloth.mesh.spacing
        square = dx * dx + dy * dy
        for start, end in ((grid[:-1, :-1], grid[1:, 1:]), (grid[:-1, 1:], grid[1:, :-1])):
            edges.append(np.column_stack([start.ravel(), end.ravel()]))
            rest.append(np.full(start.size, np.sqrt(square)))
            compliance.append(np.full(
                start.size,
                world.compliance_scale * 2.0 * dx * dy / (chosen.stiffness * square)))
    batch = distance.distance_batch(np.concatenate(edges), np.concatenate(rest),
                                    np.concatenate(compliance), len(world.state.x),
                                    pins=world.pins)
    return Constraints(Shear(batch), batch)


EFFECT = Effect(
    'shear', Parameters, build,
    residual=lambda data, x: distance.residual(data.edges, x),
    energy=lambda data, x: distance.energy(data.edges, x))
