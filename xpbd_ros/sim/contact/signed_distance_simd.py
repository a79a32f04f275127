"""
Signed distance φ to each shape of collider, and its gradient, by lanes of float64.

The formulas of ``contact.signed_distance``, with the same bits: all regions of a shape are
computed and one selected. Mesh and height field are computed lane by lane.
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import absolute, both, highest, larger, root, select, smaller
from xpbd_ros.sim.backend.simd_wide import load_wide, store_wide, wide, WIDTH
from xpbd_ros.sim.contact.colliders import (
    BOX,
    CAPSULE,
    CYLINDER,
    HEIGHTS,
    MESH,
    PLANE,
    SPHERE,
)
from xpbd_ros.sim.contact.signed_distance import grid_distance, ground_distance, signed_distance


@jit(inline=True)
def signed_distances(colliders, scratch, c, x, y, z):
    """
    Return φ [m] and the unit normals at points in the axes of collider c.

    Parameters
    ----------
    scratch : working memory, shape (4, WIDTH)
    x, y, z : vectors [m]

    """
    found, size = colliders.shape[c], colliders.size
    if found > BOX:
        sample(colliders.grids, colliders.heights, found, size[c, 0], size[c, 1], scratch, c,
               x, y, z)
        return (load_wide(scratch, 0), load_wide(scratch, WIDTH), load_wide(scratch, 2 * WIDTH),
                load_wide(scratch, 3 * WIDTH))
    return shape_distances(found, size[c, 0], size[c, 1], size[c, 2], x, y, z)


@jit(inline=True)
def depths(colliders, scratch, c, x, y, z):
    """Return φ alone."""
    found, size = colliders.shape[c], colliders.size
    if WIDTH == 1:    # on a GPU, whose threads share no scratch
        return wide(signed_distance(colliders, c, highest(x), highest(y), highest(z))[0])
    if found > BOX:
        sample(colliders.grids, colliders.heights, found, size[c, 0], size[c, 1], scratch, c,
               x, y, z)
        return load_wide(scratch, 0)
    return shape_depths(found, size[c, 0], size[c, 1], size[c, 2], x, y, z)


@jit
def sample(grids, heights, shape, half_x, half_y, scratch, c, x, y, z):
    """Write φ and the normals of a mesh or a height field to the rows of ``scratch``."""
    store_wide(scratch, 0, x)
    store_wide(scratch, WIDTH, y)
    store_wide(scratch, 2 * WIDTH, z)
    if grids is not None:    # noqa: SIM102  Numba prunes only branches on None alone
        if shape == MESH:
            for l in range(WIDTH):
                phi, nx, ny, nz = grid_distance(grids, c, scratch[0, l], scratch[1, l],
                                                scratch[2, l])
                scratch[0, l], scratch[1, l], scratch[2, l], scratch[3, l] = phi, nx, ny, nz
    if heights is not None:    # noqa: SIM102
        if shape == HEIGHTS:
            for l in range(WIDTH):
                phi, nx, ny, nz = ground_distance(heights, c, half_x, half_y, scratch[0, l],
                                                  scratch[1, l], scratch[2, l])
                scratch[0, l], scratch[1, l], scratch[2, l], scratch[3, l] = phi, nx, ny, nz


@jit
def shape_distances(shape, a, b, c, x, y, z):
    """Return φ [m] and the unit normals for a shape and its three sizes (``Colliders.size``)."""
    return _distances(shape, a, b, c, x, y, z)


@jit
def shape_depths(shape, a, b, c, x, y, z):
    """Return φ alone."""
    return _distances(shape, a, b, c, x, y, z)[0]


@jit(inline=True)
def _distances(shape, a, b, c, x, y, z):
    if shape == PLANE:
        return z, wide(0.0), wide(0.0), wide(1.0)
    if shape == SPHERE:
        return _round(x, y, z, a)
    if shape == CAPSULE:
        return _round(x, y, z - smaller(b, larger(-b, z)), a)
    if shape == CYLINDER:
        return _cylinder(x, y, z, a, b)
    return _box(x, y, z, a, b, c)


@jit(inline=True)
def _round(x, y, z, radius):
    l = root(x * x + y * y + z * z)
    there = l > 0.0
    return (select(there, l - radius, -radius), select(there, x / l, 0.0),
            select(there, y / l, 0.0), select(there, z / l, 1.0))


@jit(inline=True)
def _cylinder(x, y, z, radius, half):
    r = root(x * x + y * y)
    there = r > 0.0
    rx, ry = select(there, x / r, 1.0), select(there, y / r, 0.0)
    up = select(z >= 0.0, wide(1.0), -1.0)
    side, cap = r - radius, absolute(z) - half
    beside, rim = side > cap, both(side > 0.0, cap > 0.0)
    l = root(side * side + cap * cap)
    return (select(rim, l, select(beside, side, cap)),
            select(rim, rx * side / l, select(beside, rx, 0.0)),
            select(rim, ry * side / l, select(beside, ry, 0.0)),
            select(rim, up * cap / l, select(beside, wide(0.0), up)))


@jit(inline=True)
def _box(x, y, z, a, b, c):
    sx = select(x >= 0.0, wide(1.0), -1.0)
    sy = select(y >= 0.0, wide(1.0), -1.0)
    sz = select(z >= 0.0, wide(1.0), -1.0)
    qx, qy, qz = absolute(x) - a, absolute(y) - b, absolute(z) - c
    ox, oy, oz = larger(0.0, qx), larger(0.0, qy), larger(0.0, qz)
    l = root(ox * ox + oy * oy + oz * oz)
    out, first, second = l > 0.0, both(qx >= qy, qx >= qz), qy >= qz
    return (select(out, l, select(first, qx, select(second, qy, qz))),
            select(out, sx * ox / l, select(first, sx, 0.0)),
            select(out, sy * oy / l, select(first, wide(0.0), select(second, sy, 0.0))),
            select(out, sz * oz / l, select(first, wide(0.0), select(second, wide(0.0), sz))))
