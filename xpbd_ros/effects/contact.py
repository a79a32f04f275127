"""
Contact: particles stay outside moving planes, spheres, capsules, cylinders and boxes.

C = φ(x) - r ≥ 0, with φ the signed distance to the shape.

Once per substep, when the constraints have first moved the particles, pairs that might touch
become candidates. Then, in each iteration, a candidate that is too deep is pushed out along the
normal n (Müller et al. 2006, 3.4):

    Δd = max(-C, -d),   d += Δd,   x += n Δd        (d ≥ 0: the push so far, never a pull)

r is the thickness. A particle that begins the substep already too deep (a collider teleported into
the cloth) comes out at no more than DEPENETRATION, and what velocity that part of the push gave
away from the surface is taken back at the substep's end (the aim of pre-stabilisation, Macklin et
al. 2014; moving x_prev instead leaves a velocity where another collider pushes back). Colliders
move through the frame from pose to pose and carry the cloth along.

A particle that moves, relative to a collider, more than a quarter of the collider's thickness in
a substep is followed on its way (``sim.crossing``): where that first comes within r, the surface's
tangent plane is what it stays in front of. So it ends on the side that it came from, however fast
either is and however thin the collider.

Limits: particles are tested, not triangles, so what is thinner than the spacing of particles can
slip between them.
"""

from dataclasses import dataclass, field
from math import sqrt
from typing import NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim import colliders as shapes
from xpbd_ros.sim.colliders import Colliders, signed_distance, to_local
from xpbd_ros.sim.commands import MoveCollider, Pose
from xpbd_ros.sim.contacts import Contacts, move_colliders, new_contacts, surface_motion
from xpbd_ros.sim.crossing import look_back
from xpbd_ros.sim.effect import Built, Effect, quantity
from xpbd_ros.sim.jit import jit
from xpbd_ros.sim.motion import check_motion, monotone_cubic, Motion
from xpbd_ros.sim.rotation import from_z_axis, multiply, rotate
from xpbd_ros.sim.stages import finish, prepare, stage, touch
from xpbd_ros.sim.state import lose_history
from xpbd_ros.sim.vector import any_lane, both, lanes, load, root

DEPENETRATION = 1.0
"""speed at which an overlap that was there before is undone [m/s]"""
CANDIDATES = 4
"""room for candidates, per particle"""
NOT_SOUGHT = -1
"""count of candidates before the first iteration of a substep"""


@dataclass(frozen=True)
class Parameters:
    """The gap kept, and the room for colliders."""

    thickness: float = quantity(unit='m', above=0.0, live=True,
                                doc='distance kept between particles and surfaces')
    max_colliders: int = quantity(32, minimum=1, maximum=100_000, doc='capacity')


@dataclass(frozen=True)
class Plane:
    """The half space below a plane."""

    normal: tuple[float, float, float] = quantity((0.0, 0.0, 1.0), doc='pointing out of it')

    def __post_init__(self):
        """Refuse a direction that is none."""
        if not any(self.normal):
            raise InputError('normal: must not be zero')


@dataclass(frozen=True)
class Sphere:
    """A ball."""

    radius: float = quantity(unit='m', above=0.0)


@dataclass(frozen=True)
class Capsule:
    """A ball swept along z."""

    radius: float = quantity(unit='m', above=0.0)
    length: float = quantity(unit='m', minimum=0.0, doc='between the centres')


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along z."""

    radius: float = quantity(unit='m', above=0.0)
    length: float = quantity(unit='m', above=0.0)


@dataclass(frozen=True)
class Box:
    """A box."""

    size: tuple[float, float, float] = quantity(unit='m', above=0.0, doc='full extents')


@dataclass(frozen=True)
class Entry:
    """One entry of the scene's ``colliders``: exactly one shape, and where it is."""

    plane: Plane | None = quantity(None)
    sphere: Sphere | None = quantity(None)
    capsule: Capsule | None = quantity(None)
    cylinder: Cylinder | None = quantity(None)
    box: Box | None = quantity(None)
    position: tuple[float, float, float] = quantity((0.0, 0.0, 0.0), unit='m')
    orientation: tuple[float, float, float, float] = quantity((0.0, 0.0, 0.0, 1.0),
                                                              doc='quaternion x y z w')
    friction: float = quantity(0.5, minimum=0.0, live=True, doc='coefficient μ')
    motion: tuple[tuple[float, ...], ...] | None = quantity(
        None, unit='s, m', doc='points t, x, y, z, joined by monotone cubics')
    max_speed: float = quantity(5.0, unit='m/s', above=0.0, doc='it follows no faster')

    def __post_init__(self):
        """Refuse no shape and two shapes."""
        given = [name for name in SHAPES if getattr(self, name) is not None]
        if len(given) != 1:
            raise InputError(f'needs exactly one shape of {", ".join(SHAPES)} '
                             f'(got {", ".join(given) or "none"})')
        check_motion(self.motion)

    @property
    def shape(self) -> str:
        """The name of its shape."""
        return next(name for name in SHAPES if getattr(self, name) is not None)

    @property
    def pose(self) -> Pose:
        """Where it is at the start; a plane's normal is its z axis."""
        n = sqrt(sum(c * c for c in self.orientation))
        orientation = tuple(c / n for c in self.orientation)
        if self.plane is not None:
            orientation = multiply(orientation, from_z_axis(self.plane.normal))
        return Pose(self.position, orientation)


SHAPES = {'plane': shapes.PLANE, 'sphere': shapes.SPHERE, 'capsule': shapes.CAPSULE,
          'cylinder': shapes.CYLINDER, 'box': shapes.BOX}


def shape_size(entry: Entry) -> tuple[float, float, float]:
    """Return the numbers that the kernels want of a shape."""
    if entry.sphere is not None:
        return entry.sphere.radius, 0.0, 0.0
    if entry.box is not None:
        return tuple(0.5 * c for c in entry.box.size)
    if entry.plane is not None:
        return 0.0, 0.0, 0.0
    tube = entry.capsule or entry.cylinder
    return tube.radius, 0.5 * tube.length, 0.0


class Contact(NamedTuple):
    """Data of the kernels."""

    contacts: Contacts
    thickness: np.ndarray
    """[m], shape (1,)"""


@stage(prepare, Contact)
@jit
def forget_contacts(contact, state, substep):
    """Move the colliders, and leave the pairs of the substep before."""
    if substep.begin == 0.0:
        contact.contacts.count[1] = 0
    contact.contacts.count[0] = NOT_SOUGHT
    move_colliders(contact.contacts, substep)


@jit
def find_candidates(contact, state, substep):
    """List the pairs that may touch in this substep, and the gap that each has to keep."""
    contacts, thickness, w = contact.contacts, contact.thickness[0], state.inv_mass
    contacts.count[0] = 0
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
            near = thickness + 2.0 * (step + contacts.moved[c] + 2.0 * contacts.turned[c] * arm)
            if bound >= 0.0:
                close = arm < bound + near
            else:
                close = ax * up[c, 0] + ay * up[c, 1] + az * up[c, 2] < near
            if any_lane(both(free, close)):
                for i in range(q, q + lanes(w)):
                    if w[i] > 0.0:
                        consider(contacts, state, i, c, thickness, substep)


@jit(inline=True)
def consider(contacts, state, i, c, thickness, substep):
    """Make a pair a candidate if it is within twice what both may move in this substep."""
    p = contacts.after
    x, y, z = state.x[0, i], state.x[1, i], state.x[2, i]
    x0, y0, z0 = state.x_prev[0, i], state.x_prev[1, i], state.x_prev[2, i]
    step = sqrt((x - x0)**2 + (y - y0)**2 + (z - z0)**2)
    arm = sqrt((x - p[c, 0])**2 + (y - p[c, 1])**2 + (z - p[c, 2])**2)
    near = thickness + 2.0 * (step + contacts.moved[c] + 2.0 * contacts.turned[c] * arm)
    lx, ly, lz = to_local(p, c, x, y, z)
    if signed_distance(contacts.colliders, c, lx, ly, lz)[0] > near:
        return
    k = contacts.count[0]
    if k == len(contacts.particle):
        contacts.count[1] += 1
        return
    lx, ly, lz = to_local(contacts.before, c, x0, y0, z0)
    gap = signed_distance(contacts.colliders, c, lx, ly, lz)[0]
    contacts.particle[k] = i
    contacts.collider[k] = c
    contacts.gap[k] = min(thickness, gap + DEPENETRATION * substep.h)
    contacts.overlap[k] = max(0.0, contacts.gap[k] - gap)
    contacts.push[k] = 0.0
    contacts.crossed[k] = False
    for a in range(3):
        contacts.slip[k, a] = 0.0
    contacts.count[0] = k + 1


@stage(touch, Contact)
@jit
def push_out(contact, state, substep):
    """Push every candidate that is too deep out along the normal."""
    contacts, poses = contact.contacts, contact.contacts.after
    if contacts.count[0] == NOT_SOUGHT:
        find_candidates(contact, state, substep)
    for k in range(contacts.count[0]):
        i, c = contacts.particle[k], contacts.collider[k]
        x, y, z = state.x[0, i], state.x[1, i], state.x[2, i]
        x0, y0, z0 = state.x_prev[0, i], state.x_prev[1, i], state.x_prev[2, i]
        step = (x - x0)**2 + (y - y0)**2 + (z - z0)**2
        if not contacts.crossed[k] and step >= contacts.slack[c]**2:
            look_back(contacts, k, x0, y0, z0, x, y, z, contact.thickness[0])
        lx, ly, lz = to_local(poses, c, x, y, z)
        phi, nx, ny, nz = signed_distance(contacts.colliders, c, lx, ly, lz)
        nx, ny, nz = rotate(poses[c, 3], poses[c, 4], poses[c, 5], poses[c, 6], nx, ny, nz)
        if contacts.crossed[k]:
            plane = contacts.side[k]
            ahead = plane[0] * x + plane[1] * y + plane[2] * z - plane[3]
            if ahead < phi:
                phi, nx, ny, nz = ahead, plane[0], plane[1], plane[2]
        before = contacts.push[k]
        push = max(contacts.gap[k] - phi, -before)
        if push == 0.0:
            continue
        contacts.push[k] = before + push
        state.x[0, i] += nx * push
        state.x[1, i] += ny * push
        state.x[2, i] += nz * push
        contacts.normal[k, 0], contacts.normal[k, 1], contacts.normal[k, 2] = nx, ny, nz
        lose_history(state.history, i)


@stage(finish, Contact)
@jit
def calm(contact, state, substep):
    """Take back the velocity that came from undoing an old overlap, down to the surface's own."""
    contacts, v, n, h = contact.contacts, state.v, contact.contacts.normal, substep.h
    for k in range(contacts.count[0]):
        still = min(contacts.overlap[k], contacts.push[k])
        if still == 0.0:
            continue
        i = contacts.particle[k]
        ux, uy, uz = surface_motion(contacts, k, state, substep)
        away = ((v[0, i] - ux / h) * n[k, 0] + (v[1, i] - uy / h) * n[k, 1]
                + (v[2, i] - uz / h) * n[k, 2])
        excess = min(away, still / h)
        if excess > 0.0:
            for a in range(3):
                v[a, i] -= excess * n[k, a]


@dataclass(frozen=True)
class ColliderState:
    """One collider after a frame."""

    entry: Entry
    pose: Pose
    linear: np.ndarray = field(compare=False)
    """velocity [m/s], shape (3,)"""


class BuiltContact(Built):
    """All colliders of a scene."""

    def __init__(self, parameters: Parameters, world):
        super().__init__()
        self.entries: dict[str, Entry] = world.sections.get('colliders', {})
        room = CANDIDATES * sum(len(cloth.slots) for cloth in world.cloths)
        capacity = parameters.max_colliders
        if len(self.entries) > capacity:
            raise InputError(f'colliders: {len(self.entries)} colliders, but '
                             f'effects.contact.max_colliders is {capacity}; raise it')
        poses = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (capacity, 1))
        colliders = Colliders(
            np.array([len(self.entries)]), np.zeros(capacity, np.int64), np.zeros((capacity, 3)),
            np.zeros(capacity), np.zeros(capacity),
            poses.copy(), poses.copy(), np.zeros(capacity, np.bool_), np.zeros((capacity, 6)),
            np.zeros(capacity, np.bool_),
            np.zeros(capacity))
        for c, entry in enumerate(self.entries.values()):
            colliders.shape[c] = SHAPES[entry.shape]
            colliders.size[c] = shape_size(entry)
            colliders.reach[c] = shapes.reach(colliders.shape[c], colliders.size[c])
            colliders.inner[c] = shapes.inner(colliders.shape[c], colliders.size[c])
            colliders.friction[c] = entry.friction
        self.colliders = colliders
        self.contacts = new_contacts(colliders, room)
        self.data = Contact(self.contacts, np.array([parameters.thickness]))
        self.commands = {MoveCollider: self.move}
        self.motions: dict[str, Motion] = {}

    def reset(self, state, now_ns):
        self.motions = {name: self._motion(entry, now_ns * 1e-9)
                        for name, entry in self.entries.items()}
        self.colliders.has_twist[:] = False
        for c, motion in enumerate(self.motions.values()):
            pose = (*motion.pose.position, *motion.pose.orientation)
            self.colliders.start[c] = self.colliders.goal[c] = pose

    def adopt(self, old):
        self.motions = old.motions
        for ours, theirs in zip(self.colliders[5:10], old.colliders[5:10]):
            ours[:] = theirs

    @staticmethod
    def _motion(entry: Entry, now: float) -> Motion:
        keyframes, pose = None, entry.pose
        if entry.motion is not None:
            keyframes = monotone_cubic(entry.motion, now)
            pose = Pose(keyframes(now), pose.orientation)
        lever = shapes.reach(SHAPES[entry.shape], shape_size(entry))
        return Motion(pose, entry.max_speed, keyframes=keyframes,
                      lever=lever if lever > 0.0 else 1.0)

    def move(self, command, clock, state) -> str | None:
        """Set where a collider goes, and the velocity of its surface where that is given."""
        if command.collider not in self.motions:
            return (f"unknown collider '{command.collider}' "
                    f'(known: {", ".join(self.motions) or "none"})')
        self.motions[command.collider].aim(command.pose, None, command.stamp_ns, clock.begin_ns)
        c = list(self.motions).index(command.collider)
        twist = command.twist
        moving = twist is not None and any((*twist.linear, *twist.angular))
        self.colliders.has_twist[c] = moving
        if moving:
            self.colliders.twist[c] = (*twist.linear, *twist.angular)
        return None

    def begin(self, clock, state):
        for c, motion in enumerate(self.motions.values()):
            motion.advance(clock.end_ns, clock.dt)
            start, pose = motion.start, motion.pose
            self.colliders.start[c] = (*start.position, *start.orientation)
            self.colliders.goal[c] = (*pose.position, *pose.orientation)
            self.colliders.moving[c] = start != pose

    def states(self, dt: float) -> dict[str, ColliderState]:
        """Return where the colliders are now."""
        return {name: ColliderState(
            self.entries[name], motion.pose,
            np.subtract(motion.pose.position, motion.start.position) / dt)
            for name, motion in self.motions.items()}

    def stats(self):
        return {'contacts': int((self.contacts.push[:max(0, self.contacts.count[0])] > 0.0).sum()),
                'contacts_without_room': int(self.contacts.count[1]),
                'colliders_at_max_speed': sum(m.limited for m in self.motions.values())}


EFFECT = Effect('contact', Parameters, BuiltContact, entry=Entry)
