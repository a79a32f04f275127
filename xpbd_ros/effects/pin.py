"""
Pin: a named set of particles held at a moving target, as a gripper holds cloth.

A pinned particle has inv_mass 0, so no constraint moves it. Each substep it is placed at
x = p + R q, p, R the pin's pose, interpolated through the frame, q its offset in the pin's axes,
kept from the grasp: it has a velocity, and turns with the pin. A release restores inv_mass.

A pin with a compliance α holds each of its n particles by a spring of compliance n α to that
place, so the whole pin gives way by α per newton. The spring is part of the particle's own
implicit step: with mobility m = w H², before any constraint moves it,

    x += m / (m + n α) (p + R q - x),   m <- m n α / (m + n α),

the exact minimum of both energies; α → 0 gives m = 0, a rigid pin. With ``explicit`` it is
Newmark's mean of three positions instead, of second order (doc/numerics.md 6.3).

A pin with a slip force releases at the end of a frame in which the cloth pulled harder than that.

The wrench that the cloth exerts on a pin is Σ f + Σ m (g - a - rate v) over its particles, with f
the constraint forces (mean over the frame), a and v the acceleration and the mean velocity that
the pin imposes, rate that of ``damping``; the torque is about the pin's position, in world axes,
with the arms R q of the middle of the frame. With springs it is Σ f, which includes the particles'
weight and damping.
Under an integrator with a history, a force acts on velocities over several substeps: with its
weights a and b (``particles.history``), the impulse of a force f in substep n is

    J_n = H f + a J_{n-1} - b J_{n-2}.

So f is the mean of J / h; pins and weight give the cloth its momentum (doc/numerics.md 6.3).

Limits: no cloth and no collider stops a pin, and its velocity jumps between frames. Particles on
the springs of a compliant pin count as free: colliders push them, and tethers do not start there.
Cloth does not slide within a pin: it is held or released.
"""

from dataclasses import dataclass

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import turns_on_device
from xpbd_ros.sim.commands import Click, Grasp, MovePin, Pose, Release, ReleaseAll
from xpbd_ros.sim.effect import Built, Effect, overdue
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.geometry.quaternion import conjugate, rotate
from xpbd_ros.sim.parameters import quantity
from xpbd_ros.sim.particles.history import weights_at
from xpbd_ros.sim.particles.state import places
from xpbd_ros.sim.pins.entry import Entry
from xpbd_ros.sim.pins.held_places import Pin, place_of
from xpbd_ros.sim.pins.picking import nearest_particle, Picking, unused_name, within
from xpbd_ros.sim.pins.springs import Spring
from xpbd_ros.sim.pins.states import chosen, Held, list_particles, PinStates, rows
from xpbd_ros.sim.pins.wrenches import deliver, weigh_pinned, weigh_springs, work_of
from xpbd_ros.sim.stepping.stages import (
    accumulate_reactions,
    prepare,
    react_to_half_kick,
    stage,
)
from xpbd_ros.sim.target_motion import delays, MonotoneCubic, Motion


@dataclass(frozen=True)
class Parameters:
    """The capacity, and defaults for pins without keys of their own."""

    max_pins: int = quantity(16, minimum=1, maximum=10_000, doc='most pins at a time')
    compliance: float = quantity(0.0, unit='m/N', minimum=0.0, doc='default compliance')
    slip: float | None = quantity(None, unit='N', above=0.0, doc='default release force')
    click_radius: float = quantity(0.05, unit='m', above=0.0,
                                   doc='largest distance of a click from its particle')


@stage(prepare, Pin, on_device=True)
@jit
def move_pinned(pin, state, substep):
    """Place every pinned particle at its pin's pose at the substep's end."""
    begin, end, turn = turns_on_device(state.team, pin.count[0])
    for k in range(begin, end, turn):
        i = pin.particle[k]
        state.x[0, i], state.x[1, i], state.x[2, i] = place_of(pin, k, substep.end)


@stage(react_to_half_kick, Pin)
@stage(accumulate_reactions, Pin, on_device=True)
@jit
def take_reactions(pin, state, substep):
    """Add the constraint forces on pinned particles in this substep."""
    part = substep.end - substep.begin
    begin, end, turn = turns_on_device(state.team, pin.count[0])
    for k in range(begin, end, turn):
        i = pin.particle[k]
        share, a, b = weights_at(state.history, i)
        for axis in range(3):
            deliver(pin, k, axis, state.reaction[axis, i] / part, part, a, b, share)
            state.reaction[axis, i] = 0.0


class BuiltPin(Built):
    """All pins of a scene, with room for more."""

    def __init__(self, parameters: Parameters, world):
        super().__init__()
        count = len(world.state.mass)
        self.entries: dict[str, Entry] = world.sections.get('pins', {})
        if len(self.entries) > (slots := parameters.max_pins):
            raise InputError(f'pins: {len(self.entries)} pins, but effects.pin.max_pins is '
                             f'{slots}; raise it')
        self.cloths = {cloth.name: cloth for cloth in world.cloths}
        self.number = np.zeros(count, np.int64)
        for cloth in world.cloths:
            self.number[cloth.slots] = np.arange(cloth.particles.start, cloth.particles.stop)
        poses = np.zeros((slots, 7)), np.zeros((slots, 7))
        poses[0][:, 6] = poses[1][:, 6] = 1.0
        self.data = _room(count, world.slots, poses)
        self.usual = parameters
        self.scale = world.compliance_scale
        self.damping = np.zeros(1)
        """rate of effect ``damping`` [1/s], shape (1,)"""
        if parameters.compliance or any(entry.compliance for entry in self.entries.values()):
            self.also = (Spring(_room(count, world.slots, poses), np.ones(count),
                                np.zeros((count, 3)), np.ones(count),
                                np.zeros((count if world.explicit else 0, 3))),)
            self.implicit_with_explicit = True
        self.free_slots = list(range(slots))
        self.held: dict[str, Held] = {}
        self.open: dict[str, Motion] = {}
        """pins of the scene that hold nothing, and follow their targets"""
        self._wrench = np.zeros((slots, 6))
        self.states = self._states(np.inf)
        self.pinned_changed = True
        self.slipped = 0
        """pins that have slipped since the start"""
        self._v_before = np.zeros((3, 0))
        self._news: list[str] = []

    def reset(self, state):
        self.release_all(None, None, state)
        self.open.clear()
        self.slipped = 0
        self.free_slots.sort()
        for name, entry in self.entries.items():
            particles = chosen(name, entry, self.cloths, state.x)
            particles = particles[~self._taken(state)[particles]]
            if not len(particles):
                raise InputError(f'pins.{name}: other pins hold all that it names')
            keyframes = None if entry.motion is None else MonotoneCubic(entry.motion)
            point = keyframes(0.0) if keyframes else entry.near or tuple(
                places(state.x, particles).mean(0).tolist())
            held = self._hold(name, particles, Pose(point), state, keyframes)
            held.axes_open = entry.frame is not None
            if entry.target is not None:
                held.motion.target = Pose(entry.target)
        self._wrench[:] = 0.0
        self.states = self._states(np.inf)

    def particles_at(self, x: np.ndarray) -> np.ndarray:
        """Return the slots that the scene's pins hold if it starts at x [m], shape (3, slots)."""
        return np.concatenate([np.zeros(0, int), *(
            chosen(name, entry, self.cloths, x) for name, entry in self.entries.items())])

    def _taken(self, state) -> np.ndarray:
        """Return which slots hold a held particle or padding."""
        taken = state.inv_mass == 0.0
        for spring in self.also:
            taken[spring.pin.particle[:spring.pin.count[0]]] = True
        return taken

    def _hold(self, name, particles, pose, state, keyframes=None) -> Held:
        entry = self.entries.get(name)
        compliance, slip = self.usual.compliance, self.usual.slip
        if entry is not None:
            compliance = compliance if entry.compliance is None else entry.compliance
            slip = slip if entry.slip is None else entry.slip
        offset = places(state.x, particles) - pose.position
        inverse = conjugate(pose.orientation)
        offset = np.array([rotate.py_func(*inverse, *q) for q in offset.tolist()])
        lever = max(float(length(offset).max()), 1e-6)
        held = Held(name, self.free_slots.pop(0),
                    Motion(pose, (entry or Entry).max_speed, keyframes=keyframes, lever=lever),
                    particles, offset, compliance, slip)
        if not compliance:
            state.inv_mass[particles] = 0.0
        self.restarts = True
        self.held[name] = held
        self.open.pop(name, None)
        self.data.start[held.slot] = self.data.goal[held.slot] = (*pose.position,
                                                                  *pose.orientation)
        self._changed()
        return held

    def _changed(self) -> None:
        """Write the held particles into the kernels' arrays."""
        list_particles(self.data, self._pinned)
        for spring in self.also:
            list_particles(spring.pin, self._sprung)
            k = 0
            for held in self._sprung:
                n = len(held.particles)
                spring.compliance[k:k + n] = n * held.compliance * self.scale
                k += n
        self.pinned_changed = True

    @property
    def _lists(self) -> list[Pin]:
        return [self.data, *(spring.pin for spring in self.also)]

    @property
    def _pinned(self) -> list[Held]:
        return [held for held in self.held.values() if not held.compliance]

    @property
    def _sprung(self) -> list[Held]:
        return [held for held in self.held.values() if held.compliance]

    def refusal(self, commands, state):
        if all(isinstance(command, MovePin) and command.pin in self.held for command in commands):
            return None    # no copy of all pins for each of a hundred targets
        return Picking({name: held.particles for name, held in self.held.items()},
                       self._taken(state), self.entries, len(self.data.start),
                       self.usual.click_radius).refusal(commands, state)

    def click(self, command, clock, state) -> None:
        """Hold the particle nearest to a point, or release the pin that holds it."""
        nearest, _ = nearest_particle(command, state)
        holder = next((name for name, held in self.held.items() if nearest in held.particles),
                      None)
        if holder is not None:
            self._let_go(holder, state)
            return
        x, y, z = state.x[:, nearest].tolist()
        name = unused_name((*self.held, *self.entries))
        self._hold(name, np.array([nearest]), Pose((x, y, z)), state)

    def pose(self, name: str) -> Pose:
        """Return the present pose of a pin of the scene, or of an active one."""
        held = self.held.get(name)
        return self.open[name].pose if held is None else held.motion.pose

    def grasp(self, command, clock, state) -> None:
        """Hold the free particles near a point; a pin that holds already moves there instead."""
        held = self.held.get(command.pin)
        if held is None:
            near, _ = within(command, self._taken(state), state)
            held = self._hold(command.pin, near, command.pose, state)
        else:
            held.motion.aim(command.pose, None, 0, clock.begin_ns)
        held.lifetime_ns = command.lifetime_ns
        held.renew(clock.begin_ns)

    def release(self, command, clock, state) -> None:
        """Release a pin's particles."""
        self._let_go(command.pin, state)

    def release_all(self, command, clock, state) -> None:
        """Release the particles of all pins."""
        for name in list(self.held):
            self._let_go(name, state)

    def _let_go(self, name: str, state) -> None:
        held = self.held.pop(name)
        if name in self.entries:
            self.open[name] = held.motion
        self.free_slots.insert(0, held.slot)
        state.inv_mass[held.particles] = 1.0 / state.mass[held.particles]
        self.restarts = True
        self._changed()

    def move(self, command, clock, state) -> None:
        """Set the target of a pin."""
        held = self.held.get(command.pin)
        motion = self.open[command.pin] if held is None else held.motion
        if held is not None:
            held.renew(clock.begin_ns)
            if held.axes_open:
                held.take_axes(command.pose.orientation)
                self._changed()
        motion.aim(command.pose, command.twist, command.stamp_ns, clock.begin_ns)

    commands = {Grasp: grasp, Release: release, ReleaseAll: release_all, MovePin: move,
                Click: click}

    def expired(self, clock):
        return overdue(self.held, clock)

    def only_sets_target(self, command):
        return isinstance(command, MovePin) and not (
            command.pin in self.held and self.held[command.pin].axes_open)

    def written_by_begin(self):
        return self.data.start, self.data.goal, *self._forces()

    def read_by_frame(self):
        return (*self._forces(), *(spring.place[:spring.pin.count[0]] for spring in self.also))

    def _forces(self) -> list[np.ndarray]:
        return [pin.force[:pin.count[0]] for pin in self._lists]

    def begin(self, clock, state):
        for name in self.expired(clock):
            self._news.append(f"pin '{name}' released: no command within its lifetime of "
                              f'{1e-9 * self.held[name].lifetime_ns:g} s')
            self._let_go(name, state)
        motions = [held.motion for held in self.held.values()]
        for motion in (*motions, *self.open.values()):
            motion.advance(clock.end_ns, clock.dt, clock.end_age_ns)
        if motions:
            slots = [held.slot for held in self.held.values()]
            self.data.start[slots] = rows(motion.start for motion in motions)
            self.data.goal[slots] = rows(motion.pose for motion in motions)
        pinned = self.data.particle[:self.data.count[0]]
        state.reaction[:, pinned] = 0.0
        self._v_before = state.v.take(pinned, axis=1)    # the same layout even if empty
        for force in self._forces():
            force[:] = 0.0

    def again(self):
        for pin in self._lists:
            pin.force[:] = pin.last[:] = pin.older[:] = 0.0

    def work(self, dt):
        return sum(map(work_of, self._lists))

    def compile(self, state):
        self._v_before = state.v.take(self.data.particle[:self.data.count[0]], axis=1)
        self._weigh(state, 1.0)

    def _weigh(self, state, dt: float) -> None:
        self._wrench[:] = 0.0
        weigh_pinned(self.data, state, self._v_before, dt, float(self.damping[0]), self._wrench)
        for spring in self.also:
            weigh_springs(spring, self._wrench)

    def end(self, clock, state):
        self._weigh(state, clock.dt)
        self.states = self._states(clock.dt)
        for name, held in list(self.held.items()):
            slip = held.slip
            if slip is not None and (force := float(length(self._wrench[held.slot, :3]))) > slip:
                self._let_go(name, state)
                self.slipped += 1
                self._news.append(f"pin '{name}' slipped: the cloth pulled with {force:.3g} N, "
                                  f'and it holds {slip:g} N')

    def _states(self, dt: float) -> PinStates:
        slots = [held.slot for held in self.held.values()]
        return PinStates(list(self.held.values()), self.data.start[slots], self.data.goal[slots],
                         self._wrench[slots], self.number, dt)

    def news(self):
        self._news, news = [], self._news
        return news

    def adopt(self, old):
        self.__dict__.update({**old.__dict__, 'scale': self.scale, 'damping': self.damping})
        self._changed()

    def reported(self, frame_dt):
        return {'pins': self.states}

    def stats(self):
        motions = [held.motion for held in self.held.values()]
        return {'pins': len(self.held), 'pins_slipped': self.slipped,
                'pins_at_max_speed': sum(motion.limited for motion in motions),
                **delays('pin_target', motions)}


def _room(count: int, slots: int, poses: tuple[np.ndarray, np.ndarray]) -> Pin:
    """Return an empty list with room for ``count`` particles."""
    return Pin(np.zeros(1, np.int64), np.zeros(count, np.int64), np.zeros(count, np.int64),
               np.zeros((count, 3)), *poses, np.zeros((count, 3)), np.zeros((slots, 3)),
               np.zeros((slots, 3)))


EFFECT = Effect('pin', Parameters, BuiltPin, entry=Entry)
