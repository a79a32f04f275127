"""
Crossing: where a particle's way through a substep first comes near to a collider.

In the collider's axes the way is a line from l0 to l1, whichever of the two moves. Along it the
distance φ to a convex shape is a convex function, so Newton's step from outside,

    t <- t + (φ - r) / -(n · (l1 - l0)),

never goes past the first place where φ = r; where n · (l1 - l0) >= 0 there is none. Towards a mesh
it goes on by φ - r, towards ground of slopes up to S by |z - f| / √(1 + S²) - r, which is no more
than the distance to it (J. C. Hart, "Sphere tracing", 1996), but at least half a cell.

Limits: a turn within the substep is taken as a straight line between its ends.
"""

from math import inf, sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.colliders import BOX, HEIGHTS, to_local, to_world
from xpbd_ros.sim.contact.signed_distance import signed_distance
from xpbd_ros.sim.geometry.quaternion import rotate

CLOSE = 0.01
"""what counts as there, in parts of the thickness"""
LOOKS = 64
"""wherever it gets to with them, it has not passed the surface"""
MOST_LOOKS = 10_000
"""towards a mesh or ground: a frame in which something goes further is taken back"""


@jit(inline=True)
def look_back(contacts, k, x0, y0, z0, x, y, z, thickness):
    """If a candidate's way meets the collider, note the tangent plane that it has to respect."""
    c, gap = contacts.collider[k], contacts.gap[k]
    ax, ay, az = to_local(contacts.before, c, x0, y0, z0)
    bx, by, bz = to_local(contacts.after, c, x, y, z)
    dx, dy, dz = bx - ax, by - ay, bz - az
    shape, cell = contacts.colliders.shape[c], 2.0 * contacts.colliders.inner[c]
    t, looks, length = 0.0, 0, sqrt(dx * dx + dy * dy + dz * dz)
    while True:
        px, py, pz = ax + t * dx, ay + t * dy, az + t * dz
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
                phi = abs(phi) / (nz * contacts.colliders.size[c, 2])
            t += max(phi - gap, 0.5 * cell) / length
        else:
            return
        if not t <= 1.0 or looks == MOST_LOOKS:    # also where t is no number
            return
    q = contacts.after
    wx, wy, wz = to_world(q, c, px, py, pz)
    nx, ny, nz = rotate(q[c, 3], q[c, 4], q[c, 5], q[c, 6], nx, ny, nz)
    side = contacts.side
    side[k, 0], side[k, 1], side[k, 2] = nx, ny, nz
    side[k, 3] = nx * wx + ny * wy + nz * wz - phi
    contacts.crossed[k] = True
