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
from math import inf
from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.constraints import distance, shear_cells
from xpbd_ros.sim.constraints.grid_batches import Shape
from xpbd_ros.sim.constraints.shear_cells import Slant
from xpbd_ros.sim.effect import Built, by_kind, Effect
from xpbd_ros.sim.geometry.mesh import is_square, Mesh
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.stepping.constraint_stages import constraint, elastic_edges
from xpbd_ros.sim.stepping.stages import accumulate_reactions, react_to_half_kick, stage


@dataclass(frozen=True)
class Parameters:
    """The shear modulus."""

    stiffness: float = quantity(unit='N/m', above=0.0, live=True, doc='shear modulus C66')


@elastic_edges
class Shear(NamedTuple):
    """Data of the kernels for square cells."""

    edges: distance.GridEdges
    rate: float
    """of all shear, as ``Built.rate``"""


constraint(Slant, particles=4)(shear_cells.solve_slants)
stage(accumulate_reactions, Slant)(shear_cells.react_slants)
stage(react_to_half_kick, Slant)(shear_cells.react_slants)


def has_square_cells(mesh: Mesh) -> bool:
    """Return True for a grid whose cells are square."""
    return mesh.spacing is not None and is_square(mesh.spacing)


def diagonals(rows: int, columns: int) -> list[Shape]:
    """Return the shapes of the rising and the falling diagonals of cells."""
    return [Shape(((0, 0), (1, 1)), range(rows - 1), range(columns - 1), 0),
            Shape(((0, 1), (1, 0)), range(rows - 1), range(columns - 1), 1)]


def _on_square_cells(cloths, world) -> Shear:
    """Return the diagonals of square cells."""
    rest, alpha = [], []
    for cloth, chosen in cloths:
        dx, dy = cloth.mesh.spacing
        square = dx * dx + dy * dy
        rest.append([np.sqrt(square)] * 2)
        alpha.append(np.full((2, 1), world.compliance_scale * 2.0 * dx * dy
                             / (chosen.stiffness * square)))
    return Shear(distance.grid_edges([cloth.block for cloth, _ in cloths], diagonals, rest, alpha,
                                     world=world, time=distance.times(cloths, world)), inf)


def _on_oblong_cells(cloths, world) -> Slant:
    """Return the oblong cells."""
    alpha = []
    for cloth, chosen in cloths:
        dx, dy = cloth.mesh.spacing
        with np.errstate(over='ignore'):
            alpha.append(np.full((1, 1), world.compliance_scale * 4.0 * dx * dy
                                 / (chosen.stiffness * (dx * dx + dy * dy))))
    return shear_cells.slants([cloth.block for cloth, _ in cloths], alpha, world=world,
                              time=distance.times(cloths, world))


class BuiltShear(Built):
    """The cells of all cloths with this effect, square and oblong."""

    def __init__(self, parameters, world):
        super().__init__()
        for cloth in parameters:
            if cloth.mesh.grid is None:
                raise InputError(f'cloths.{cloth.name}.effects.shear: a mesh has no diagonals; '
                                 'its edges resist shear as they stretch, and membrane takes '
                                 'moduli')
        parts: list[Any] = [make(cloths, world) for make, cloths in zip(
            (_on_square_cells, _on_oblong_cells),
            by_kind(parameters, has_square_cells)) if cloths]
        self.lists = [shear_cells.Slants.of(part) if isinstance(part, Slant)
                      else distance.Edges.of(part.edges) for part in parts]
        # A diagonal acts along one of the two directions in the plane: the mean over these.
        self.rate = 0.5 * max(these.rate(world.state.mass) for these in self.lists)
        self.data, *self.also = [part._replace(rate=self.rate) for part in parts]
        self.constraints = shear_cells.Slants.joined(self.lists)
        self.cells = [these for these in self.lists if isinstance(these, shear_cells.Slants)]



EFFECT = Effect('shear', Parameters, BuiltShear)
