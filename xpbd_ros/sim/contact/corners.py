"""
Corners: the way out for a particle between colliders that pushes in turn do not lead out of.

Between two surfaces at an angle θ, pushes along one normal and then the other leave cos² θ of what
is too deep each time. So where a particle is left inside one, it goes along that one's normal n1,
and then, for the next that it is too deep in, along

    t = n2 - (n2 · n1) n1,   x += t s / |t|²,

which makes up for what is short there, s, and leaves the distance to the first as it is; a third
likewise. With curved surfaces the whole is repeated. Here the thickness gives way: no more is
asked for than that nothing gets in.

Limits: at less than FLAT between two surfaces there is no way out; the particle stays where it is.
"""

from math import sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.colliders import to_local
from xpbd_ros.sim.contact.signed_distance import signed_distance
from xpbd_ros.sim.geometry.closest_points import dot
from xpbd_ros.sim.geometry.quaternion import rotate
from xpbd_ros.sim.particles.history import invalidate_history

SHORT = 0.01
"""of the thickness: what is left of it where there is no room for more"""
FLAT = 0.03
"""sine of the angle between two surfaces at least, for a way out between them"""
ROUNDS = 8
"""on curved surfaces"""


@jit
def ahead(contacts, k, x, y, z):
    """Return how far a place is in front of the collider of a candidate [m], and the normal."""
    poses, c = contacts.after, contacts.collider[k]
    lx, ly, lz = to_local(poses, c, x, y, z)
    phi, nx, ny, nz = signed_distance(contacts.colliders, c, lx, ly, lz)
    nx, ny, nz = rotate(poses[c, 3], poses[c, 4], poses[c, 5], poses[c, 6], nx, ny, nz)
    if contacts.crossed[k]:
        plane = contacts.side[k]
        along = plane[0] * x + plane[1] * y + plane[2] * z - plane[3]
        if along < phi:
            return along, (plane[0], plane[1], plane[2])
    return phi, (nx, ny, nz)


@jit(inline=True)
def is_penetrating(contacts, k, state):
    """Tell whether a candidate is left inside a collider, or behind the plane it came from."""
    i = contacts.particle[k]
    phi, _ = ahead(contacts, k, state.x[0, i], state.x[1, i], state.x[2, i])
    return phi < min(0.0, contacts.gap[k] - SHORT * contacts.thickness[0])


@jit
def leave_corners(contacts, state):
    """Lead out what several colliders push, and leave inside one; return how many are left."""
    count = 0
    if contacts.count[3]:
        for k in range(contacts.count[0]):
            i = contacts.particle[k]
            if contacts.latest[i] == k and contacts.earlier[k] >= 0 and left(contacts, k, state):
                x = state.x[0, i], state.x[1, i], state.x[2, i]
                lead_out(contacts, k, i, state)
                if left(contacts, k, state):
                    count += 1
                    state.x[0, i], state.x[1, i], state.x[2, i] = x
                invalidate_history(state.history, i)
    return count


@jit
def left(contacts, k, state):
    """Tell whether a particle, whose last candidate is k, is left inside any collider."""
    while k >= 0:
        if is_penetrating(contacts, k, state):
            return True
        k = contacts.earlier[k]
    return False


@jit
def lead_out(contacts, last, i, state):
    """Move a particle in front of its colliders: those it is deepest in first, up to three."""
    for _ in range(ROUNDS):
        a, b = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for turn in range(3):
            short, n = deepest(contacts, last, state.x[0, i], state.x[1, i], state.x[2, i])
            if short <= 0.0:
                if turn == 0:
                    return
                break
            na, nb = dot(n, a), dot(n, b)
            t = (n[0] - na * a[0] - nb * b[0], n[1] - na * a[1] - nb * b[1],
                 n[2] - na * a[2] - nb * b[2])
            square = dot(t, t)
            if square < FLAT**2:
                break
            for d in range(3):
                state.x[d, i] += t[d] * short / square
            size = sqrt(square)
            a, b = (t[0] / size, t[1] / size, t[2] / size), a


@jit
def deepest(contacts, k, x, y, z):
    """Return the most that a place lacks to be in front of a collider [m], and the normal."""
    most, normal, enough = 0.0, (0.0, 0.0, 0.0), SHORT * contacts.thickness[0]
    while k >= 0:
        phi, n = ahead(contacts, k, x, y, z)
        short = min(contacts.gap[k], enough) - phi
        if short > max(most, 0.1 * enough):
            most, normal = short, n
        k = contacts.earlier[k]
    return most, normal
