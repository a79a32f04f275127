"""
Self-collision: contact of cloth with itself and with other cloths, at a given thickness.

C = n · Σ b x - r ≥ 0,   ∇C = b n,   for two points of cloths that are near each other.

With ``mode: surface`` these are the closest points of a particle and a triangle, or of two edges
without a common particle; with ``particles`` they are the particles themselves. n points from one
to the other and is fixed through the substep (``self_collision.narrow_phase``); r is the
thickness, but at most half of the pair's distance at rest, so that the rest shape has no contacts.
``self_collision.neighbour_list`` finds the pairs, and those of some particles again after motions.
``self_collision.pair_contacts`` projects them as unilateral constraints with friction; an overlap
from before the substep separates at no more than DEPENETRATION, which leaves no velocity.

Surfaces do not pass through one another: the two sides of each pair in reach must be separated by
one direction through the whole substep (``self_collision.separating_planes``). Pairs that are not
are pushed apart, in turn with colliders, until both hold; where this does not converge, the
remaining particles are held back (``self_collision.motion_limit``; doc/numerics.md 8.2).

Limits: ``particles`` is tight only from a thickness of about the particle spacing on, and
particles pass through when faster than half of it per substep. Cloth that crosses at the start
stays so or separates by itself. Across a seam only pairs with a common particle are excluded. A
strip of one row has no surface. Where pins or colliders leave no room, cloth passes through and is
counted. Holding back takes momentum. The cost is linear in the particles while edges have similar
lengths.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import (
    alone,
    alone_on_device,
    assigned,
    in_first_block,
    turns,
    wait_uneven,
)
from xpbd_ros.sim.contact.contacts import Contacts, push_all
from xpbd_ros.sim.contact.corners import leave_corners
from xpbd_ros.sim.effect import Built, Effect
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.explicit_updates import stay
from xpbd_ros.sim.self_collision.creep import note_creep
from xpbd_ros.sim.self_collision.expected_work import expected_work, moved, overlap
from xpbd_ros.sim.self_collision.further_turn import (
    begin_first_turn,
    begin_turn,
    is_further_turn,
    squeeze_layers,
)
from xpbd_ros.sim.self_collision.inverse_mass import note_length
from xpbd_ros.sim.self_collision.kin import kin
from xpbd_ros.sim.self_collision.motion_limit import (
    go_share,
    hold_back,
    left_over,
    mark,
    mark_penetrating,
    rest_step,
)
from xpbd_ros.sim.self_collision.narrow_phase import find_contacts, list_planes
from xpbd_ros.sim.self_collision.near_pairs import choose_near, has_left_margins
from xpbd_ros.sim.self_collision.neighbour_list import (
    advance,
    any_thread,
    common_step,
    gone,
    load_moves,
    load_starts,
    NeighbourList,
    new_neighbour_list,
    store_moves,
    told,
    track_motion,
    TRAVEL,
)
from xpbd_ros.sim.self_collision.pair_contacts import (
    MOST_ROOM,
    new_pair_contacts,
    new_pair_friction,
    PairContacts,
    project_pairs,
    usual_room,
)
from xpbd_ros.sim.self_collision.pair_impulses import press, remove_depenetration_velocity
from xpbd_ros.sim.self_collision.pair_search import seek
from xpbd_ros.sim.self_collision.pruning import has_many_new, prune
from xpbd_ros.sim.self_collision.separating_planes import new_planes, part_all, Planes
from xpbd_ros.sim.self_collision.squeeze import new_squeeze, Squeeze
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    add_explicit_forces,
    are_inequalities_unmet,
    finish,
    limit_motion,
    prepare,
    project_inequalities,
    stage,
)

NOT_SOUGHT, SOUGHT = -1, 1
"""state of the pairs before and after the first iteration of a substep"""
SUBSTEPS = 16.0
"""substeps of the present motion for which the neighbour list has margins"""
SLACK = 0.125
"""distance that pushes may move a particle at rest, relative to the thickness"""
ROUNDS = 24
"""most rounds of pushes, which keep momentum, before particles are held back"""
TURNS = 3
"""most repetitions of holding back"""
FEWEST, FEWEST_MOVED = 4, 6
"""substeps of a frame below which more searches take the time saved; where cloth is moved"""
LISTED, NEAR = 4, 2
"""room in the neighbour list and for near pairs, per pair that may touch"""


@dataclass(frozen=True)
class Parameters:
    """The thickness, and the kind of pairs."""

    thickness: float = quantity(unit='m', above=0.0, live=True,
                                doc='distance kept between surfaces')
    mode: str = quantity('surface', choices=('surface', 'particles'),
                         doc='triangles and edges, or only particles: cheaper and thicker')
    room: int | None = quantity(None, minimum=1, maximum=MOST_ROOM,
                                doc='pairs that may touch, per particle; 24, or more where the '
                                    'thickness exceeds the particle spacing')


class SelfCollision(NamedTuple):
    """Data of the kernels."""

    thickness: np.ndarray
    """[m], shape (1,)"""
    near: NeighbourList
    pairs: PairContacts
    planes: Planes | None
    """None with ``mode: particles``"""
    contacts: Contacts | None
    """those with colliders; None in a scene without colliders"""
    squeeze: Squeeze | None
    """None in a scene without pads"""

    @property
    def most_threads(self) -> int:
        """Number of threads that may share the work: each has scratch memory."""
        return len(self.near.points.found)


@stage(prepare, SelfCollision)
@jit
def forget_pairs(effect, state, substep):
    """Discard the contacts of the last substep, and in a new frame the counts."""
    if substep.begin == 0.0:
        effect.near.count[:] = 0
        effect.pairs.count[1] = 0
    effect.pairs.count[0] = NOT_SOUGHT
    note_length(effect.near.h, substep.h)


@stage(project_inequalities, SelfCollision, shared=True)
@jit
def keep_apart(effect, state, substep):
    """Push pairs apart that are too near, and apply their friction."""
    near, pairs, team = effect.near, effect.pairs, state.team
    if is_further_turn(effect.squeeze):
        squeeze_layers(effect.squeeze, near, pairs, state, effect.thickness[0], substep.h)
        return
    begin_first_turn(team, effect.squeeze)
    if any_thread(team, near, pairs.count[0] == NOT_SOUGHT or strays(near, state)):
        common_step(near, state)
        find_pairs(effect, state, substep)
    else:
        load_moves(near, state)
        wait_uneven(team)
    if in_first_block(team):
        project_pairs(team, near, pairs)
    wait_uneven(team)
    store_moves(near, state)
    wait_uneven(team)


@stage(are_inequalities_unmet, SelfCollision)
@jit
def are_layers_unmet(effect, state, turn):
    """Tell whether pads press, so that layers between them must be solved again."""
    return alone_on_device(state.team) and begin_turn(effect.squeeze, turn)


@jit
def stir_contacts(contacts, most):
    """Tell the contacts how far pushes between cloths can still move particles."""
    if contacts is not None:
        contacts.stir[0] = most


@jit
def strays(near, state):
    """Tell whether one of this thread's particles has left the range where pairs were sought."""
    first, end, step = turns(state.team, len(near.slot))
    for i in range(first, end, step):
        if gone(state.x, near.x, near.step, near.slot[i], i) > near.x[i, TRAVEL]:
            return True
    return False


@jit
def find_pairs(effect, state, substep):
    """Find the pairs in reach in this substep."""
    near, pairs, team, thickness = effect.near, effect.pairs, state.team, effect.thickness[0]
    most, found = load_pairs(near, state, thickness)
    lost = choose_near(team, near, pairs, thickness, found)
    if alone(team):
        stir_contacts(effect.contacts, most)
        pairs.count[0] = SOUGHT
    find_contacts(team, near, effect.planes, pairs, state, substep.h)
    if lost:
        list_planes(team, near, effect.planes, thickness)


@jit
def load_pairs(near, state, thickness):
    """
    Bring the list and the records up to date.

    Returns
    -------
    longest way of a particle in this substep [m], on the main thread; True if ``near.hits`` has
    the near pairs

    """
    team = state.team
    most, leaves = track_motion(team, near, state.x, SLACK * thickness)
    if leaves:
        seek(team, near, thickness, SUBSTEPS)
    pruned = (has_left_margins(team, near, near.pruned, near.inner)
              or not leaves and has_many_new(near))
    load_starts(team, near)
    load_moves(near, state)
    wait_uneven(team)
    if pruned:
        prune(team, near, thickness)
    return most, pruned


@jit
def find_planes(effect, state):
    """Find the pairs that may pass through each other in this substep."""
    load_pairs(effect.near, state, effect.thickness[0])
    list_planes(state.team, effect.near, effect.planes, effect.thickness[0])


@stage(limit_motion, SelfCollision, shared=True)
@jit
def stop(effect, state, substep):
    """Separate pairs that would pass through one another, in turn with colliders."""
    near, planes, team = effect.near, effect.planes, state.team
    leave(effect.contacts, state)
    for turn in range(ROUNDS):
        if any_thread(team, near, strays(near, state)):
            common_step(near, state)
            find_planes(effect, state)
            if any_thread(team, near, strays(near, state)):    # no room for all pairs
                break
        if part_all(team, planes, near, state) == 0:
            return
        push_again(effect.contacts, state, turn >= ROUNDS // 2)
    give_way(team, effect, near, planes, effect.contacts, state)


@jit
def leave(contacts, state):
    """Move particles out of corners between colliders into which cloths pushed them."""
    if contacts is not None:
        leave_corners(contacts, state)


@jit
def push_again(contacts, state, eased):
    """Let colliders push particles out; when ``eased``, only as far as their surface."""
    if contacts is not None:
        push_all(contacts, state, eased)


@jit
def give_way(team, effect, near, planes, contacts, state):
    """Hold back the particles of pairs that pushes cannot separate (``motion_limit``)."""
    if planes is None:
        if alone(team):
            for i in range(len(near.slot)):
                go_share(near, state, i, 1.0)
    else:    # Numba prunes the branch that is not taken
        left = 0
        for turn in range(TURNS):
            if alone(team):
                mark_all(planes, near, contacts, state, turn > 0)
                rest_step(near, planes.held, contacts, state)
            wait_uneven(team)
            find_planes(effect, state)
            if alone(team):
                mark_all(planes, near, contacts, state, turn > 0)
                for i in range(len(near.slot)):
                    j = near.slot[i]
                    if gone(state.x, near.x, near.step, j, i) > near.x[i, TRAVEL]:
                        planes.held[j] = True
                hold_back(planes, near, state)
                left = left_over(planes, near, contacts, state)
            left = told(team, near, left)
            if left == 0:
                break
        if alone(team):
            near.count[3] += left
    wait_uneven(team)


@jit
def mark_all(planes, near, contacts, state, again):
    """Mark particles of pairs that cross; when repeated, also those behind a collider."""
    planes.held[:] = False
    planes.stays[:] = False
    if again:
        mark_penetrating(contacts, planes.stays, state)
        for j in range(len(planes.stays)):
            planes.held[j] = planes.stays[j]
    mark(planes, near, state)


@stage(finish, SelfCollision, shared=True)
@jit
def settle(effect, state, substep):
    """Remove velocities from old overlaps, update the creep, and advance the common motion."""
    near, team = effect.near, state.team
    if assigned(team, 0):
        remove_depenetration_velocity(effect.pairs, near, state, substep)
    if assigned(team, -1):
        note_creep(effect.pairs.friction, effect.pairs, near, state)
        if alone_on_device(team):
            advance(near, state)
    wait_uneven(team)


@stage(add_explicit_forces, SelfCollision)
@jit
def rest_on_cloth(effect, state, substep):
    """Particles in contact keep their velocity: pushes are impulses in every substep."""
    near, pairs = effect.near, effect.pairs
    if pairs.count[0] == SOUGHT:
        for k in range(pairs.end[0]):
            if pairs.push[k] > 0.0:
                for p in range(4):
                    i = pairs.particles[p, k]
                    if i < len(near.slot) and pairs.weight[p, k] != 0.0:
                        stay(state, near.slot[i], substep.h)


@stage(accumulate_reactions, SelfCollision, on_device=True)
@jit
def press_on_pins(effect, state, substep):
    """Forces on pinned particles."""
    press(effect.pairs, effect.near, state, substep)


class BuiltSelfCollision(Built):
    """The pairs of all cloths of a scene."""

    ns_per_particle = 37.0
    particles_per_thread, threads_pay_on_meshes = 850.0, True
    fewest_substeps = FEWEST
    explicit_velocity_lags = True

    def __init__(self, parameters: Parameters, world):
        super().__init__()
        surface = parameters.mode == 'surface'
        if surface and not any(len(cloth.mesh.triangles) for cloth in world.cloths):
            raise InputError('effects.self_collision.mode: surface needs triangles, and no cloth '
                             'has any; use particles')
        count = sum(len(cloth.slots) for cloth in world.cloths)
        room = (parameters.room or usual_room(parameters.thickness, world.cloths)) * count
        slots = np.concatenate([cloth.slots for cloth in world.cloths])
        before = world.before.get('self_collision')
        self.overlap = before.overlap if before else overlap(
            world.cloths, world.state, bool(world.sections.get('pins')))
        """share of the surface that overlaps at the scene's start"""
        self._moved = moved(world.cloths, world.travel)
        if self._moved:
            self.fewest_substeps = FEWEST_MOVED
        near = new_neighbour_list(world.cloths, LISTED * room, surface,
                                  world.state.mass[slots].mean(),
                                  kin(slots, world.built.get('seam')), world.threads,
                                  world.on_device, springs='pin' in world.built
                                  and bool(world.built['pin'].also))
        self.data = SelfCollision(
            np.array([parameters.thickness]), near,
            new_pair_contacts(NEAR * room, count, 0 if world.on_device else world.threads),
            new_planes(near.corners.shape[1], count, world.slots, world.threads)
            if surface else None, None, None)
        if 'strain_limit' in world.built:
            world.built['strain_limit'].take_turns()

    def particles_worth(self, effects, state, substeps):
        return np.count_nonzero(state.mass) * expected_work(
            self.overlap, self._moved, substeps)

    def heed(self, contacts: Contacts) -> None:
        """Take the contacts with colliders into account."""
        self.data = self.data._replace(contacts=contacts, squeeze=new_squeeze(
            contacts, len(self.data.near.slot), len(self.data.pairs.push)))

    def let_rub(self, kinetic: np.ndarray, static: np.ndarray | None) -> None:
        """Add friction, with μ_k and μ_s by pair of cloths."""
        pairs = self.data.pairs
        self.data = self.data._replace(pairs=pairs._replace(
            friction=new_pair_friction(pairs, kinetic, static)))

    def let_rub_on_colliders(self, friction: tuple) -> None:
        """Take the friction with colliders, data of that effect, into account."""
        if self.data.squeeze is not None:
            self.data = self.data._replace(squeeze=self.data.squeeze._replace(friction=friction))

    def again(self):
        self.data.pairs.count[0] = NOT_SOUGHT
        self.data.near.margin[:] = 0.0

    def reset(self, state):
        self.again()

    def read_by_stats(self):
        pairs, near = self.data.pairs, self.data.near
        return pairs.count, pairs.push, pairs.end, near.kind_begin, near.kind_end, near.count

    def stats(self):
        pairs, near = self.data.pairs, self.data.near
        sought = pairs.count[0] == SOUGHT
        return {'self_contacts': int((pairs.push[:pairs.end[0]] > 0.0).sum()) if sought else 0,
                'self_pairs': int((near.kind_end - near.kind_begin).sum()),
                'self_searches': int(near.count[0]),
                'self_without_room': int(near.count[1] + pairs.count[1]),
                'self_stopped': int(near.count[2]),
                'self_squeezed': int(near.count[3])}


EFFECT = Effect('self_collision', Parameters, BuiltSelfCollision)
