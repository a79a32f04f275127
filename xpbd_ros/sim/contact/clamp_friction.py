"""
Friction of a particle between two colliders, one of them with a pad, solved for both at once.

p and r are the tangential displacements in this substep relative to the two surfaces, without
friction; friction changes both by s_1 + s_2. Coulomb's law for both contacts is the minimum over q
of a convex function,

    |q|² / 2 + L_1 |p + q| + L_2 |r + q|,   s_i = -L_i (p + q) / |p + q| where it slides

with L = μ d. It is at q = -p (sticks to the first), at q = -r (to the second), or where both
slide. So the order of the colliders is irrelevant: one after the other, the last would win.

Limits: where both slide, in directions that are not on one line, the minimum is approximated.
"""

from math import sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.contacts import shortened

SAME = 1e-9
"""difference of the surfaces' motions up to which they count as one surface, relative to L"""
ROUNDS = 16
"""fixed-point iterations where both slide"""


@jit
def shared_friction(p, r, sticks, slides):
    """
    Return the displacements s_1 and s_2 by friction.

    Parameters
    ----------
    p, r : displacements relative to the two surfaces without friction [m]
    sticks, slides : μ_s d and μ_k d of the two contacts [m]

    """
    gx, gy, gz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    apart, total = sqrt(gx * gx + gy * gy + gz * gz), slides[0] + slides[1]
    if total == 0.0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if apart <= SAME * total:
        a, b = slides[0] / total, slides[1] / total
        x, y, z = shortened(-a * p[0] - b * r[0], -a * p[1] - b * r[1], -a * p[2] - b * r[2],
                            sticks[0] + sticks[1], total)
        return (a * x, a * y, a * z), (b * x, b * y, b * z)
    ex, ey, ez = gx / apart, gy / apart, gz / apart
    l = slides[1]
    x, y, z = l * ex - p[0], l * ey - p[1], l * ez - p[2]
    if x * x + y * y + z * z <= sticks[0]**2:
        return (x, y, z), (-l * ex, -l * ey, -l * ez)
    l = slides[0]
    x, y, z = -l * ex - r[0], -l * ey - r[1], -l * ez - r[2]
    if x * x + y * y + z * z <= sticks[1]**2:
        return (l * ex, l * ey, l * ez), (x, y, z)
    return _both_slide(p, r, slides)


@jit
def _both_slide(p, r, slides):
    """Return s_1 and s_2 where both contacts slide: q = -(w_1 p + w_2 r) / (1 + w_1 + w_2)."""
    x, y, z, v, w = 0.0, 0.0, 0.0, 0.0, 0.0
    for _ in range(ROUNDS):
        v, w = _weight(p, x, y, z, slides[0]), _weight(r, x, y, z, slides[1])
        share = -1.0 / (1.0 + v + w)
        x, y, z = (share * (v * p[0] + w * r[0]), share * (v * p[1] + w * r[1]),
                   share * (v * p[2] + w * r[2]))
    v, w = -_weight(p, x, y, z, slides[0]), -_weight(r, x, y, z, slides[1])
    return ((v * (p[0] + x), v * (p[1] + y), v * (p[2] + z)),
            (w * (r[0] + x), w * (r[1] + y), w * (r[2] + z)))


@jit(inline=True)
def _weight(p, x, y, z, l):
    """Return L / |p + q|; 0 where nothing slides."""
    slip = sqrt((p[0] + x)**2 + (p[1] + y)**2 + (p[2] + z)**2)
    return l / slip if slip > 0.0 else 0.0
