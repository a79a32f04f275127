"""
Hinge: bending stiffness by dihedral angles, for flat and for curved rest shapes.

For the edge (x0, x1) with opposite particles x2, x3, e = x1 - x0, n1 = e × (x2 - x0) and
n2 = (x3 - x0) × e (``constraints.hinges``; doc/numerics.md 5.6),

    C = θ - θ0,   θ = atan2((n1 × n2)·e / |e|, n1·n2) = atan2(-|e| n1·(x3 - x0), n1·n2)
    g2 = -|e| n1 / |n1|²,   g3 = -|e| n2 / |n2|²,   g1 = t1 n1 / |n1|² + t2 n2 / |n2|²
    g0 = -g1 - g2 - g3,   t1 = (x2 - x0)·e / |e|,   t2 = (x3 - x0)·e / |e|

with the energy B |e|² C² / (2 (A0 + A1)) of the rest shape, so α = (A0 + A1) / (B |e|²) [1/(N m)].
In force form Δf = -(C + α f) / (W + α), x_i += m_i g_i Δf, with W = Σ m_i |g_i|². The angle
continues beyond ±180°: of the angles that differ by whole turns it is the one nearest to the last.
On a flat mesh each hinge has its own B, fitted so that the sheet bends as a plate
(``constraints.plate_rigidity``).

A hinge with a triangle without height (below 1e-12 of its edge; 5e-4 in float32) has no angle: it
is not projected until it has one again.

Limits: a fold turns by less than half a turn per substep. On a curved irregular mesh the rigidity
depends on the triangles: on a cylinder 1.04 to 1.43 of B (doc/numerics.md 5.7).
"""

from dataclasses import dataclass, replace
from math import atan2, floor, pi, sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, fma, load, nearest, root, select, store
from xpbd_ros.sim.backend.simd_vector3 import fma3, fused_cross
from xpbd_ros.sim.constraints.atan2 import angle_of
from xpbd_ros.sim.constraints.builders import Packing
from xpbd_ros.sim.constraints.definitions import Constraints
from xpbd_ros.sim.constraints.hinges import all_hinges, dihedral, rigidity, slenderness
from xpbd_ros.sim.constraints.pinned import Held
from xpbd_ros.sim.constraints.plate_rigidity import plate, shortfall
from xpbd_ros.sim.constraints.projection import denominator, keep, recall, xpbd_residual
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.geometry import closest_points as points
from xpbd_ros.sim.geometry.mesh import cross, dot, length
from xpbd_ros.sim.parameters import along_both, need_one_or_two, quantity
from xpbd_ros.sim.stepping.constraint_stages import constraint


@dataclass(frozen=True)
class Parameters:
    """One bending rigidity, or one each along warp and weft."""

    stiffness: float | None = quantity(None, unit='N m', above=0.0, live=True,
                                       doc='bending rigidity B, alike in all directions')
    warp: float | None = quantity(None, unit='N m', above=0.0, live=True,
                                  doc='bending rigidity of a strip along warp')
    weft: float | None = quantity(None, unit='N m', above=0.0, live=True,
                                  doc='bending rigidity of a strip along weft')

    def __post_init__(self):
        """Require exactly one of the two forms."""
        need_one_or_two(self.stiffness, (self.warp, self.weft), both='warp and weft (N m)',
                        either='stiffness, or warp and weft (N m)')

    @property
    def rigidities(self) -> tuple[float, float]:
        """B along warp and along weft [N m]."""
        return along_both(self.stiffness, self.warp, self.weft)


class Hinge(NamedTuple):
    """Hinges in packs."""

    records: np.ndarray
    """particles as records, shape (slots, 4)"""
    slots: np.ndarray
    """first and last + 1 of the particles' slots, shape (2,)"""
    particles: np.ndarray
    """slots: edge start, edge end, opposite, opposite; shape (4, hinges)"""
    force: np.ndarray | None
    """f [N m], shape (hinges,); None if multipliers are not kept"""
    held: Held | None
    """hinges at pinned particles; None in a scene without pins"""
    colours: np.ndarray | None
    """first constraint of each colour, and the number of places, shape (colours + 1,); None in
    sequential order"""
    rest_angle: np.ndarray
    """[rad], shape (hinges,)"""
    compliance: np.ndarray
    """[1/(N m)], shape (hinges,)"""
    angle: np.ndarray
    """last angle [rad], with whole turns; shape (hinges,)"""


@constraint(Hinge, particles=4)
@jit(inline=True)
def solve_hinge(hinge, apart, c, x, m):
    """Solve a vector of hinges from index c on."""
    e, a, b = x[1] - x[0], x[2] - x[0], x[3] - x[0]
    n1, n2 = fused_cross(e, a), fused_cross(b, e)
    square, n1_n1, n2_n2, n1_n2 = dot(e, e), dot(n1, n1), dot(n2, n2), dot(n1, n2)
    least = (4096.0 * np.finfo(hinge.angle.dtype).eps)**2 * square * square
    open_ = both(n1_n1 > least, n2_n2 > least)
    l = select(open_, root(square), 1.0)
    r1, r2 = 1.0 / select(open_, n1_n1, 1.0), 1.0 / select(open_, n2_n2, 1.0)
    last = load(hinge.angle, c)
    now = angle_of(-(l * dot(n1, b)), n1_n2)
    now = fma(2.0 * pi, nearest((last - now) * (0.5 / pi)), now)
    now = select(open_, now, last)
    store(hinge.angle, c, now)

    t1, t2 = dot(a, e) / l, dot(b, e) / l
    s1, s2, mixed = l - t1, l - t2, 2.0 * n1_n2 * r1 * r2
    w0 = fma(s1 * s1, r1, fma(s2 * s2, r2, s1 * s2 * mixed))
    w1 = fma(t1 * t1, r1, fma(t2 * t2, r2, t1 * t2 * mixed))
    total = fma(m[0], w0, fma(m[1], w1, square * fma(m[2], r1, m[3] * r2)))
    alpha, f = load(hinge.compliance, c), recall(apart, hinge.force, c)
    residual = xpbd_residual(now - load(hinge.rest_angle, c), alpha, f)
    df = select(both(open_, total + alpha > 0.0),
                -residual / denominator(apart, total, alpha), 0.0)
    keep(hinge.force, c, f, df)
    u, v, dl = r1 * n1, r2 * n2, -(l * df)
    return (df, fma3(s1, u, s2 * v)), (df, fma3(t1, u, t2 * v)), (dl, u), (dl, v)


@jit
def energy_of(hinge, x):
    """Return Σ C² / (2 α) [J]."""
    total = 0.0
    for c in range(hinge.particles.shape[1]):
        p0, p1, p2, p3 = hinge.particles[:, c]
        if p0 == p1:    # an empty place of a pack
            continue
        e = (x[0, p1] - x[0, p0], x[1, p1] - x[1, p0], x[2, p1] - x[2, p0])
        a = (x[0, p2] - x[0, p0], x[1, p2] - x[1, p0], x[2, p2] - x[2, p0])
        b = (x[0, p3] - x[0, p0], x[1, p3] - x[1, p0], x[2, p3] - x[2, p0])
        n1, n2 = points.cross(e, a), points.cross(b, e)
        angle = atan2(-sqrt(points.dot(e, e)) * points.dot(n1, b), points.dot(n1, n2))
        angle += 2.0 * pi * floor((hinge.angle[c] - angle) / (2.0 * pi) + 0.5)
        total += (angle - hinge.rest_angle[c])**2 / hinge.compliance[c]
    return 0.5 * total


@dataclass(eq=False)
class Angles(Constraints):
    """The hinges one by one: the definition in NumPy."""

    rest_angle: np.ndarray
    """[rad], shape (hinges,)"""
    angle: np.ndarray
    """last angles of the batch [rad], which sweeps update"""

    @classmethod
    def of(cls, batch: Hinge) -> 'Angles':
        """Return the hinges of a batch."""
        return replace(super().of(batch), angle=batch.angle)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C [rad], shape (hinges,), nearest to the last angle."""
        angle = dihedral(self.corners(x))
        turns = np.round((self.angle[self.index] - angle) / (2.0 * pi))
        return angle + 2.0 * pi * turns - self.rest_angle

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """Return 4 Σ g_i g_iᵀ / α at each particle [N/m], shape (slots, 3, 3): K is no more."""
        x0, x1, x2, x3 = self.corners(x).swapaxes(0, 1)
        e, a, b = x1 - x0, x2 - x0, x3 - x0
        l = length(e)[:, None]
        u, v = cross(e, a), cross(b, e)
        u, v = u / dot(u, u)[:, None], v / dot(v, v)[:, None]
        t1, t2 = dot(a, e)[:, None] / l, dot(b, e)[:, None] / l
        found = np.zeros((x.shape[1], 3, 3))
        for k, g in enumerate(((l - t1) * u + (l - t2) * v, t1 * u + t2 * v, -l * u, -l * v)):
            np.add.at(found, self.particles[:, k], 4.0 / self.compliance[:, None, None]
                      * g[:, :, None] * g[:, None, :])
        return found


class BuiltHinge(Built):
    """The hinges of all cloths with this effect."""

    def __init__(self, parameters, world):
        super().__init__()
        particles, rest, compliance = [], [], []
        for cloth, chosen in parameters.items():
            mesh = cloth.mesh
            these, share = all_hinges(mesh)
            if mesh.grid is not None:
                b = share * rigidity(mesh, these, *chosen.rigidities)
            else:
                found = plate(mesh, *chosen.rigidities)
                b, short = found.rigidity, shortfall(found, *chosen.rigidities)
                self.notes += [f'cloths.{cloth.name}.effects.hinge: {short}'] if short else []
            corners = mesh.positions[these]
            particles.append(cloth.slots[these])
            rest.append(dihedral(corners))
            with np.errstate(over='ignore', divide='ignore'):
                compliance.append(world.compliance_scale / (b * slenderness(corners)))
        packing = Packing(particles, world)
        self.data = Hinge(**packing.common(), rest_angle=packing.column(rest),
                          compliance=packing.compliance(compliance), angle=packing.column(rest))
        self._before = self.data.angle.copy()
        self.constraints = Angles.of(self.data)

    def stored_energy(self, state):
        return energy_of(self.data, state.x)

    def read_by_frame(self):
        return self.data.angle,

    def begin(self, clock, state):
        self._before[:] = self.data.angle

    def again(self):
        self.data.angle[:] = self._before

    def moved(self, slots):
        mine = np.isin(self.data.particles, slots).any(0)
        self.data.angle[mine] = self.data.rest_angle[mine]

    def reset(self, state):
        self.data.angle[:] = self.data.rest_angle

    def adopt(self, old):
        self.data.angle[:] = old.data.angle


EFFECT = Effect('hinge', Parameters, BuiltHinge)
