"""Positions of the particles of consecutive candidates, by SIMD lanes."""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_wide import gather, load_wide, scatter, store_wide, WIDTH


@jit(inline=True)
def is_run(index, k):
    """Return True if the particles index[k], … of one collider are neighbours in memory."""
    return index[k + WIDTH - 1] - index[k] == WIDTH - 1


@jit(inline=True)
def block(x, slots, q):
    """Return the vectors of x, y and z, shape (3, slots), from slot q on."""
    return load_wide(x, q), load_wide(x, slots + q), load_wide(x, 2 * slots + q)


@jit(inline=True)
def numbers(values, index, k):
    """Return the vector of the values, shape (slots,), of the particles index[k], …"""
    if is_run(index, k):
        return load_wide(values, index[k])
    return gather(values, 0, index, k)


@jit(inline=True)
def positions(x, index, k):
    """Return vectors of the positions x, shape (3, slots), of the particles index[k], …"""
    slots, i = x.shape[1], index[k]
    if is_run(index, k):
        return load_wide(x, i), load_wide(x, slots + i), load_wide(x, 2 * slots + i)
    return gather_positions(x, index, k)


@jit
def gather_positions(x, index, k):
    """Return the positions of particles that are not neighbours in memory."""
    slots = x.shape[1]
    return gather(x, 0, index, k), gather(x, slots, index, k), gather(x, 2 * slots, index, k)


@jit
def scatter_positions(x, index, k, new_x, new_y, new_z):
    """Write the positions of particles that are not neighbours in memory."""
    slots = x.shape[1]
    scatter(x, 0, index, k, new_x)
    scatter(x, slots, index, k, new_y)
    scatter(x, 2 * slots, index, k, new_z)


@jit(inline=True)
def place(x, index, k, new_x, new_y, new_z):
    """Write the positions of the particles index[k], …"""
    slots, i = x.shape[1], index[k]
    if is_run(index, k):
        store_wide(x, i, new_x)
        store_wide(x, slots + i, new_y)
        store_wide(x, 2 * slots + i, new_z)
    else:
        scatter_positions(x, index, k, new_x, new_y, new_z)
