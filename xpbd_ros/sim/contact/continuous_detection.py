"""
Continuous collision detection: the first point of a particle's path at distance r of a collider.

In the collider's axes the path in a substep is taken as a line from l0 to l1, whichever of the two
moves. Along it the distance φ to a convex shape is a convex function, so Newton steps from
outside,

    t <- t + (φ - r) / -(n · (l1 - l0)),

never pass the first point with φ = r; if n · (l1 - l0) >= 0 there is none. Towards a mesh the
step is φ - r, towards a height field of slopes up to S it is |z - f| / √(1 + S²) - r, a lower
bound of the distance (sphere tracing, J. C. Hart 1996), but at least half a cell.

Limits: the path relative to a rotating collider is approximated by a straight line.
"""

from math import inf, sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.colliders import BOX, HEIGHTS, PLANE, to_local, to_world
from xpbd_ros.sim.contact.signed_distance import signed_distance
from xpbd_ros.sim.geometry.quaternion import rotate

CLOSE = 0.01
"""tolerance of φ - r, relative to the thickness"""
LOOKS = 64
"""most Newton steps; the point reached by then has not passed the surface"""
MOST_LOOKS = 10_000
"""most steps towards a mesh or height field; longer paths are those of implausible frames, which
are rolled back"""


@jit(inline=True)
def detect_crossing(contacts, k, x0, y0, z0, x, y, z, thickness):
    """
    Detect whether the path of candidate k meets its collider, and record the tangent plane there.

    Parameters
    ----------
    x0, y0, z0, x, y, z : particle's positions at the substep's start and now [m]
    thickness : [m]

    """
    c, gap = contacts.collider[k], contacts.gap[k]
    ax, ay, az = to_local(contacts.before, c, x0, y0, z0)
    bx, by, bz = to_local(contacts.after, c, x, y, z)
    dx, dy, dz = bx - ax, by - ay, bz - az
    shape, cell = contacts.colliders.shape[c], 2.0 * contacts.colliders.inner[c]
    size, t, looks, length = contacts.colliders.size, 0.0, 0, sqrt(dx * dx + dy * dy + dz * dz)
    while True:
        px, py, pz = ax + t * dx, ay + t * dy, az + t * dz
        if shape == HEIGHTS and leaves(px, dx, size[c, 0]) and leaves(py, dy, size[c, 1]):
            shape = PLANE    # beyond its rim, φ is linear along the path
        phi, nx, ny, nz = signed_distance(contacts.colliders, c, px, py, pz)
        nearer = -(nx * dx + ny * dy + nz * dz)
        if nearer <= 0.0 and shape <= BOX:
            return
        looks += 1
        if nearer > 0.0 and (phi - gap <= CLOSE * thickness or shape <= BOX and looks == LOOKS):
            break
        if shape <= BOX:
            t += (phi - gap) / nearer
        elif 0.0 < length < inf:
            if shape == HEIGHTS:    # φ = (z - f) n_z; it may also be on its way out
                phi = abs(phi) / (nz * size[c, 2])
            t += max(phi - gap, 0.5 * cell) / length
        else:
            return
        if not t <= 1.0 or looks == MOST_LOOKS:    # true for nan too
            return
    q = contacts.after
    wx, wy, wz = to_world(q, c, px, py, pz)
    nx, ny, nz = rotate(q[c, 3], q[c, 4], q[c, 5], q[c, 6], nx, ny, nz)
    side = contacts.side
    side[k, 0], side[k, 1], side[k, 2] = nx, ny, nz
    side[k, 3] = nx * wx + ny * wy + nz * wz - phi
    contacts.crossed[k] = 1


@jit(inline=True)
def leaves(p, d, half):
    """Tell whether a coordinate p that changes by d stays constant or beyond ±half."""
    return d == 0.0 or abs(p) >= half and p * d > 0.0
