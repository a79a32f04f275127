"""
Stretch: elastic edges along warp and weft.

C = |x1 - x2| - L (``sim.distance``); the method ``line`` solves whole lines (``sim.lines``).

On cells of dx × dy an edge along warp has the stiffness k = warp dy / dx [N/m], one along weft
k = weft dx / dy, and half of it at the rim, so that the sheet has the moduli asked for whatever
its resolution (Van Gelder 1998 for lattices; NUMERICS 2.7). With ``shear`` the lattice has
C11 = warp + shear on square cells. Instead of moduli, ``compliance`` [m/N] sets every edge alike;
0 is rigid.

Limits: a lattice, so Poisson's ratio is not free. Fewer substeps than the wave needs to cross an
edge make it softer than asked.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim import distance, lines
from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.runs import grid_runs, join, Shape
from xpbd_ros.sim.stages import prepare, project, project_back, react, solve_lines, stage


@dataclass(frozen=True)
class Parameters:
    """Either the two moduli, or a compliance."""

    warp: float | None = quantity(None, unit='N/m', above=0.0, live=True,
                                  doc='modulus along warp')
    weft: float | None = quantity(None, unit='N/m', above=0.0, live=True,
                                  doc='modulus along weft')
    compliance: float | None = quantity(None, unit='m/N', minimum=0.0, live=True,
                                        doc='of every edge alike; 0 is rigid')

    def __post_init__(self):
        """Refuse both and neither."""
        if (self.compliance is None) == (self.warp is None and self.weft is None):
            raise InputError('needs either warp and weft (N/m) or compliance (m/N), not both')
        if self.compliance is None and (self.warp is None or self.weft is None):
            raise InputError('needs warp and weft (N/m), and only one of them is given')


class Stretch(NamedTuple):
    """Data of the kernels."""

    edges: distance.Distance
    lines: lines.Lines


@stage(prepare, Stretch)
@jit
def prepare_stretch(stretch, state, substep):
    """Zero the multipliers."""
    distance.release_forces(stretch.edges)


@stage(project, Stretch)
@jit
def project_stretch(stretch, state, substep):
    """One pass over all edges."""
    distance.project_edges(stretch.edges, state, False)


@stage(project_back, Stretch)
@jit
def project_stretch_back(stretch, state, substep):
    """Do the same pass in reverse."""
    distance.project_edges(stretch.edges, state, True)


@stage(solve_lines, Stretch)
@jit
def solve_stretch(stretch, state, substep):
    """Solve every warp line, then every weft line."""
    lines.solve_edges(stretch.edges, stretch.lines, state)


@stage(react, Stretch)
@jit
def react_stretch(stretch, state, substep):
    """Forces on pinned particles."""
    distance.react_edges(stretch.edges, state, substep)


class BuiltStretch(Built):
    """The edges of every cloth that stretches, warp then weft."""

    def __init__(self, parameters, world):
        super().__init__()
        runs, rest, compliance = [], [], []
        for number, (cloth, chosen) in enumerate(parameters.items()):
            block, (dx, dy) = cloth.block, cloth.mesh.spacing
            rows, columns = range(block.rows), range(block.columns)
            runs.append(grid_runs(block, [Shape(((0, 0), (0, 1)), rows, columns[:-1], 0),
                                          Shape(((0, 0), (1, 0)), rows[:-1], columns, 1)],
                                  world.slots, families=2 * number,
                                  shapes_before=2 * number))
            for modulus, along, across, axis in ((chosen.warp, dx, dy, 0),
                                                 (chosen.weft, dy, dx, 1)):
                width = np.full((block.rows, block.columns), across)
                rim = width if axis == 0 else width.T
                if len(rim) > 1:
                    rim[[0, -1]] *= 0.5
                alpha = (np.full(width.shape, chosen.compliance)
                         if chosen.compliance is not None else along / (modulus * width))
                rest.append(np.zeros(world.slots))
                compliance.append(np.zeros(world.slots))
                rest[-1][block.slots] = along
                compliance[-1][block.slots] = alpha * world.compliance_scale
        batch = distance.distance_batch(join(runs), np.array(rest), np.array(compliance),
                                        pins=world.pins, dtype=world.state.x.dtype)
        self.data = Stretch(batch, lines.grid_lines([c.block for c in parameters], world.slots,
                                                    world.state.x.dtype))
        self.constraints = distance.Edges(batch)

    def hold(self, inv_mass):
        distance.hold(self.data.edges.held, self.constraints, inv_mass)


EFFECT = Effect('stretch', Parameters, BuiltStretch)
