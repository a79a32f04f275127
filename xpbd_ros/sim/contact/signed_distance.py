"""Signed distance φ to each shape of collider, and its gradient, the unit normal."""

from math import sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.colliders import CAPSULE, CYLINDER, HEIGHTS, MESH, PLANE, SPHERE


@jit(inline=True)
def signed_distance(colliders, c, x, y, z):
    """Return φ [m] and the unit normal at a point in the axes of collider c."""
    return _distance(colliders.grids, colliders.heights, colliders, c, x, y, z)


@jit(inline=True)
def _distance(grids, heights, colliders, c, x, y, z):
    shape, size = colliders.shape[c], colliders.size
    if grids is not None:    # noqa: SIM102  Numba prunes only branches on None alone
        if shape == MESH:
            return grid_distance(grids, c, x, y, z)
    if heights is not None:    # noqa: SIM102
        if shape == HEIGHTS:
            return ground_distance(heights, c, size[c, 0], size[c, 1], x, y, z)
    return shape_distance(shape, size[c, 0], size[c, 1], size[c, 2], x, y, z)


@jit(inline=True)
def shape_distance(shape, a, b, c, x, y, z):
    """Return φ [m] and the unit normal for a shape and its three sizes (``Colliders.size``)."""
    if shape == PLANE:
        return z, 0.0, 0.0, 1.0
    if shape == SPHERE:
        return _round(x, y, z, a)
    if shape == CAPSULE:
        return _round(x, y, z - min(max(z, -b), b), a)
    if shape == CYLINDER:
        return _cylinder(x, y, z, a, b)
    return _box(x, y, z, a, b, c)


@jit(inline=True)
def _round(x, y, z, radius):
    """Return φ and the normal of a sphere around the origin."""
    l = sqrt(x * x + y * y + z * z)
    if l > 0.0:
        return l - radius, x / l, y / l, z / l
    return -radius, 0.0, 0.0, 1.0


@jit(inline=True)
def _cylinder(x, y, z, radius, half):
    """Return φ and the normal of a closed cylinder along z."""
    r = sqrt(x * x + y * y)
    rx, ry = (x / r, y / r) if r > 0.0 else (1.0, 0.0)
    up = 1.0 if z >= 0.0 else -1.0
    side, cap = r - radius, abs(z) - half
    if side > 0.0 and cap > 0.0:
        l = sqrt(side * side + cap * cap)
        return l, rx * side / l, ry * side / l, up * cap / l
    if side > cap:
        return side, rx, ry, 0.0
    return cap, 0.0, 0.0, up


@jit(inline=True)
def _box(x, y, z, a, b, c):
    """Return φ and the normal of a box of half extents a, b, c."""
    sx = 1.0 if x >= 0.0 else -1.0
    sy = 1.0 if y >= 0.0 else -1.0
    sz = 1.0 if z >= 0.0 else -1.0
    qx, qy, qz = abs(x) - a, abs(y) - b, abs(z) - c
    ox, oy, oz = max(qx, 0.0), max(qy, 0.0), max(qz, 0.0)
    l = sqrt(ox * ox + oy * oy + oz * oz)
    if l > 0.0:
        return l, sx * ox / l, sy * oy / l, sz * oz / l
    if qx >= qy and qx >= qz:
        return qx, sx, 0.0, 0.0
    if qy >= qz:
        return qy, 0.0, sy, 0.0
    return qz, 0.0, 0.0, sz


@jit
def grid_distance(grids, c, x, y, z):
    """Return φ, trilinear, and its normalised gradient; outside the grid, a lower bound of φ."""
    s, o, n = grids.spacing[c], grids.origin, grids.nodes
    u, v, w = (x - o[c, 0]) / s, (y - o[c, 1]) / s, (z - o[c, 2]) / s
    eu = u - min(max(u, 0.0), n[c, 0] - 1.0)
    ev = v - min(max(v, 0.0), n[c, 1] - 1.0)
    ew = w - min(max(w, 0.0), n[c, 2] - 1.0)
    out = sqrt(eu * eu + ev * ev + ew * ew)
    if out != 0.0:    # true for nan too
        return out * s + grids.clearance[c], eu / out, ev / out, ew / out
    i, j = min(int(u), n[c, 0] - 2), min(int(v), n[c, 1] - 2)
    k = min(int(w), n[c, 2] - 2)
    a, b, g = u - i, v - j, w - k
    dy, dx = n[c, 2], n[c, 1] * n[c, 2]
    f, q = grids.values, grids.first[c] + (i * n[c, 1] + j) * n[c, 2] + k
    f00, d00 = f[q] + g * (f[q + 1] - f[q]), f[q + 1] - f[q]
    q += dy
    f01, d01 = f[q] + g * (f[q + 1] - f[q]), f[q + 1] - f[q]
    q += dx
    f11, d11 = f[q] + g * (f[q + 1] - f[q]), f[q + 1] - f[q]
    q -= dy
    f10, d10 = f[q] + g * (f[q + 1] - f[q]), f[q + 1] - f[q]
    f0, f1 = f00 + b * (f01 - f00), f10 + b * (f11 - f10)
    gx, gy = f1 - f0, (1.0 - a) * (f01 - f00) + a * (f11 - f10)
    gz = (1.0 - a) * (d00 + b * (d01 - d00)) + a * (d10 + b * (d11 - d10))
    phi, l = f0 + a * gx, sqrt(gx * gx + gy * gy + gz * gz)
    if l > 0.0:
        return phi, gx / l, gy / l, gz / l
    return phi, 0.0, 0.0, 1.0


@jit
def ground_distance(heights, c, half_x, half_y, x, y, z):
    """
    Return the distance to the tangent plane of a height field below the point, and its normal.

    The field is bilinear, and constant beyond its boundary.
    """
    n, f = heights.nodes, heights.values
    if x != x or y != y:    # nan
        return x + y, 0.0, 0.0, 1.0
    across, up = 0.5 * (n[c, 0] - 1), 0.5 * (n[c, 1] - 1)
    u = min(max((x / half_x + 1.0) * across, 0.0), n[c, 0] - 1.0)
    v = min(max((y / half_y + 1.0) * up, 0.0), n[c, 1] - 1.0)
    i, j = min(int(u), n[c, 0] - 2), min(int(v), n[c, 1] - 2)
    a, b, q = u - i, v - j, heights.first[c] + j * n[c, 0] + i
    f0, d0 = f[q] + a * (f[q + 1] - f[q]), f[q + 1] - f[q]
    q += n[c, 0]
    f1, d1 = f[q] + a * (f[q + 1] - f[q]), f[q + 1] - f[q]
    gx = (d0 + b * (d1 - d0)) * across / half_x if abs(x) <= half_x else 0.0
    gy = (f1 - f0) * up / half_y if abs(y) <= half_y else 0.0
    l = sqrt(1.0 + gx * gx + gy * gy)
    return (z - (f0 + b * (f1 - f0))) / l, -gx / l, -gy / l, 1.0 / l
