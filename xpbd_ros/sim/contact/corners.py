"""
Joint projection of a particle that alternating projections leave inside one of its colliders.

For two surfaces at an angle θ, one projection along each normal leaves cos² θ of the penetration.
A particle that is left inside is therefore moved along the normal n1 of the collider that it is
deepest in, and then, for the next deepest one with penetration s and normal n2, along

    t = n2 - (n2 · n1) n1,   x += t s / |t|²,

which removes s and keeps the distance to the first one; a third collider likewise. For curved
surfaces the procedure is repeated. The thickness is relaxed to SHORT of it: the aim is to prevent
penetration.

Limits: if the sine of the angle between two normals is below FLAT the particle is not moved.
"""

from math import sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_wide import WIDTH
from xpbd_ros.sim.backend.threads import alone, count_up, wait, worker, workers
from xpbd_ros.sim.contact.colliders import is_on_pad, to_local
from xpbd_ros.sim.contact.pieces import candidate, rounds
from xpbd_ros.sim.contact.signed_distance import signed_distance
from xpbd_ros.sim.contact.wrenches import add_reaction
from xpbd_ros.sim.geometry.closest_points import dot
from xpbd_ros.sim.geometry.quaternion import rotate
from xpbd_ros.sim.particles.history import invalidate_history

SHORT = 0.01
"""relaxed gap between several colliders, relative to the thickness"""
FLAT = 0.03
"""least sine of the angle between two surfaces that are projected on jointly"""
ROUNDS = 8
"""most repetitions, for curved surfaces"""


@jit
def contact_distance(contacts, k, x, y, z):
    """
    Return the signed distance of a point to the collider of candidate k [m], and the normal.

    If the candidate's path crosses the collider (``crossed``), it is at most the distance to the
    tangent plane where it does.
    """
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
    """Return True if candidate k is inside its rigid collider or behind its tangent plane."""
    i = contacts.particle[k]
    if is_on_pad(contacts.pads, k):
        return False
    phi, _ = contact_distance(contacts, k, state.x[0, i], state.x[1, i], state.x[2, i])
    return phi < min(0.0, contacts.gap[k] - SHORT * contacts.thickness[0])


@jit
def leave_corners(contacts, state):
    """Project jointly the particles left inside one of several colliders."""
    team = state.team
    if contacts.count[3] == 0:
        return
    found = 0
    for k in range(worker(team), contacts.count[0], workers(team)):
        i = contacts.particle[k]
        if (contacts.latest[i] == k and contacts.earlier[k] >= 0
                and penetrates_any(contacts, k, state)):
            found = 1
            x = state.x[0, i], state.x[1, i], state.x[2, i]
            project_jointly(contacts, k, i, state, False)
            helps = not penetrates_any(contacts, k, state)
            state.x[0, i], state.x[1, i], state.x[2, i] = x
            if helps:
                project_jointly(contacts, k, i, state, True)
            invalidate_history(state.history, i)
    note_extra(contacts, team, found)
    wait(team)


@jit(inline=True)
def add_later(contacts, k, x, y, z):
    """Add to ``extra`` of candidate k, which another thread of a GPU may have."""
    contacts.extra[k, 0] += x
    contacts.extra[k, 1] += y
    contacts.extra[k, 2] += z


@jit(inline=True)
def note_extra(contacts, team, found):
    """Note whether this thread has added to ``extra``."""
    if found:
        count_up(team, contacts.count, 5, 1)


@jit
def add_extra(contacts, state):
    """Add the impulses ``extra`` to the wrenches."""
    team = state.team
    if contacts.count[5]:
        for c in range(contacts.colliders.count[0]):
            begin, last = contacts.first[c], contacts.first[c + 1]
            for n in range(rounds(team, begin, last)):
                first = candidate(team, n, begin)
                for k in range(first, min(first + WIDTH, last)):
                    x, y, z = contacts.extra[k, 0], contacts.extra[k, 1], contacts.extra[k, 2]
                    if x != 0.0 or y != 0.0 or z != 0.0:
                        add_reaction(contacts, k, state, contacts.particle[k], x, y, z)
                        for a in range(3):
                            contacts.extra[k, a] = 0.0
        wait(team)    # until all have read the count
        if alone(team):
            contacts.count[5] = 0


@jit
def penetrates_any(contacts, k, state):
    """Return True if the particle whose last candidate is k penetrates any of its colliders."""
    while k >= 0:
        if is_penetrating(contacts, k, state):
            return True
        k = contacts.earlier[k]
    return False


@jit
def project_jointly(contacts, last, i, state, reacts):
    """
    Project particle i, whose last candidate is ``last``, on up to three colliders jointly.

    If ``reacts``, the impulse of each is added to ``extra``.
    """
    for _ in range(ROUNDS):
        a, b = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for turn in range(3):
            k, short, n = deepest(contacts, last, state.x[0, i], state.x[1, i], state.x[2, i])
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
            if reacts:
                f = contacts.wrenches.h[0] / state.mobility[i] * (short / square)
                add_later(contacts, k, f * t[0], f * t[1], f * t[2])
            size = sqrt(square)
            a, b = (t[0] / size, t[1] / size, t[2] / size), a


@jit
def deepest(contacts, k, x, y, z):
    """Return the candidate with the largest deficit of the relaxed gap, that [m], its normal."""
    most, normal, enough, found = 0.0, (0.0, 0.0, 0.0), SHORT * contacts.thickness[0], -1
    while k >= 0:
        phi, n = contact_distance(contacts, k, x, y, z)
        short = min(contacts.gap[k], enough) - phi
        if is_on_pad(contacts.pads, k):
            short = 0.0
        if short > max(most, 0.1 * enough):
            most, normal, found = short, n, k
        k = contacts.earlier[k]
    return found, most, normal
