"""Broad phase: candidates, the pairs of particle and collider that may touch in a substep."""

from math import sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import any_lane, both, lanes, load, root
from xpbd_ros.sim.contact.colliders import to_local
from xpbd_ros.sim.contact.contacts import DEPENETRATION
from xpbd_ros.sim.contact.pads import begin_pad
from xpbd_ros.sim.contact.signed_distance import signed_distance


@jit
def find_candidates(contacts, bounce, state, substep):
    """
    List the candidates of this substep, and the gap that each has to keep.

    ``bounce`` (``contact.restitution``, or None) receives their velocities of approach.
    """
    thickness, stir, w = contacts.thickness[0], contacts.stir[0], state.inv_mass
    contacts.count[0] = contacts.count[3] = 0
    slots = len(w)
    for q in range(0, slots, lanes(w)):
        free = load(w, q) > 0.0
        if not any_lane(free):
            continue
        x, y, z = load(state.x, q), load(state.x, slots + q), load(state.x, 2 * slots + q)
        dx, dy = x - load(state.x_prev, q), y - load(state.x_prev, slots + q)
        dz = z - load(state.x_prev, 2 * slots + q)
        step = root(dx * dx + dy * dy + dz * dz)
        for c in range(contacts.colliders.count[0]):
            bound, p, up = contacts.colliders.reach[c], contacts.after, contacts.up
            ax, ay, az = x - p[c, 0], y - p[c, 1], z - p[c, 2]
            arm = root(ax * ax + ay * ay + az * az)
            near = thickness + 2.0 * (step + stir + contacts.moved[c]
                                      + 2.0 * contacts.turned[c] * arm)
            if bound >= 0.0:
                close = arm < bound + near
            else:
                top = -1.0 - bound
                close = ax * up[c, 0] + ay * up[c, 1] + az * up[c, 2] < near + top
            if any_lane(both(free, close)):
                for i in range(q, q + lanes(w)):
                    if w[i] > 0.0:
                        check_pair(contacts, bounce, state, i, c, thickness, substep)


@jit(inline=True)
def check_pair(contacts, bounce, state, i, c, thickness, substep):
    """
    Make a pair a candidate if φ is at most the thickness plus twice their motion in this substep.

    Parameters
    ----------
    i, c : particle's slot, collider's index
    thickness : [m]

    """
    p = contacts.after
    x, y, z = state.x[0, i], state.x[1, i], state.x[2, i]
    x0, y0, z0 = state.x_prev[0, i], state.x_prev[1, i], state.x_prev[2, i]
    step = sqrt((x - x0)**2 + (y - y0)**2 + (z - z0)**2)
    arm = sqrt((x - p[c, 0])**2 + (y - p[c, 1])**2 + (z - p[c, 2])**2)
    near = thickness + 2.0 * (step + contacts.stir[0] + contacts.moved[c]
                              + 2.0 * contacts.turned[c] * arm)
    lx, ly, lz = to_local(p, c, x, y, z)
    if signed_distance(contacts.colliders, c, lx, ly, lz)[0] > near:
        return
    k = contacts.count[0]
    if k == len(contacts.particle):
        contacts.count[1] += 1
        return
    lx, ly, lz = to_local(contacts.before, c, x0, y0, z0)
    gap = signed_distance(contacts.colliders, c, lx, ly, lz)[0]
    earlier = contacts.latest[i]
    contacts.earlier[k] = -1
    if earlier < k and contacts.particle[earlier] == i:
        contacts.earlier[k] = earlier
        contacts.count[3] = 1
    contacts.latest[i] = k
    contacts.particle[k] = i
    contacts.collider[k] = c
    contacts.gap[k] = min(thickness, gap + DEPENETRATION * substep.h)
    contacts.overlap[k] = max(0.0, contacts.gap[k] - gap)
    contacts.push[k] = 0.0
    contacts.crossed[k] = False
    begin_pad(contacts.pads, contacts, k, gap, gap + DEPENETRATION * substep.h)
    for a in range(3):
        contacts.slip[k, a] = 0.0
    if bounce is not None:
        for a in range(3):
            bounce.approach[k, a] = state.v[a, i] - substep.h * state.gravity[a]
    contacts.count[0] = k + 1
