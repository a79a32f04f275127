"""
Contact: particles stay outside moving colliders: planes, solids, meshes, height fields.

C = φ(x) - r ≥ 0, with φ the signed distance to the shape.

Once per substep, after the constraints have first moved the particles, pairs in reach become
candidates. Then, in each iteration, a candidate that is too deep is pushed out along the normal n
(Müller et al. 2006, 3.4):

    Δd = max(-C, -d),   d += Δd,   x += n Δd        (d ≥ 0: the push so far, never a pull)

``when: after`` moves contact and friction to the last iteration: cheaper, but elastic constraints
then do not respond to contact within the substep.

r is the thickness. A particle that begins the substep too deep (a collider teleported into the
cloth) comes out at no more than DEPENETRATION, and the velocity that this part of the push caused
is removed at the substep's end (the aim of pre-stabilisation, Macklin et al. 2014; moving x_prev
instead leaves a velocity where another collider pushes back). Colliders move through the frame
from pose to pose and carry the cloth along.

A collider's restitution e changes the normal velocity of an approaching particle to -e times that
at the substep's end (Müller et al. 2020), unless the approach is slower than 2 g h.

A collider with a ``pad`` is an elastic foundation (``contact.pads``; doc/numerics.md 7.7):

    f = K A max(0, -C)

on a particle of rest area A, so that a squeeze has a force.

A particle that moves, relative to a collider, by more than a quarter of the collider's thickness
in a substep is followed along its way (``contact.continuous_detection``): from the first point
within r on, it stays in front of the surface's tangent plane there. So it ends on the side that it
came from, at any speed and for any thickness (doc/numerics.md 7.4 and 7.5).

The wrench of the cloth on each collider is the sum of the reactions to all displacements by
contact and friction, and to the changes of velocities at the end (``contact.impulses``).

Limits: particles are tested, not triangles, so colliders thinner than the particle spacing can
slip between them. A mesh is as sharp as its grid (``contact.distance_field``). The distance to a
height field is that to the tangent plane right below.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone, count_up, wait, wait_within
from xpbd_ros.sim.commands import MoveCollider, PlaceCollider, RemoveAllColliders, RemoveCollider
from xpbd_ros.sim.contact.broad_phase import find_candidates
from xpbd_ros.sim.contact.collider import motion_of, Placed, write_shape
from xpbd_ros.sim.contact.collider_entries import Entry, shape_of
from xpbd_ros.sim.contact.collider_motion import move_colliders
from xpbd_ros.sim.contact.collider_states import ColliderStates
from xpbd_ros.sim.contact.colliders import Colliders, new_colliders
from xpbd_ros.sim.contact.contacts import Contacts, count_penetrating, new_contacts, push_all
from xpbd_ros.sim.contact.device_search import new_marks
from xpbd_ros.sim.contact.distance_field import Field
from xpbd_ros.sim.contact.impulses import add_impulses
from xpbd_ros.sim.contact.last_iteration import begin_waiting, waits
from xpbd_ros.sim.contact.multistep_impulses import begin_multistep
from xpbd_ros.sim.contact.pads import areas, new_pads, pad_forces
from xpbd_ros.sim.contact.restitution import (
    Bounce,
    calm_overlaps,
    calm_pads,
    new_bounce,
    note_start,
    rebound,
)
from xpbd_ros.sim.contact.shape_data import for_thickness, placed_field, shape_data
from xpbd_ros.sim.contact.wrenches import bear_half_kick, begin_wrenches, sum_up, work_of_colliders
from xpbd_ros.sim.effect import Built, Effect, overdue
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.stepping.stages import (
    accumulate_impulses,
    add_explicit_forces,
    finish,
    force,
    prepare,
    project_inequalities,
    stage,
)
from xpbd_ros.sim.target_motion import delays

CANDIDATES, ON_DEVICE = 16, 4
"""room for candidates, per particle; on a GPU, where memory that is not used is taken too"""
PER_SUBSTEP, PER_PAD = 400, 1070
"""particles that a substep is worth besides, and each collider with a pad (``particles_worth``)"""
NOT_SOUGHT = -1
"""value of the count of candidates before the first iteration of a substep"""


@dataclass(frozen=True)
class Parameters:
    """The thickness, and the capacity for colliders."""

    thickness: float = quantity(unit='m', above=0.0, live=True,
                                doc='distance kept between particles and surfaces')
    when: str = quantity('sweep', choices=('sweep', 'after'),
                         doc='contact in every iteration, or in the last only')
    max_colliders: int = quantity(32, minimum=1, maximum=100_000, doc='most colliders at a time')
    mesh_nodes: int = quantity(0, minimum=0, maximum=100_000_000, doc=(
        'room for the grids of meshes that come while it runs (4 bytes each)'))


class Contact(NamedTuple):
    """Data of the kernels."""

    contacts: Contacts
    bounce: Bounce | None
    """None in a scene without restitution"""
    wait: np.ndarray | None
    """iterations done in this substep, and their number; None with ``when: sweep``"""


@stage(force, Bounce, on_device=True)
@jit
def note_velocities(bounce, state, substep):
    """Note the velocities with which particles may approach colliders."""
    note_start(bounce, state, substep.h)


@stage(prepare, Contact, shared=True)
@jit
def forget_contacts(contact, state, substep):
    """Move the colliders, and discard the pairs of the last substep."""
    if alone(state.team):
        begin_waiting(contact.wait)
        if substep.begin == 0.0:
            contact.contacts.count[1] = contact.contacts.count[4] = 0
        contact.contacts.count[0] = NOT_SOUGHT
        begin_wrenches(contact.contacts.wrenches, substep)
    move_colliders(contact.contacts, state.team, substep)
    wait_within(state.team)


@stage(project_inequalities, Contact, shared=True)
@jit
def push_out(contact, state, substep):
    """Push every candidate that is too deep out along the normal; repeat between two colliders."""
    if waits(contact.wait, state.team):
        return
    if contact.contacts.count[0] == NOT_SOUGHT:
        find_candidates(contact.contacts, contact.bounce, state, substep)
    push_all(contact.contacts, state, False)


@stage(accumulate_impulses, Contact, shared=True)
@jit
def react(contact, state, substep):
    """Add the impulses of all contacts of this substep to the colliders' wrenches."""
    add_impulses(contact.contacts, state, substep)
    wait_within(state.team)


@stage(finish, Contact, shared=True)
@jit
def calm(contact, state, substep):
    """Remove the velocity that came from separating old overlaps; apply restitution."""
    contacts = contact.contacts
    if contacts.count[3]:
        count_up(state.team, contacts.count, 4, count_penetrating(contacts, state))
    calm_overlaps(contacts, state, substep)
    rebound(contact.bounce, contacts, state, substep)
    calm_pads(contacts.pads, contacts, state, substep)
    wait(state.team)
    sum_up(contacts, state.team)


@stage(add_explicit_forces, Contact, shared=True)
@jit
def rest_on_colliders(contact, state, substep):
    """Particles in contact keep their velocity: colliders bear what would change it."""
    bear_half_kick(contact.contacts, state, substep)


class BuiltContact(Built):
    """All colliders of a scene, with room for more."""

    ns_per_particle = 7.5
    particles_per_thread = 850.0
    pulls_taut = True

    def __init__(self, parameters: Parameters, world):
        super().__init__()
        self.entries: dict[str, Entry] = world.sections.get('colliders', {})
        room = (ON_DEVICE if world.on_device else CANDIDATES) * sum(
            len(cloth.slots) for cloth in world.cloths)
        capacity = parameters.max_colliders
        if len(self.entries) > capacity:
            raise InputError(f'colliders: {len(self.entries)} colliders, but '
                             f'effects.contact.max_colliders is {capacity}; raise it')
        self.thickness = parameters.thickness
        before = world.before.get('contact')
        self.shapes, self._renewed = (
            (shape_data(self.entries, parameters.thickness, world), {}) if before is None else
            for_thickness(before.shapes, before.placed, parameters.thickness,
                          parameters.mesh_nodes))
        """distance fields and heights of the scene's entries, and fields to adopt, by name"""
        nodes = parameters.mesh_nodes + sum(
            shape.values.size for shape in self.shapes.values() if isinstance(shape, Field))
        places = sum(shape.size for shape in self.shapes.values() if not isinstance(shape, Field))
        self.scale = world.compliance_scale
        self.pads = pads = sum(entry.pad is not None for entry in self.entries.values())
        self.colliders: Colliders = new_colliders(capacity, nodes, places, pads=pads > 0)
        self.contacts = new_contacts(self.colliders, room, parameters.thickness, world.slots,
                                     1 if world.on_device else world.threads,
                                     new_pads(room, areas(world)) if pads else None,
                                     new_marks(world.slots) if world.on_device else None)
        if 'self_collision' in world.built:
            world.built['self_collision'].heed(self.contacts)
        if 'strain_limit' in world.built:
            world.built['strain_limit'].take_turns()
        bounces = any(entry.restitution > 0.0 for entry in self.entries.values())
        bounce = new_bounce(capacity, room, world.slots) if bounces else None
        self.data = Contact(self.contacts, bounce, None if parameters.when == 'sweep'
                            else np.array([0, world.iterations]))
        self.also = () if bounce is None else (bounce,)
        self.placed: dict[str, Placed] = {}
        self._fields: dict[tuple, Field] = {}    # of meshes about to be placed
        self.changes = 0
        """number of changes of the set of colliders"""

    def particles_worth(self, effects, state, substeps):
        return np.count_nonzero(state.mass) + PER_SUBSTEP + self.pads * PER_PAD

    def again(self):
        self.contacts.count[0] = NOT_SOUGHT
        self.contacts.near.valid[0] = 0
        self.contacts.wrenches.impulse[:] = 0.0
        self.forget()

    def forget(self):
        begin_multistep(self.contacts.wrenches.multistep)

    def work(self, dt):
        return work_of_colliders(self.contacts.wrenches.impulse, self.colliders, dt)

    def reset(self, state):
        self.again()
        self.placed = {}
        for name in self.entries:
            self._put(name)
        self._changed()

    def _put(self, name: str) -> None:
        """Place a collider of the scene at its initial pose."""
        entry, shape = self.entries[name], self.shapes.get(name)
        self.placed[name] = placed = Placed(entry, motion_of(entry))
        placed.field = shape if isinstance(shape, Field) else None
        placed.heights = shape if isinstance(shape, np.ndarray) else None
        placed.motion.lever = max(placed.reach, 0.0) or 1.0

    def _returns(self, command) -> bool:
        """Tell whether a command is about a removed collider of the scene that follows TF."""
        entry = self.entries.get(command.collider)
        return isinstance(command, MoveCollider) and entry is not None and bool(entry.frame)

    def adopt(self, old):
        for name, placed in old.placed.items():
            if placed.entry is old.entries.get(name):
                placed.entry = self.entries[name]
            placed.field = self._renewed.get(name)
        self.placed, self.changes = old.placed, old.changes
        self._changed()
        self.restarts = old.restarts    # the colliders have their old numbers
        for mine, its in zip(self.contacts.wrenches.multistep, old.contacts.wrenches.multistep):
            mine[...] = its

    def _changed(self) -> None:
        """Write the colliders into the kernels' arrays."""
        colliders, nodes, places = self.colliders, 0, 0
        for c, placed in enumerate(self.placed.values()):
            nodes, places = write_shape(colliders, c, placed, nodes, places)
            if self.data.bounce is not None:
                self.data.bounce.restitution[c] = placed.entry.restitution
            if colliders.stiffness is not None and colliders.depth is not None:
                pad = placed.entry.pad
                colliders.stiffness[c] = 0.0 if pad is None else pad.stiffness / self.scale
                colliders.depth[c] = placed.depth
            self._write_twist(c, placed)
            pose = placed.motion.pose
            colliders.start[c] = colliders.goal[c] = (*pose.position, *pose.orientation)
        colliders.count[0] = len(self.placed)
        self.contacts.count[0] = 0    # those found have numbers of colliders
        self.contacts.near.valid[0] = 0
        self.restarts = True    # those marked have numbers of colliders too
        self.changes += 1

    def _write_twist(self, c: int, placed: Placed) -> None:
        self.colliders.has_twist[c] = placed.twist is not None
        if placed.twist is not None:
            self.colliders.twist[c] = (*placed.twist.linear, *placed.twist.angular)

    def refusal(self, commands, state):
        nodes = {name: 0 if placed.field is None else placed.field.values.size
                 for name, placed in self.placed.items()}
        self._fields = {}
        for command in commands:
            if isinstance(command, RemoveAllColliders):
                nodes = {}
                continue
            name = command.collider
            new = name not in nodes and (isinstance(command, PlaceCollider)
                                         or self._returns(command))
            if new and len(nodes) == len(self.colliders.shape):
                return (f"collider '{name}': all {len(nodes)} colliders are in use "
                        '(effects.contact.max_colliders)')
            if isinstance(command, PlaceCollider):
                keeps = self._has_shape(command) and name not in (key[0] for key in self._fields)
                nodes[name] = nodes.get(name, 0) if keeps else 0
                if command.shape == 'mesh' and not nodes[name]:
                    try:
                        field = placed_field(command.size, self.thickness,
                                             self._nodes - sum(nodes.values()))
                    except InputError as error:
                        return f"collider '{name}': {error}"
                    self._fields[name, command.size] = field
                    nodes[name] = field.values.size
            elif new:
                shape = self.shapes.get(name)
                nodes[name] = shape.values.size if isinstance(shape, Field) else 0
                if sum(nodes.values()) > self._nodes:
                    return f"collider '{name}': other meshes have taken its room"
            elif name not in nodes:
                return f"unknown collider '{name}' (known: {', '.join(nodes) or 'none'})"
            elif isinstance(command, RemoveCollider):
                del nodes[name]
        return None

    @property
    def _nodes(self) -> int:
        """Room for the grids of meshes."""
        return 0 if self.colliders.grids is None else self.colliders.grids.values.size

    def _has_shape(self, command) -> bool:
        """Tell whether the collider of a command exists with the same shape."""
        placed = self.placed.get(command.collider)
        return placed is not None and getattr(placed.entry, command.shape) == shape_of(
            command.shape, command.size)

    def move(self, command, clock, state) -> None:
        """Set a collider's target, and the velocity of its surface if given."""
        if command.collider not in self.placed:
            self._put(command.collider)
            self._changed()
        placed, twist = self.placed[command.collider], command.twist
        placed.renew(clock.begin_ns)
        placed.motion.aim(command.pose, None, command.stamp_ns, clock.begin_ns)
        given = twist is not None and any((*twist.linear, *twist.angular))
        placed.twist = twist if given else None
        self._write_twist(list(self.placed).index(command.collider), placed)

    def place(self, command, clock, state) -> None:
        """Add a collider; an existing one takes this shape and moves to this pose."""
        name, placed = command.collider, self.placed.get(command.collider)
        shape, same = shape_of(command.shape, command.size), self._has_shape(command)
        if placed is None:
            entry = Entry(position=command.pose.position, orientation=command.pose.orientation,
                          **{command.shape: shape})
            self.placed[name] = placed = Placed(entry, motion_of(entry))
        else:
            placed.motion.aim(command.pose, None, 0, clock.begin_ns)
        placed.lifetime_ns = command.lifetime_ns
        placed.renew(clock.begin_ns)
        if not same:
            placed.entry = replace(placed.entry, **{placed.entry.shape: None,
                                                    command.shape: shape})
            placed.field, placed.heights = self._fields.get((name, command.size)), None
            placed.motion.lever = max(placed.reach, 0.0) or 1.0
            self._changed()

    def remove(self, command, clock, state) -> None:
        """Remove a collider."""
        self._remove([command.collider])

    def remove_all(self, command, clock, state) -> None:
        """Remove all colliders."""
        self._remove(list(self.placed))

    commands = {MoveCollider: move, PlaceCollider: place, RemoveCollider: remove,
                RemoveAllColliders: remove_all}

    def _remove(self, names: Iterable[str]) -> None:
        for name in names:
            del self.placed[name]
        self._changed()

    def expired(self, clock):
        return overdue(self.placed, clock)

    def only_sets_target(self, command):
        return isinstance(command, MoveCollider) and command.collider in self.placed

    def written_by_begin(self):
        colliders = self.colliders
        return (colliders.start, colliders.goal, colliders.moving, colliders.has_twist,
                colliders.twist, self.contacts.wrenches.impulse)

    def read_by_frame(self):
        return self.contacts.wrenches.impulse,

    def read_by_stats(self):
        contacts, pads = self.contacts, self.contacts.pads
        yield contacts.count
        found = max(0, contacts.count[0])    # the count is copied by now
        yield contacts.push[:found]
        if pads is not None:
            yield contacts.collider[:found]
            yield pads.force[:found]

    def begin(self, clock, state):
        gone = self.expired(clock)
        if gone:
            self._remove(gone)
        self.contacts.wrenches.impulse[:] = 0.0
        for c, placed in enumerate(self.placed.values()):
            motion = placed.motion
            motion.advance(clock.end_ns, clock.dt, clock.end_age_ns)
            start, pose = motion.start, motion.pose
            self.colliders.start[c] = (*start.position, *start.orientation)
            self.colliders.goal[c] = (*pose.position, *pose.orientation)
            self.colliders.moving[c] = start != pose

    def reported(self, frame_dt):
        colliders, count = self.colliders, len(self.placed)
        return {'colliders': ColliderStates(
            self.placed, colliders.start[:count].copy(), colliders.goal[:count].copy(),
            self.contacts.wrenches.impulse[:count], frame_dt)}

    def stats(self):
        found = max(0, self.contacts.count[0])
        grids = self.colliders.grids
        return {**({} if grids is None else {'collider_grid_bytes': grids.values.nbytes}),
                **pad_forces(self.contacts, self.placed),
                'contacts': int((self.contacts.push[:found] > 0.0).sum()),
                'contacts_without_room': int(self.contacts.count[1]),
                'contacts_squeezed': int(self.contacts.count[4]),
                'colliders': len(self.placed),
                'colliders_at_max_speed': sum(
                    placed.motion.limited for placed in self.placed.values()),
                **delays('collider_target', [each.motion for each in self.placed.values()])}


EFFECT = Effect('contact', Parameters, BuiltContact, entry=Entry)
