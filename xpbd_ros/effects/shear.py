"""
Shear: elastic edges along both diagonals of every cell.

C = |x1 - x2| - L (``sim.distance``).

On cells of dx × dy with diagonals of length l, each has the stiffness
k = stiffness l² / (2 dx dy) [N/m], which gives the sheet the shear modulus C66 = stiffness and
adds as much to C12 (NUMERICS 2.7); on square cells k = stiffness.

Limits: it also adds stiffness (dx/dy)² to C11 and stiffness (dy/dx)² to C22.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim import distance
from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.held import hold
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.runs import grid_runs, join, Shape
from xpbd_ros.sim.stages import prepare, project, project_back, react, stage
from xpbd_ros.sim.update import release_forces


@dataclass(frozen=True)
class Parameters:
    """The shear modulus."""

    stiffness: float = quantity(unit='N/m', above=0.0, live=True, doc='shear modulus C66')


class Shear(NamedTuple):
    """Data of the kernels."""

    edges: distance.GridEdges


@stage(prepare, Shear)
@jit
def prepare_shear(shear, state, substep):
    """Zero the multipliers."""
    release_forces(state.apart, shear.edges.force)


@stage(project, Shear, shared=True)
@jit
def project_shear(shear, state, substep):
    """One pass over all diagonals."""
    distance.project_edges(shear.edges, state, False)


@stage(project_back, Shear, shared=True)
@jit
def project_shear_back(shear, state, substep):
    """Do the same pass in reverse."""
    distance.project_edges(shear.edges, state, True)


@stage(react, Shear)
@jit
def react_shear(shear, state, substep):
    """Forces on pinned particles."""
    distance.react_edges(shear.edges, state, substep)


class BuiltShear(Built):
    """The rising and the falling diagonals of every cloth that shears."""

    def __init__(self, parameters, world):
        super().__init__()
        runs, rest, alpha, time = [], [], [], []
        for number, (cloth, chosen) in enumerate(parameters.items()):
            if cloth.mesh.grid is None:
                raise InputError(f'cloths.{cloth.name}.effects.shear: a mesh has no diagonals; '
                                 'its edges resist shear as they stretch, and membrane takes '
                                 'moduli')
            block, (dx, dy) = cloth.block, cloth.mesh.spacing
            rows, columns = range(block.rows)[:-1], range(block.columns)[:-1]
            runs.append(grid_runs(block, [Shape(((0, 0), (1, 1)), rows, columns, 0),
                                          Shape(((0, 1), (1, 0)), rows, columns, 1)],
                                  world.slots, families=2 * number,
                                  shapes_before=2 * number))
            square = dx * dx + dy * dy
            rest += [np.sqrt(square)] * 2
            time += [distance.relaxation(world, cloth)] * 2
            alpha.append(np.full((2, 1), world.compliance_scale * 2.0 * dx * dy
                                 / (chosen.stiffness * square)))
        self.data = Shear(distance.grid_edges(join(runs), range(len(rest)), rest, alpha,
                                              world=world, time=distance.times(time)))
        self.constraints = distance.Edges.of(self.data.edges)

    def hold(self, inv_mass):
        hold(self.data.edges.held, self.constraints, inv_mass)


EFFECT = Effect('shear', Parameters, BuiltShear)
