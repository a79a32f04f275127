"""
Cross bend: elastic edges between the opposite particles of each hinge, the cheapest bending.

C = |x2 - x3| - L (``constraints.distance``), L the distance at rest. Folded by θ, two triangles of
heights h2, h3 over the shared edge, with feet p apart, have their tips sqrt(p² + h2² + h3² + 2 h2
h3 cos θ) apart. Each edge has the k with which it stores, 90° from rest, the energy of a hinge of
rigidity B (``constraints.hinges``): k C² = B |e|² (π/2)² / (A0 + A1).

Limits: a flat hinge hardly resists small folds (C grows with θ², so at 10° it stores 1 % of a
hinge's energy) and may fold either way; a curved one resists from the start. The edges also resist
stretch and shear, by about 7 B over the square of the mesh width [N/m].
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.constraints import distance
from xpbd_ros.sim.constraints.hinges import all_hinges, dihedral, slenderness
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.geometry.mesh import dot, length
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.stepping.constraint_stages import elastic_edges


@dataclass(frozen=True)
class Parameters:
    """The bending rigidity."""

    stiffness: float = quantity(unit='N m', above=0.0, live=True,
                                doc='bending rigidity B, exact at a fold of 90°')


@elastic_edges
class CrossBend(NamedTuple):
    """Data of the kernels."""

    edges: distance.MeshEdges


def crossings(mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return the edges of a mesh for B = 1.

    Returns
    -------
    particles (edges, 2), rest lengths [m] and stiffnesses [1/m²], shape (edges,); a pair of
    particles opposite in two hinges makes one edge

    """
    particles, share = all_hinges(mesh)
    corners = mesh.positions[particles]
    e = corners[:, 1] - corners[:, 0]
    unit = e / length(e)[:, None]
    a, b = (corners[:, k] - corners[:, 0] for k in (2, 3))
    p, q = dot(a, unit), dot(b, unit)
    heights = [length(v - t[:, None] * unit) for v, t in ((a, p), (b, q))]

    def apart(angle):
        h, g = heights
        return np.sqrt((p - q)**2 + h * h + g * g + 2.0 * h * g * np.cos(angle))

    rest = np.abs(dihedral(corners))
    folded = np.where(rest > 0.5 * np.pi, rest - 0.5 * np.pi, rest + 0.5 * np.pi)
    k = share * slenderness(corners) * (0.5 * np.pi / (apart(folded) - apart(rest)))**2
    pairs, which = np.unique(np.sort(particles[:, 2:], 1), axis=0, return_inverse=True)
    ends = mesh.positions[pairs]
    return pairs, length(ends[:, 0] - ends[:, 1]), np.bincount(which.ravel(), k, len(pairs))


class BuiltCrossBend(Built):
    """The edges of all cloths with this effect."""

    def __init__(self, parameters, world):
        super().__init__()
        particles, rest, compliance = [], [], []
        for cloth, chosen in parameters.items():
            pairs, lengths, k = crossings(cloth.mesh)
            particles.append(cloth.slots[pairs])
            rest.append(lengths)
            with np.errstate(over='ignore', divide='ignore'):
                compliance.append(world.compliance_scale / (chosen.stiffness * k))
        self.data = CrossBend(distance.mesh_edges(particles, rest, compliance, world=world))
        self.constraints = distance.Edges.of(self.data.edges)


EFFECT = Effect('cross_bend', Parameters, BuiltCrossBend)
