"""
Correction of the spin that sequential projections of internal forces give to a free body.

Internal forces F at the substep's end x exert no torque: with displacements d = m F and
mobilities m,

    T = Σ (x - c) × d / m = 0,   c = Σ (x / m) / Σ (1 / m).

Each projection satisfies this at the positions that it reads, not at the substep's end. In a body
under permanent stress T accumulates to a spin (with the square of the substep). A rigid rotation
of the body by θ, which strains nothing, cancels it:

    x += θ × (x - c),   I θ = -T,   I = Σ (|r|² - r rᵀ) / m,   r = x - c.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.closest_points import cross, dot
from xpbd_ros.sim.particles.rounding import add_move, error_of


@jit
def keep_places(x, first, last, before):
    """Copy the positions of the slots first:last to ``before`` [m], shape (3, slots)."""
    for k in range(3):
        for i in range(first, last):
            before[k, i] = x[k, i]


@jit
def set_aside(x, first, last, before):
    """Keep the displacements since ``keep_places`` instead, as before - x; ``resume`` ends it."""
    for k in range(3):
        for i in range(first, last):
            before[k, i] -= x[k, i]


@jit
def resume(x, first, last, before):
    """Let displacements since ``set_aside`` count as if they had been before ``keep_places``."""
    for k in range(3):
        for i in range(first, last):
            before[k, i] += x[k, i]


@jit
def turn_back(x, rounding, mobility, mass, first, last, before):
    """
    Cancel the rotation by the displacements since ``keep_places``; none if a particle is pinned.

    Parameters
    ----------
    x, before : positions now and before the projections [m], shape (3, slots)
    rounding : what x lacks of the displacements, or None
    mobility : m [m/N], shape (slots,)
    mass : 0 in the padding, shape (slots,)
    first, last : slots of the body, first:last

    """
    total, cx, cy, cz = 0.0, 0.0, 0.0, 0.0
    for i in range(first, last):
        if mass[i] > 0.0:    # not padding
            if mobility[i] == 0.0:
                return
            w = 1.0 / mobility[i]
            total += w
            cx += w * x[0, i]
            cy += w * x[1, i]
            cz += w * x[2, i]
    cx, cy, cz = cx / total, cy / total, cz / total
    tx, ty, tz = 0.0, 0.0, 0.0
    xx, yy, zz, yz, zx, xy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(first, last):
        if mass[i] > 0.0:
            w, r = 1.0 / mobility[i], (x[0, i] - cx, x[1, i] - cy, x[2, i] - cz)
            sx, sy, sz = cross(r, (x[0, i] - before[0, i] + error_of(rounding, 0, i),
                                   x[1, i] - before[1, i] + error_of(rounding, 1, i),
                                   x[2, i] - before[2, i] + error_of(rounding, 2, i)))
            tx, ty, tz = tx + w * sx, ty + w * sy, tz + w * sz
            square = dot(r, r)
            xx += w * (square - r[0] * r[0])
            yy += w * (square - r[1] * r[1])
            zz += w * (square - r[2] * r[2])
            yz -= w * r[1] * r[2]
            zx -= w * r[2] * r[0]
            xy -= w * r[0] * r[1]
    a, b, c = (xx, xy, zx), (xy, yy, yz), (zx, yz, zz)
    u, v, s = cross(b, c), cross(c, a), cross(a, b)    # I⁻¹ = (u, v, s) / det I
    det = dot(a, u)
    if det <= 0.0:
        return
    tx, ty, tz = (-(u[0] * tx + v[0] * ty + s[0] * tz) / det,
                  -(u[1] * tx + v[1] * ty + s[1] * tz) / det,
                  -(u[2] * tx + v[2] * ty + s[2] * tz) / det)
    for i in range(first, last):
        if mass[i] > 0.0:
            dx, dy, dz = cross((tx, ty, tz), (x[0, i] - cx, x[1, i] - cy, x[2, i] - cz))
            add_move(x, rounding, 0, i, dx)
            add_move(x, rounding, 1, i, dy)
            add_move(x, rounding, 2, i, dz)
