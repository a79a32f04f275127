"""
Self-collision: cloth stays a thickness away from itself and from the other cloths of the scene.

C = n · Σ b x - r ≥ 0,   ∇C = b n,   for two points of cloths that are near each other.

With ``mode: surface`` the points are the closest ones of a particle and a triangle or of two edges
that share no particle, with ``particles`` the particles themselves. n points from the one to the
other and stays through the substep (``self_collision.narrow_phase``); r is the thickness, but at
most half of their distance at rest, so that nothing pushes against the cloth's own make. Such
pairs are found by ``self_collision.neighbour_list`` once per frame, again where something moves
further, and kept apart as unilateral constraints with friction by
``self_collision.pair_contacts``; an overlap that was there before comes apart at no more than
DEPENETRATION, which leaves no velocity.

Surfaces do not pass through one another: each pair that could must part along one direction
through the whole substep (``self_collision.separating_planes``). What would not is pushed apart,
in turn with what colliders push, until both are content; where that does not come to an end, what
is left is held back (``self_collision.motion_limit``).

Limits: particles alone are tight only from a thickness of about their spacing on, and pass through
faster than half of it per substep. What crosses at the start stays as it is or comes apart by
itself. Across a seam only what shares a particle is let be. A strip of one row has no surface.
What pins or colliders leave no room for gets through, and is counted. Holding back takes momentum.
The cost is linear in particles while edges are of like length.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.contact.contacts import Contacts, DEPENETRATION, push_all
from xpbd_ros.sim.contact.corners import leave_corners
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.explicit_updates import stay
from xpbd_ros.sim.self_collision.motion_limit import (
    go_share,
    hold_back,
    left_over,
    mark,
    mark_penetrating,
    rest_step,
)
from xpbd_ros.sim.self_collision.narrow_phase import list_candidates
from xpbd_ros.sim.self_collision.neighbour_list import (
    common_step,
    gone,
    NeighbourList,
    new_neighbour_list,
    seek,
    track_motion,
)
from xpbd_ros.sim.self_collision.pair_contacts import (
    new_pair_contacts,
    PairContacts,
    PairFriction,
    press,
    push_apart,
    remove_depenetration_velocity,
    rub,
)
from xpbd_ros.sim.self_collision.separating_planes import new_planes, part_sides, Planes
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    add_explicit_forces,
    finish,
    limit_motion,
    prepare,
    project_inequalities,
    stage,
)

NOT_SOUGHT = -1
"""count of pairs before the first iteration of a substep"""
SLACK = 0.25
"""of the thickness: how far pushes may move what does not move by itself"""
ROUNDS = 24
"""in which pushes that keep momentum must part all pairs"""
TURNS = 3
"""in which what is left is held back, as seen from what gets in the way"""
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
    near: NeighbourList
    touches: PairContacts
    planes: Planes | None
    """None where only particles are looked at"""
    contacts: Contacts | None
    """with colliders; None in a scene without"""


@stage(prepare, SelfCollision)
@jit
def forget_touches(effect, state, substep):
    """Leave the pairs of the substep before; in a new frame the list too."""
    if substep.begin == 0.0:
        effect.near.margin[0] = 0.0
        effect.near.count[:] = 0
        effect.touches.count[1] = 0
    effect.touches.count[0] = NOT_SOUGHT


@stage(project_inequalities, SelfCollision)
@jit
def keep_apart(effect, state, substep):
    """Push apart what is too near, and let it rub."""
    if effect.touches.count[0] == NOT_SOUGHT or strays(effect.near, state):
        common_step(effect.near, state)
        stir_contacts(effect.contacts, find_pairs(effect, state, substep, True))
    push_apart(effect.touches, state)
    rub(effect.touches.rubbing, effect.touches, state)


@jit
def stir_contacts(contacts, most):
    """Let contacts reckon with what pushes between cloths can still do."""
    if contacts is not None:
        contacts.stir[0] = most


@jit
def strays(near, state):
    """Tell whether a particle got further than the pairs were sought for."""
    for i in range(len(near.slot)):
        if gone(state.x, near.x, near.step, near.slot[i], i) > near.travel[i]:
            return True
    return False


@jit
def find_pairs(effect, state, substep, both):
    """Find what can get near in this substep; return the furthest that a particle may get."""
    near, touches, thickness = effect.near, effect.touches, effect.thickness[0]
    most, side = track_motion(near, state.x, SLACK * thickness)
    if near.margin[0] == 0.0 or side > 0.5 * near.margin[0]:
        seek(near, thickness, (1.0 - substep.begin) / (substep.end - substep.begin))
    list_candidates(near, near.surface, effect.planes, touches, touches.rubbing, state, thickness,
               DEPENETRATION * substep.h, both)
    return most


@stage(limit_motion, SelfCollision)
@jit
def stop(effect, state, substep):
    """Let nothing through: push apart what would get there, in turn with what colliders push."""
    near, planes = effect.near, effect.planes
    leave(effect.contacts, state)
    for turn in range(ROUNDS):
        if strays(near, state):
            common_step(near, state)
            find_pairs(effect, state, substep, False)
            if strays(near, state):    # there is no room for all pairs
                break
        if part_sides(planes, near, state) == 0:
            return
        push_again(effect.contacts, state, turn >= ROUNDS // 2)
    give_way(effect, near, planes, effect.contacts, state, substep)


@jit
def leave(contacts, state):
    """Lead out what cloths have pushed into a corner between colliders."""
    if contacts is not None:
        leave_corners(contacts, state)


@jit
def push_again(contacts, state, eased):
    """Let colliders push out what was pushed into them; at last only so far that it is out."""
    if contacts is not None:
        push_all(contacts, state, eased)


@jit
def give_way(effect, near, planes, contacts, state, substep):
    """Hold back what pushes cannot part, as seen from what it rests on."""
    if planes is None:
        for i in range(len(near.slot)):
            go_share(near, state, i, 1.0)
    else:    # Numba prunes the branch that is not taken
        left = 0
        for turn in range(TURNS):
            mark_all(planes, near, contacts, state, turn > 0)
            rest_step(near, planes.held, contacts, state, substep)
            find_pairs(effect, state, substep, False)
            mark_all(planes, near, contacts, state, turn > 0)
            for i in range(len(near.slot)):
                j = near.slot[i]
                if gone(state.x, near.x, near.step, j, i) > near.travel[i]:
                    planes.held[j] = True
            hold_back(planes, near, state)
            left = left_over(planes, near, contacts, state)
            if left == 0:
                break
        near.count[3] += left


@jit
def mark_all(planes, near, contacts, state, again):
    """Mark what does not part; and, if that has been tried before, what is behind a collider."""
    planes.held[:] = False
    planes.stays[:] = False
    if again:
        mark_penetrating(contacts, planes.stays, state)
        for j in range(len(planes.stays)):
            planes.held[j] = planes.stays[j]
    mark(planes, near, state)


@stage(finish, SelfCollision)
@jit
def settle(effect, state, substep):
    """Take back velocities of old overlaps; move on with all particles."""
    remove_depenetration_velocity(effect.touches, state, substep)
    for a in range(3):
        effect.near.drift[a] += effect.near.step[a]


@stage(add_explicit_forces, SelfCollision)
@jit
def rest_on_cloth(effect, state, substep):
    """What touches goes on as it does: the push is an impulse in every substep."""
    touches = effect.touches
    for k in range(touches.count[0]):
        if touches.push[k] > 0.0:
            for p in range(touches.particles.shape[1]):
                if touches.weight[k, p] != 0.0:
                    stay(state, touches.particles[k, p], substep.h)


@stage(accumulate_reactions, SelfCollision)
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
            np.array([parameters.thickness]),
            new_neighbour_list(world.cloths, LISTED * room, surface, kin(world)),
            new_pair_contacts(room, 4 if surface else 2),
            new_planes(LISTED * room, count, world.slots) if surface else None, None)
        if 'strain_limit' in world.built:
            world.built['strain_limit'].take_turns()

    def heed(self, contacts: Contacts) -> None:
        """Let nothing through colliders either."""
        self.data = self.data._replace(contacts=contacts)

    def let_rub(self, kinetic: np.ndarray, static: np.ndarray) -> None:
        """Have friction, with μ_k and μ_s by cloth and cloth."""
        near, touches = self.data.near, self.data.touches
        cloth_of = np.zeros(near.slot.max() + 1, np.int64)
        cloth_of[near.slot] = near.cloth
        self.data = self.data._replace(touches=touches._replace(rubbing=PairFriction(
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
                'self_stopped': int(near.count[2]),
                'self_squeezed': int(near.count[3])}


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
