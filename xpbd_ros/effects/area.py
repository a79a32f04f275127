"""
Area: triangles resist changes of their area, but not of their shape.

C = A - A0 with 2 A n = (x1-x0) × (x2-x0), |n| = 1, so

    ∇1 = (x2-x0) × n / 2,   ∇2 = n × (x1-x0) / 2,   ∇0 = -∇1 - ∇2.

The energy of a triangle is stiffness C² / (2 A0), so α = A0 / stiffness [m³/N]: ``stiffness`` is
the tension of a sheet whose area has doubled. It serves flat bodies and skins, together with an
effect that resists shear; on a body of tetrahedra it acts on the skin.

Limits: a triangle whose corners are collinear has no normal and does not move. Alone, the effect
lets a triangle shear without bound.
"""

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, fma, load, select
from xpbd_ros.sim.constraints.builders import Packing
from xpbd_ros.sim.constraints.definitions import Constraints, isotropic
from xpbd_ros.sim.constraints.pinned import Held
from xpbd_ros.sim.constraints.projection import denominator, keep, recall, xpbd_residual
from xpbd_ros.sim.effect import Built, Effect, sides_of
from xpbd_ros.sim.geometry.mesh import cross, dot, length, triangle_areas
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.stepping.constraint_stages import constraint


@dataclass(frozen=True)
class Parameters:
    """The area modulus."""

    stiffness: float = quantity(unit='N/m', above=0.0, live=True,
                                doc='area modulus: tension per relative change of area')


class Area(NamedTuple):
    """Triangles in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots, shape (3, triangles)"""
    force: np.ndarray | None
    """f, multiplier over H² [N/m], negative in tension, shape (triangles,); None if
    multipliers are not kept"""
    held: Held | None
    """triangles at pinned particles; None in a scene without pins"""
    colours: np.ndarray | None
    """first constraint of each colour, and the number of places, shape (colours + 1,); None in
    sequential order"""
    rest_area: np.ndarray
    """A0 [m²], shape (triangles,)"""
    compliance: np.ndarray
    """A0 / stiffness [m³/N], shape (triangles,)"""


@constraint(Area, particles=3)
@jit(inline=True)
def solve_area(area, apart, c, x, m):
    """Solve a vector of triangles from index c on."""
    a, b = x[1] - x[0], x[2] - x[0]
    n = cross(a, b)
    twice = length(n)
    there = twice > 0.0
    n = select(there, 0.5 / select(there, twice, 1.0), 0.0) * n
    g1, g2 = cross(b, n), cross(n, a)
    g0 = -(g1 + g2)
    alpha, f = load(area.compliance, c), recall(apart, area.force, c)
    residual = xpbd_residual(0.5 * twice - load(area.rest_area, c), alpha, f)
    total = fma(m[0], dot(g0, g0), fma(m[1], dot(g1, g1), m[2] * dot(g2, g2)))
    df = select(both(there, total + alpha > 0.0),
                -residual / denominator(apart, total, alpha), 0.0)
    keep(area.force, c, f, df)
    return (df, g0), (df, g1), (df, g2)


@jit
def energy_of(area, x):
    """Return Σ C² / (2 α) [J]."""
    total = 0.0
    for c in range(area.particles.shape[1]):
        i, j, k = area.particles[0, c], area.particles[1, c], area.particles[2, c]
        if i == j:    # an empty place of a pack
            continue
        ax, ay, az = x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]
        bx, by, bz = x[0, k] - x[0, i], x[1, k] - x[1, i], x[2, k] - x[2, i]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        residual = 0.5 * sqrt(nx * nx + ny * ny + nz * nz) - area.rest_area[c]
        total += residual * residual / area.compliance[c]
    return 0.5 * total


@dataclass(eq=False)
class Triangles(Constraints):
    """The triangles one by one: the definition in NumPy."""

    rest_area: np.ndarray
    """A0 [m²], shape (triangles,)"""

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C [m²], shape (triangles,); x is (3, slots)."""
        return triangle_areas(self.corners(x)) - self.rest_area

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """Return Σ |∇i| Σ |∇j| / α at each particle [N/m], shape (slots, 3, 3)."""
        corners = self.corners(x)
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        slopes = 0.5 * length(np.stack([a - b, b, a], 1))    # |∇| is half the opposite side
        return isotropic(x, self.particles,
                         slopes * slopes.sum(1, keepdims=True) / self.compliance[:, None])


class BuiltArea(Built):
    """The triangles of all cloths with this effect."""

    def __init__(self, parameters, world):
        super().__init__()
        particles, rest, compliance = [], [], []
        for cloth, chosen in parameters.items():
            area = triangle_areas(cloth.mesh.positions[cloth.mesh.triangles])
            particles.append(cloth.slots[cloth.mesh.triangles])
            rest.append(area)
            compliance.append(world.compliance_scale * area / chosen.stiffness)
        packing = Packing(particles, world)
        self.data = Area(**packing.common(), rest_area=packing.column(rest),
                         compliance=packing.compliance(compliance))
        self.constraints = Triangles.of(self.data)
        self.sides = sides_of(parameters)

    def stored_energy(self, state):
        return energy_of(self.data, state.x)


EFFECT = Effect('area', Parameters, BuiltArea)
