"""
Unturned: what a body that floats does to itself does not turn it.

Internal forces F at the substep's end x exert no torque, so with moves d = m F, mobilities m,

    T = Σ (x - c) × d / m = 0,   c = Σ (x / m) / Σ (1 / m).

Each projection has it so where it finds the particles, but they have moved on when the last one is
done: of a body that is taut all the time, T grows into a spin (with the square of the substep).
A turn of the whole by θ, which strains nothing, takes it back:

    x += θ × (x - c),   I θ = -T,   I = Σ (|r|² - r rᵀ) / m,   r = x - c.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.geometry.closest_points import cross, dot


@jit
def keep_places(x, first, last, before):
    """Note where the particles are, before what moves them."""
    for k in range(3):
        for i in range(first, last):
            before[k, i] = x[k, i]


@jit
def turn_back(x, mobility, mass, first, last, before):
    """Take the turn back that the moves since made, unless a particle is held."""
    total, cx, cy, cz = 0.0, 0.0, 0.0, 0.0
    for i in range(first, last):
        if mass[i] > 0.0:    # and not padding
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
            sx, sy, sz = cross(r, (x[0, i] - before[0, i], x[1, i] - before[1, i],
                                   x[2, i] - before[2, i]))
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
            x[0, i] += dx
            x[1, i] += dy
            x[2, i] += dz
