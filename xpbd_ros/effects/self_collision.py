"""
Self-collision: cloth stays a thickness away from itself and from the other cloths of the scene.

C = n · Σ b x - r ≥ 0,   ∇C = b n,   for two points of cloths that are near each other.

With ``mode: surface`` the points are the closest ones of a particle and a triangle or of two edges
that share no particle, with ``particles`` the particles themselves. n points from the one to the
other where the substep starts, and stays through it; r is the thickness, but at most half of their
distance at rest, so that nothing pushes against the cloth's own make. Such pairs are found by
``sim.nearby`` once per frame, again where something moves further, and kept apart as unilateral
constraints with friction by ``sim.touches``; an overlap that was there before comes apart at no
more than DEPENETRATION, which leaves no velocity.

Surfaces do not pass through one another: where a substep starts, a plane across n parts the two
sides of each near pair, and what would get past it stops before (A. Chen et al., "Offset geometric
contact", 2025, bound the way itself). As the way is straight, no crossing begins within the
substep either. Planes move as what is pinned does on average, or all particles, so that cloth
falls and is carried freely.

Limits: particles alone are tight only from a thickness of about their spacing on, and pass through
faster than half of it per substep. What crosses at the start stays as it is or comes apart by
itself. Across a seam only what shares a particle is let be. A strip of one row has no surface.
What pins force through one another gets through. A stop before a plane takes momentum. The cost is
linear in particles while edges are of like length.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from xpbd_ros.errors import InputError
from xpbd_ros.sim.contacts import DEPENETRATION
from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.nearby import (
    at,
    corners,
    EDGES,
    gone,
    kept,
    length,
    Nearby,
    new_nearby,
    POINTS,
    seek,
    survey,
    TRIANGLES,
    way,
)
from xpbd_ros.sim.planes import part_sides, Planes, stop_all
from xpbd_ros.sim.stages import bound, finish, kick, prepare, react, stage, touch
from xpbd_ros.sim.state import stay
from xpbd_ros.sim.touches import calm_down, new_touches, press, push_apart, rub, Rubbing, Touches

NOT_SOUGHT = -1
"""count of pairs before the first iteration of a substep"""
SLACK = 0.25
"""of the thickness: how far pushes may move what does not move by itself"""
LISTED = 4
"""pairs listed in a search, per pair that may touch"""


@dataclass(frozen=True)
class Parameters:
    """What is kept apart, and by how much."""

    thickness: float = quantity(unit='m', above=0.0, live=True,
                                doc='distance kept between surfaces')
    mode: str = quantity('surface', choices=('surface', 'particles'),
                         doc='triangles and edges, or only particles: cheaper and thicker')
    room: int = quantity(24, minimum=1, maximum=1000, doc='pairs that may touch, per particle')


class SelfCollision(NamedTuple):
    """Data of the kernels."""

    thickness: np.ndarray
    """[m], shape (1,)"""
    near: Nearby
    touches: Touches
    planes: Planes | None
    """None where only particles are looked at"""


@stage(prepare, SelfCollision)
@jit
def forget_touches(effect, state, substep):
    """Leave the pairs of the substep before; in a new frame the list too."""
    if substep.begin == 0.0:
        effect.near.margin[0] = 0.0
        effect.near.count[:] = 0
        effect.touches.count[1] = 0
    effect.touches.count[0] = NOT_SOUGHT


@stage(touch, SelfCollision)
@jit
def keep_apart(effect, state, substep):
    """Push apart what is too near, let it rub, and stop what would get through."""
    if effect.touches.count[0] == NOT_SOUGHT or strays(effect.near, state):
        find_touches(effect, effect.near, effect.touches, state, substep)
    push_apart(effect.touches, state)
    rub(effect.touches.rubbing, effect.touches, state)


@jit
def strays(near, state):
    """Tell whether a particle got further than the pairs were sought for."""
    for i in range(len(near.slot)):
        if gone(state.x, near.x, near.step, near.slot[i], i) > near.travel[i]:
            return True
    return False


@jit
def find_touches(effect, near, touches, state, substep):
    """List the pairs that may touch in this substep, and the gap that each has to keep."""
    thickness = effect.thickness[0]
    most = survey(near, state, SLACK * thickness)
    if near.margin[0] == 0.0 or most > 0.5 * near.margin[0]:
        seek(near, thickness, (1.0 - substep.begin) / (substep.end - substep.begin))
    touches.count[0] = 0
    list_touches(effect.planes, near, near.surface, touches, touches.rubbing, state.inv_mass,
                 thickness, DEPENETRATION * substep.h)


@jit
def list_touches(planes, near, surface, touches, rubbing, w, thickness, apart):
    """List what can get within the thickness in this substep."""
    x, go, past, slot, m, kind = near.x, near.travel, near.strayed, near.slot, 0, POINTS
    for c in range(near.kind_end[2]):
        while c >= near.kind_end[kind]:
            kind += 1
        i, j, k, l = corners(surface, kind, near.first[c], near.second[c])
        if kind == EDGES:
            reach = thickness + max(go[i], go[j]) + max(go[k], go[l])
            moved = max(past[i], past[j]) + max(past[k], past[l])
        else:
            reach = thickness + go[i] + max(go[j], go[k], go[l])
            moved = past[i] + max(past[j], past[k], past[l])
        if near.distance[c] - moved >= reach:
            continue
        v, b = way(kind, x, i, j, k, l)
        distance = length(v)
        pi, pj, pk, pl = slot[i], slot[j], slot[k], slot[l]
        if distance >= reach or (w[pi] * b[0] == 0.0 and w[pj] * b[1] == 0.0
                                 and w[pk] * b[2] == 0.0 and w[pl] * b[3] == 0.0):
            continue
        # edges that are nearest at an end: a particle and a triangle say the same
        inside = kind != EDGES or b[0] > 0.0 and b[1] > 0.0 and b[2] < 0.0 and b[3] < 0.0
        near_enough = distance <= reach - thickness
        if not inside and not near_enough:
            continue
        size = distance
        if distance == 0.0:
            v = across(kind, at(x, i), at(x, j), at(x, k), at(x, l))
            size = length(v)
            if size == 0.0:
                continue
        if m == len(touches.gap):
            touches.count[1] += 1
            continue
        if near.keep[c] < 0.0:
            near.keep[c] = kept(near.cloth, near.rest, kind, thickness, i, j, k, l)
        for a in range(3):
            touches.normal[m, a] = v[a] / size
        touches.gap[m] = min(near.keep[c], distance + apart) if inside else -np.inf
        touches.overlap[m] = max(0.0, touches.gap[m] - distance)
        touches.push[m] = 0.0
        touches.particles[m, 0], touches.weight[m, 0] = pi, b[0]
        touches.particles[m, 1], touches.weight[m, 1] = pj, b[1]
        if planes is not None:
            touches.particles[m, 2], touches.weight[m, 2] = pk, b[2]
            touches.particles[m, 3], touches.weight[m, 3] = pl, b[3]
            planes.side[m] = (2 if kind == EDGES else 1) if near_enough else 0
            number = planes.number
            number[m, 0], number[m, 1], number[m, 2], number[m, 3] = i, j, k, l
        if rubbing is not None:
            for a in range(3):
                rubbing.slip[m, a] = 0.0
        m += 1
    touches.count[0] = m


@jit
def across(kind, p, q, r, s):
    """Return a direction in which a pair that meets can come apart."""
    if kind == POINTS:
        return 0.0, 0.0, 1.0
    if kind == TRIANGLES:
        u = r[0] - q[0], r[1] - q[1], r[2] - q[2]
        v = s[0] - q[0], s[1] - q[1], s[2] - q[2]
    else:
        u = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        v = s[0] - r[0], s[1] - r[1], s[2] - r[2]
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])


@stage(bound, SelfCollision)
@jit
def stop(effect, state, substep):
    """Let nothing past its planes; where colliders moved it far, look for pairs once more."""
    if strays(effect.near, state):
        find_touches(effect, effect.near, effect.touches, state, substep)
    part_sides(effect.planes, effect.near, effect.touches, state)
    stop_all(effect.planes, effect.near, state.x, state.inv_mass, state.history)


@stage(finish, SelfCollision)
@jit
def settle(effect, state, substep):
    """Take back velocities of old overlaps; move on with all particles."""
    calm_down(effect.touches, state, substep)
    for a in range(3):
        effect.near.drift[a] += effect.near.step[a]


@stage(kick, SelfCollision)
@jit
def rest_on_cloth(effect, state, substep):
    """What touches goes on as it does: the push is an impulse in every substep."""
    touches = effect.touches
    for k in range(touches.count[0]):
        if touches.push[k] > 0.0:
            for p in range(touches.particles.shape[1]):
                if touches.weight[k, p] != 0.0:
                    stay(state, touches.particles[k, p], substep.h)


@stage(react, SelfCollision)
@jit
def press_on_pins(effect, state, substep):
    """Forces on pinned particles."""
    press(effect.touches, state, substep)


class BuiltSelfCollision(Built):
    """The pairs of all cloths of a scene."""

    ns_per_particle = 1000.0

    def __init__(self, parameters: Parameters, world):
        super().__init__()
        surface = parameters.mode == 'surface'
        if surface and not any(len(cloth.mesh.triangles) for cloth in world.cloths):
            raise InputError('effects.self_collision.mode: surface needs triangles, and no cloth '
                             'has any; use particles')
        count = sum(len(cloth.slots) for cloth in world.cloths)
        room = parameters.room * count
        self.data = SelfCollision(
            np.array([parameters.thickness]), new_nearby(world.cloths, LISTED * room, surface,
                                                         kin(world)),
            new_touches(room, 4 if surface else 2), None if not surface else Planes(
                np.zeros(room, np.int64), np.zeros((room, 4), np.int64), np.zeros(count),
                np.zeros((2, 4))))

    def let_rub(self, kinetic: np.ndarray, static: np.ndarray) -> None:
        """Have friction, with μ_k and μ_s by cloth and cloth."""
        near, touches = self.data.near, self.data.touches
        cloth_of = np.zeros(near.slot.max() + 1, np.int64)
        cloth_of[near.slot] = near.cloth
        self.data = self.data._replace(touches=touches._replace(rubbing=Rubbing(
            cloth_of, kinetic, static, np.zeros((len(touches.gap), 3)))))

    def again(self):
        self.data.touches.count[0] = NOT_SOUGHT

    def reset(self, state, now_ns):
        self.again()

    def stats(self):
        touches, near = self.data.touches, self.data.near
        found = max(0, touches.count[0])
        return {'self_contacts': int((touches.push[:found] > 0.0).sum()),
                'self_pairs': int(near.kind_end[2]),
                'self_searches': int(near.count[0]),
                'self_without_room': int(near.count[1] + touches.count[1]),
                'self_stopped': int(near.count[2])}


def kin(world) -> np.ndarray | None:
    """Number particles in natural order, those that are sewn together alike."""
    seam = world.built.get('seam')
    if seam is None or seam.data is None:
        return None
    slot = np.concatenate([cloth.slots for cloth in world.cloths])
    number = np.zeros(world.slots, np.int64)
    number[slot] = np.arange(len(slot))
    pairs = number[seam.data.first], number[seam.data.second]
    joined = coo_array((np.ones(len(pairs[0])), pairs), (len(slot), len(slot)))
    return connected_components(joined, directed=False)[1].astype(np.int64)


EFFECT = Effect('self_collision', Parameters, BuiltSelfCollision)
