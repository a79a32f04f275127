"""Motion of the colliders, and of their surfaces, in a substep."""

from math import sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_wide import wide
from xpbd_ros.sim.backend.threads import turns
from xpbd_ros.sim.contact.colliders import to_local, to_world, write_pose
from xpbd_ros.sim.geometry.quaternion import flow, product, rotate


@jit(inline=True)
def surface_motion(contacts, k, state):
    """Return the displacement of the collider's surface at contact k in this substep [m]."""
    colliders, c, i = contacts.colliders, contacts.collider[k], contacts.particle[k]
    if not (colliders.moving[c] or colliders.has_twist[c]):
        return 0.0, 0.0, 0.0
    x, y, z = state.x[0, i], state.x[1, i], state.x[2, i]
    lx, ly, lz = to_local(contacts.after, c, x, y, z)
    bx, by, bz = to_world(contacts.surface, c, lx, ly, lz)
    return x - bx, y - by, z - bz


@jit(inline=True)
def surface_motions(contacts, c, x, y, z):
    """Return the same by lanes, for vectors of positions at contacts with collider c."""
    colliders = contacts.colliders
    if not (colliders.moving[c] or colliders.has_twist[c]):
        return wide(0.0), wide(0.0), wide(0.0)
    lx, ly, lz = to_local(contacts.after, c, x, y, z)
    bx, by, bz = to_world(contacts.surface, c, lx, ly, lz)
    return x - bx, y - by, z - bz


@jit
def surface_before(contacts, c, h):
    """
    Return the pose (position, quaternion) of the surface of collider c at the substep's start.

    A surface velocity v + ω × (x - p), about the position p, is integrated backwards as a rigid
    motion, not extrapolated along its tangent.
    """
    a, b, v = contacts.before, contacts.after, contacts.colliders.twist
    if not contacts.colliders.has_twist[c]:
        return (a[c, 0], a[c, 1], a[c, 2]), (a[c, 3], a[c, 4], a[c, 5], a[c, 6])
    turn, way = flow((-h * v[c, 3], -h * v[c, 4], -h * v[c, 5]),
                     (b[c, 0] - a[c, 0] - h * v[c, 0], b[c, 1] - a[c, 1] - h * v[c, 1],
                      b[c, 2] - a[c, 2] - h * v[c, 2]))
    return ((a[c, 0] + way[0], a[c, 1] + way[1], a[c, 2] + way[2]),
            product(turn, (b[c, 3], b[c, 4], b[c, 5], b[c, 6])))


@jit
def move_colliders(contacts, team, substep):
    """Compute poses, motion and bounds of all colliders in this substep."""
    begin, end, step = turns(team, contacts.colliders.count[0])
    for c in range(begin, end, step):
        write_pose(contacts.colliders, c, substep.begin, contacts.before)
        write_pose(contacts.colliders, c, substep.end, contacts.after)
        a, b = contacts.before, contacts.after
        contacts.moved[c] = sqrt((b[c, 0] - a[c, 0])**2 + (b[c, 1] - a[c, 1])**2
                                 + (b[c, 2] - a[c, 2])**2)
        contacts.turned[c] = sqrt((b[c, 3] - a[c, 3])**2 + (b[c, 4] - a[c, 4])**2
                                  + (b[c, 5] - a[c, 5])**2 + (b[c, 6] - a[c, 6])**2)
        arm = 2.0 * max(contacts.colliders.reach[c], 0.0)
        contacts.slack[c] = max(0.0, contacts.colliders.inner[c] - contacts.moved[c]
                                - arm * contacts.turned[c])
        position, q = surface_before(contacts, c, substep.h)
        for k in range(3):
            contacts.surface[c, k] = position[k]
        for k in range(4):
            contacts.surface[c, 3 + k] = q[k]
        up = rotate(b[c, 3], b[c, 4], b[c, 5], b[c, 6], 0.0, 0.0, 1.0)
        contacts.up[c, 0], contacts.up[c, 1], contacts.up[c, 2] = up
