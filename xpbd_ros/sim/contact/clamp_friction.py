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
from typing import NamedTuple

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.corners import contact_distance
from xpbd_ros.sim.geometry.closest_points import dot

OPPOSITE = -0.9
"""largest cosine of the angle between the normals of a clamp"""
SAME = 1e-9
"""difference of the surfaces' motions up to which they count as one surface, relative to μ_s d"""
ROUNDS = 16
"""fixed-point iterations where both slide"""


class Clamp(NamedTuple):
    """A particle between two candidates j and k, linearised where it moves with the surfaces."""

    holds: bool
    """True if both press on it there"""
    at: tuple[float, float, float]
    """that point [m]"""
    axis: tuple[float, float, float]
    """a, the direction of the mean of n_j and -n_k"""
    normals: tuple[tuple[float, float, float], tuple[float, float, float]]
    """n_j and n_k"""
    deficit: tuple[float, float]
    """r - φ of both there [m]"""
    push: tuple[float, float]
    """d of both there [m]"""
    free: tuple[float, float, float]
    """position without friction [m]: x* + Σ d n"""


@jit(inline=True)
def clamp_at(pads, contacts, j, k, free, at):
    """Return the clamp at a point of a particle; without contacts it would be at ``free``."""
    phi_j, n_j = contact_distance(contacts, j, at[0], at[1], at[2])
    phi_k, n_k = contact_distance(contacts, k, at[0], at[1], at[2])
    deficit = contacts.gap[j] - phi_j, contacts.gap[k] - phi_k
    axis, push, holds = n_j, (0.0, 0.0), dot(n_j, n_k) < OPPOSITE
    if holds:
        size = sqrt(2.0 - 2.0 * dot(n_j, n_k))
        axis = ((n_j[0] - n_k[0]) / size, (n_j[1] - n_k[1]) / size, (n_j[2] - n_k[2]) / size)
        c = free[0] - at[0], free[1] - at[1], free[2] - at[2]
        push = _pushes(pads, j, k, axis, (n_j, n_k), deficit, dot(axis, c), (0.0, 0.0, 0.0))[1]
        holds = push[0] > 0.0 and push[1] > 0.0
    return Clamp(holds, at, axis, (n_j, n_k), deficit, push, (
        free[0] + push[0] * n_j[0] + push[1] * n_k[0],
        free[1] + push[0] * n_j[1] + push[1] * n_k[1],
        free[2] + push[0] * n_j[2] + push[1] * n_k[2]))


@jit(inline=True)
def _pushes(pads, j, k, axis, normals, deficit, along, z):
    """
    Return the position along the axis and both d, for a displacement z across it [m].

    ``along`` is the position along the axis without pushes.
    """
    one, other = pads.ratio[j], pads.ratio[k]
    a, b = dot(normals[0], axis), dot(normals[1], axis)
    p, r = deficit[0] - dot(normals[0], z), deficit[1] - dot(normals[1], z)
    y = (along + one * a * p + other * b * r) / (1.0 + one * a * a + other * b * b)
    return y, (one * (p - a * y), other * (r - b * y))


@jit(inline=True)
def across(clamp, x, y, z):
    """Return the way from a point to where the particle is without friction, across the axis."""
    t = clamp.free[0] - x, clamp.free[1] - y, clamp.free[2] - z
    along = dot(clamp.axis, t)
    return (t[0] - along * clamp.axis[0], t[1] - along * clamp.axis[1],
            t[2] - along * clamp.axis[2])


@jit(inline=True)
def place_clamped(pads, contacts, j, k, i, state, clamp, free, slippery, apart, first, second):
    """
    Move particle i to where pushes and friction leave it; return False if it is not held there.

    Parameters
    ----------
    free, slippery : its positions without contacts, and as pads without friction leave it [m]
    apart : distance of the surfaces' motions [m]
    first, second : displacements by friction [m]

    """
    at, n, axis = clamp.at, clamp.normals, clamp.axis
    x, y, z = across(clamp, at[0], at[1], at[2])
    x, y, z = x + first[0] + second[0], y + first[1] + second[1], z + first[2] + second[2]
    f = slippery[0] - at[0], slippery[1] - at[1], slippery[2] - at[2]
    along, slip = dot(axis, f), sqrt(x * x + y * y + z * z)
    most = sqrt(max(0.0, dot(f, f) - along * along)) + apart
    if slip > most:    # never further than without friction
        x, y, z = most / slip * x, most / slip * y, most / slip * z
    c = free[0] - at[0], free[1] - at[1], free[2] - at[2]
    along, d = _pushes(pads, j, k, axis, n, clamp.deficit, dot(axis, c), (x, y, z))
    x, y, z = x + along * axis[0], y + along * axis[1], z + along * axis[2]
    if not (d[0] > 0.0 and d[1] > 0.0) or recovers_fast(
            pads, contacts, j, n[0], clamp.deficit[0], c, (x, y, z)) or recovers_fast(
            pads, contacts, k, n[1], clamp.deficit[1], c, (x, y, z)):
        return False
    _write_push(pads, contacts, j, n[0], d[0], state.mobility[i])
    _write_push(pads, contacts, k, n[1], d[1], state.mobility[i])
    x, y, z = x + at[0], y + at[1], z + at[2]
    state.x[0, i], state.x[1, i], state.x[2, i] = x, y, z
    pads.shift[k, 0] = x - free[0] - first[0] - second[0]
    pads.shift[k, 1] = y - free[1] - first[1] - second[1]
    pads.shift[k, 2] = z - free[2] - first[2] - second[2]
    return True


@jit(inline=True)
def recovers_fast(pads, contacts, k, n, deficit, c, z):
    """Return True if a displacement from c to z makes a pad recover faster than DEPENETRATION."""
    return (pads.soft[k] and dot(n, z) > dot(n, c)
            and contacts.gap[k] - deficit + dot(n, z) > pads.limit[k])


@jit(inline=True)
def _write_push(pads, contacts, k, n, d, m):
    contacts.normal[k, 0], contacts.normal[k, 1], contacts.normal[k, 2] = n
    contacts.push[k] = pads.given[k] = d
    pads.force[k], pads.lost[k] = d / m, pads.ratio[k] / (1.0 + pads.ratio[k])


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
    apart, most = sqrt(gx * gx + gy * gy + gz * gz), sticks[0] + sticks[1]
    if most == 0.0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if apart <= SAME * most:
        a, b = sticks[0] / most, sticks[1] / most
        x, y, z = -a * p[0] - b * r[0], -a * p[1] - b * r[1], -a * p[2] - b * r[2]
        size = sqrt(x * x + y * y + z * z)
        if size > most:
            a, b = slides[0] / size, slides[1] / size
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
