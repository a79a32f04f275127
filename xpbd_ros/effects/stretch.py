"""
Stretch: elastic edges along warp and weft, C = |x1 - x2| - L (``sim.distance``).

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
from xpbd_ros.sim import distance
from xpbd_ros.sim.effect import Constraints, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.mesh import length
from xpbd_ros.sim.stages import prepare, project, react, stage


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


@stage(prepare, Stretch)
@jit
def prepare_stretch(stretch, state, substep):
    """Zero the multipliers."""
    distance.release_forces(stretch.edges)


@stage(project, Stretch)
@jit
def project_stretch(stretch, state, substep):
    """One pass over all edges."""
    distance.project_edges(stretch.edges, state, substep)


@stage(react, Stretch)
@jit
def react_stretch(stretch, state, substep):
    """Forces on pinned particles."""
    distance.react_edges(stretch.edges, state, substep)


def build(parameters, world) -> Constraints:
    """Lay out the edges of every cloth that stretches, weft lines after warp lines."""
    edges, rest, compliance = [], [], []
    for cloth, chosen in parameters.items():
        grid, (dx, dy) = cloth.grid, cloth.mesh.spacing
        for lines, modulus, along, across in ((grid, chosen.warp, dx, dy),
                                              (grid.T, chosen.weft, dy, dx)):
            pairs = np.stack([lines[:, :-1], lines[:, 1:]], -1)
            width = np.full(pairs.shape[:2], across)
            if len(lines) > 1:
                width[[0, -1]] *= 0.5
            alpha = (np.full(width.shape, chosen.compliance) if chosen.compliance is not None
                     else along / (modulus * width))
            edges.append(pairs.reshape(-1, 2))
            compliance.append(alpha.ravel() * world.compliance_scale)
            local = pairs.reshape(-1, 2) - cloth.first
            rest.append(length(cloth.mesh.positions[local[:, 0]]
                               - cloth.mesh.positions[local[:, 1]]))
    batch = distance.distance_batch(np.concatenate(edges), np.concatenate(rest),
                                    np.concatenate(compliance), len(world.state.x),
                                    pins=world.pins)
    return Constraints(Stretch(batch), batch)


EFFECT = Effect(
    'stretch', Parameters, build,
    residual=lambda data, x: distance.residual(data.edges, x),
    energy=lambda data, x: distance.energy(data.edges, x))
