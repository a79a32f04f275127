"""
Shear: in-plane shear stiffness of grids, by the diagonals of their cells.

Square cells have elastic diagonals: C = |x1 - x2| - L (``constraints.distance``). On cells of
dx × dy with diagonals of length l, each has the stiffness k = stiffness l² / (2 dx dy) [N/m]. This
gives the sheet the shear modulus C66 = stiffness and adds the same to C11, C22 and C12
(doc/numerics.md 5.2).

On oblong cells such edges would add stiffness (dx/dy)² to C11 and stiffness (dy/dx)² to C22, up to
many times the warp modulus of a soft knit. There each cell has one constraint instead, the
difference of its diagonals (``constraints.shear_cells``), with α = 4 dx dy / (stiffness l²). It
gives C66 = stiffness for any cell, and adds nothing to C11, C22 and C12. A cell is square if its
sides differ by no more than a thousandth (``geometry.mesh``).

Limits: Poisson's ratio follows from C12: stiffness / (weft + stiffness) on square cells, 0 on
oblong ones. Meshes have no diagonals; their edges resist shear as they stretch.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.constraints import distance, shear_cells
from xpbd_ros.sim.constraints.grid_batches import grid_runs, join, Shape
from xpbd_ros.sim.constraints.shear_cells import Slant
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.geometry.mesh import is_square
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.stepping.constraint_stages import constraint, elastic_edges
from xpbd_ros.sim.stepping.stages import accumulate_reactions, stage


@dataclass(frozen=True)
class Parameters:
    """The shear modulus."""

    stiffness: float = quantity(unit='N/m', above=0.0, live=True, doc='shear modulus C66')


@elastic_edges
class Shear(NamedTuple):
    """Data of the kernels for square cells."""

    edges: distance.GridEdges


constraint(Slant, particles=4)(shear_cells.solve_slants)
stage(accumulate_reactions, Slant)(shear_cells.react_slants)


def _on_square_cells(cloths, world) -> Shear:
    """Return the rising and the falling diagonals of square cells."""
    runs, rest, alpha, time = [], [], [], []
    for number, (cloth, chosen) in enumerate(cloths):
        block, (dx, dy) = cloth.block, cloth.mesh.spacing
        rows, columns = range(block.rows)[:-1], range(block.columns)[:-1]
        runs.append(grid_runs(block, [Shape(((0, 0), (1, 1)), rows, columns, 0),
                                      Shape(((0, 1), (1, 0)), rows, columns, 1)],
                              world.slots, families=2 * number, shapes_before=2 * number))
        square = dx * dx + dy * dy
        rest += [np.sqrt(square)] * 2
        time += [distance.relaxation(world, cloth)] * 2
        alpha.append(np.full((2, 1), world.compliance_scale * 2.0 * dx * dy
                             / (chosen.stiffness * square)))
    return Shear(distance.grid_edges(join(runs), range(len(rest)), rest, alpha, world=world,
                                     time=distance.times(time)))


def _on_oblong_cells(cloths, world) -> Slant:
    """Return the oblong cells."""
    runs, alpha, time = [], [], []
    for number, (cloth, chosen) in enumerate(cloths):
        block, (dx, dy) = cloth.block, cloth.mesh.spacing
        shape = shear_cells.slant_shape(block.rows, block.columns)
        runs.append(grid_runs(block, [shape], world.slots, families=number,
                              shapes_before=number))
        time.append(distance.relaxation(world, cloth))
        with np.errstate(over='ignore'):
            alpha.append(np.full((1, 1), world.compliance_scale * 4.0 * dx * dy
                                 / (chosen.stiffness * (dx * dx + dy * dy))))
    return shear_cells.slants(join(runs), alpha, world=world, time=distance.times(time))


class BuiltShear(Built):
    """The cells of all cloths with this effect, square and oblong."""

    def __init__(self, parameters, world):
        super().__init__()
        for cloth in parameters:
            if cloth.mesh.grid is None:
                raise InputError(f'cloths.{cloth.name}.effects.shear: a mesh has no diagonals; '
                                 'its edges resist shear as they stretch, and membrane takes '
                                 'moduli')
        parts = []
        for make, square in ((_on_square_cells, True), (_on_oblong_cells, False)):
            cloths = [(cloth, chosen) for cloth, chosen in parameters.items()
                      if is_square(cloth.mesh.spacing) == square]
            if cloths:
                parts.append(make(cloths, world))
        self.data, *self.also = parts
        self.lists = [shear_cells.Slants.of(part) if isinstance(part, Slant)
                      else distance.Edges.of(part.edges) for part in parts]
        self.constraints = shear_cells.Slants.joined(self.lists)
        self.cells = [these for these in self.lists if isinstance(these, shear_cells.Slants)]



EFFECT = Effect('shear', Parameters, BuiltShear)
