"""
One run of a hard case, by the simulation and by the textbook solver, judged alike.

What must hold is named in the case: finite always; largest strain, speed, stillness at the end and
rise of energy where they are given; recovery to the strain of the same scene without the cause,
within two seconds after it ended; and what the user must have been told.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import json

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim import measure
from xpbd_ros.sim.commands import (
    Command,
    Grasp,
    MoveCollider,
    MovePin,
    Pose,
    Release,
)
from xpbd_ros.sim.particles.state import forget
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.study.stress.case import Outcome, Setting
from xpbd_ros.study.stress.textbook import advance, BOX, CAPSULE, Model, PLANE, SPHERE
from xpbd_ros.study.stress.trajectory import Track

Paths = Callable[[float], dict]
"""of time [s]: for each name how far it is from its start [m], or None where it lets go"""


@dataclass(frozen=True)
class Trial:
    """One run at one setting, and what must hold."""

    setting: Setting
    scene: dict
    """a scene without ``solver``"""
    seconds: float = 3.0
    place: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None
    """from the places at the start to places and velocities, shapes (particles, 3)"""
    masses: Callable[[np.ndarray], np.ndarray] | None = None
    """from masses to masses [kg]; out of reach of a scene"""
    spoil: Callable[[Simulation], None] | None = None
    """an unsafe setting, out of reach of a scene"""
    pins: Paths | None = None
    colliders: Paths | None = None
    commands: Callable[[int], Sequence[Command]] | None = None
    """by frame, for what the textbook has nothing of"""
    air: Callable[[float], tuple[float, float, float]] | None = None
    """the textbook's wind [m/s], of time"""
    drag: float = 0.0
    """density of the textbook's air [kg/m³]"""
    apart: float = 0.0
    """distance that the textbook's cloth keeps from itself [m]"""
    ended: float = 0.0
    """when the cause has ended [s]"""
    strain: float | None = None
    speed: float | None = None
    """[m/s]"""
    still: float | None = None
    """[m/s] at the end"""
    energy: float | None = None
    """largest rise, of what it can have"""
    recovers: float | None = None
    """strain above that of the same scene without the cause, or part of what the cause made"""
    also: Callable[[Track], str] | None = None
    """says what is wrong besides, or nothing"""
    tells: tuple[str, ...] = ()
    """counts that must not be 0, or texts that must be said"""
    note: str = ''
    """what is told elsewhere"""
    textbook: bool = True
    """whether the textbook solver has all that the case is of"""
    label: str = ''
    """beside the setting"""

    @property
    def name(self) -> str:
        """Return the setting, and what else tells it from others."""
        return f'{self.setting} {self.label}'.strip()

    def outcome(self) -> Outcome:
        """Run it by both and judge."""
        try:
            with np.errstate(all='ignore'):
                ours = self.simulate()
        except InputError as error:
            text = str(error).split(': ', 1)[-1]
            at_door = text.startswith('solver.')    # the setting, and not the scene
            return Outcome(self.name, at_door, reported=text, why='' if at_door else 'was refused')
        why, recovery = self.judge(ours, self.calm('simulate'))
        told = [text for text in self.tells if ours.stats.get(text) or any(
            text in said for said in ours.said)]
        if len(told) < len(self.tells):
            why.append(f'not told: {", ".join(set(self.tells) - set(told))}')
        taken_back = ours.stats.get('frames_taken_back', 0)
        if taken_back and 'frames_taken_back' not in self.tells:
            why.append(f'{taken_back} frames taken back')
        book, book_why = None, ''
        if self.textbook:
            with np.errstate(all='ignore'):
                faults, _ = self.judge(self.by_the_book(), self.calm('by_the_book'))
            book, book_why = not faults, '; '.join(faults)
        finite = ours.finite
        return Outcome(
            self.name, not why, finite, ours.worst if finite else None,
            ours.rise if finite else None, None if self.recovers is None else recovery is not None,
            recovery, '; '.join([*(f'{text} {ours.stats[text]:g}' if text in ours.stats else
                                   next(said for said in ours.said if text in said)
                                   for text in told), *[self.note] * bool(self.note)]),
            '; '.join(why), book, book_why)

    def calm(self, solver: str) -> float:
        """Return the strain at the end of the same scene without the cause."""
        if self.recovers is None:
            return 0.0
        plain = Trial(self.setting, self.scene, self.seconds, masses=self.masses, drag=self.drag,
                      apart=self.apart)
        key = (solver, str(self.setting), json.dumps(self.scene, default=str), self.seconds,
               self.masses)
        if key not in _CALM:
            with np.errstate(all='ignore'):
                track = getattr(plain, solver)()
            _CALM[key] = track.strain[len(track.x) // 2:].max()
        return _CALM[key]

    def judge(self, track: Track, calm: float) -> tuple[list[str], float | None]:
        """Return what is wrong with a run, and when it recovered."""
        if not track.finite:
            return ['not finite'], None
        why, recovery = [], None
        for name, most, got, unit in (
                ('strain', self.strain, track.worst, ''),
                ('speed', self.speed, track.speed.max(), ' m/s'),
                ('speed at the end', self.still, track.late(track.speed), ' m/s'),
                ('energy', self.energy, track.rise, ' of what it can have')):
            if most is not None and not got <= most:
                why.append(f'{name} {got:.3g}{unit} (at most {most:g})')
        if self.recovers is not None:
            recovery = track.back_after(self.ended, calm + max(
                self.recovers, self.recovers * (track.strain.max() - calm)))
            if recovery is None:
                why.append(f'strain {track.late(track.strain):.3g} at the end '
                           f'(without the cause {calm:.3g})')
        if self.also is not None and (fault := self.also(track)):
            why.append(fault)
        return why, recovery

    def build(self) -> Simulation:
        """Return the simulation at the start of the case."""
        raw = {**self.scene, 'solver': {**self.setting.keys, **self.scene.get('solver', {})}}
        simulation = compile_scene(scene_from_mapping(raw, where='case', name='case'))
        state, slot = simulation.state, simulation.slot
        if self.masses is not None:
            state.mass[slot] = self.masses(state.mass[slot].astype(float))
            held = state.inv_mass[slot] == 0.0
            state.inv_mass[slot] = np.where(held, 0.0, 1.0 / state.mass[slot])
        if self.place is not None:
            x, v = self.place(simulation.natural(state.x))
            state.x[:, slot] = state.x_prev[:, slot] = x.T
            state.v[:, slot] = np.where(state.inv_mass[slot] > 0.0, v.T, 0.0)
            forget(state)
        if self.spoil is not None:
            self.spoil(simulation)
        return simulation

    def simulate(self) -> Track:
        """Run it by the simulation."""
        simulation = self.build()
        start = frame = simulation.frame()
        track = _track(simulation, start.x)
        pin = simulation.effects.get('pin')
        places = {name: held.motion.pose.position
                  for name, held in (pin.held if pin else {}).items()}
        holding = set(places)
        homes = {name: c.pose.position for name, c in start.colliders.items()}

        def keep(frame):
            track.x.append(frame.x)
            track.v.append(frame.v)
            track.energy.append(measure.kinetic_energy(simulation.state)
                                + measure.potential_energy(simulation.state))

        keep(start)
        track.stored = measure.elastic_energy(simulation)
        track.span = _span(simulation, track.stored)
        for k in range(round(self.seconds / track.dt)):
            t = (k + 1) * track.dt
            commands = list(self.commands(k)) if self.commands else []
            for name, offset in (self.pins(t) if self.pins else {}).items():
                if offset is None:
                    commands += [Release(name)] * (name in holding)
                    holding.discard(name)
                elif name in holding:
                    goal = tuple(np.add(places[name], offset).tolist())
                    commands.append(MovePin(name, Pose(goal)))
                else:
                    here = frame.x[_particles(simulation, name)[0]]
                    commands.append(Grasp(name, Pose(tuple(here.tolist())), 1e-6))
                    holding.add(name)
            for name, offset in (self.colliders(t) if self.colliders else {}).items():
                commands.append(MoveCollider(name, Pose(
                    tuple(np.add(homes[name], offset).tolist()))))
            frame = simulation.step(commands)
            keep(frame)
            for name, value in simulation.stats().items():
                track.stats[name] = max(track.stats.get(name, 0), value)
            track.said += [reason for _, reason in frame.refused]
        track.free = frame.inv_mass > 0.0
        track.said += simulation.notes
        track.force = {name: pin.force for name, pin in frame.pins.items()}
        track.hash = simulation.hash()
        return track

    def by_the_book(self) -> Track:
        """Run it by the textbook solver."""
        simulation = replace(self, spoil=None).build()
        model = _model(self, simulation)
        frame = simulation.frame()
        x, v, w = frame.x.copy(), frame.v.copy(), frame.inv_mass.copy()
        track = _track(simulation, x)
        groups = {name: _particles(simulation, name) for name in self.scene.get('pins', {})}
        home = {name: x[particles].copy() for name, particles in groups.items()}
        names = list(frame.colliders)
        centres = np.array([frame.colliders[name].pose.position for name in names]).reshape(-1, 3)
        substeps, iterations = simulation.solver.substeps, simulation.solver.iterations

        def keep():
            track.x.append(x.copy())
            track.v.append(v.copy())
            track.energy.append(float((model.mass * (0.5 * (v**2).sum(1)
                                                     - x @ model.gravity)).sum()))

        keep()
        track.stored = measure.elastic_energy(simulation)
        track.span = _span(simulation, track.stored)
        for k in range(round(self.seconds / track.dt)):
            t = (k + 1) * track.dt
            wanted = self.pins(t) if self.pins else {}
            pinned, target = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
            for name, particles in groups.items():
                offset = wanted.get(name, (0.0, 0.0, 0.0))
                if offset is None:
                    w[particles] = 1.0 / model.mass[particles]
                    home[name] = None
                    continue
                if home[name] is None:
                    home[name] = x[particles] - offset
                w[particles] = 0.0
                pinned.append(particles)
                target.append(home[name] + np.asarray(offset, float))
            moved = self.colliders(t) if self.colliders else {}
            centre = centres + np.array([moved.get(name, (0.0,) * 3) for name in names]
                                        ).reshape(-1, 3)
            air = np.array([*(self.air(t) if self.air else (0.0,) * 3), self.drag])
            advance(model, x, v, w, np.concatenate(pinned), np.concatenate(target), centre, air,
                    track.dt, substeps, iterations)
            keep()
        track.free = w > 0.0
        return track


_CALM: dict = {}


def _numbers(simulation) -> np.ndarray:
    """Return the number of the particle in each slot, in natural order; -1 where there is none."""
    found = np.full(len(simulation.state.mass), -1)
    found[simulation.slot] = np.arange(len(simulation.slot))
    return found


def _particles(simulation, name: str) -> np.ndarray:
    """Return the numbers of what a pin of the scene holds at the start."""
    entry = simulation.effects['pin'].entries[name]
    cloth = simulation.effects['pin'].cloths[entry.cloth]
    return _numbers(simulation)[cloth.at(entry.at, name)]


def _track(simulation, x) -> Track:
    """Return an empty track of a simulation; its edges are those of the rest shape."""
    edges = [np.zeros((0, 2), np.int64)]
    rest = [np.zeros(0)]
    for cloth in simulation.cloths:
        mesh = cloth.mesh
        if mesh.grid is None:
            found = mesh.edges
        else:
            found = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in (
                (mesh.grid[:, 1:], mesh.grid[:, :-1]), (mesh.grid[1:], mesh.grid[:-1]))])
        edges.append(found + cloth.first)
        d = mesh.positions[found[:, 0]] - mesh.positions[found[:, 1]]
        rest.append(np.sqrt((d**2).sum(1)))
    return Track(simulation.frame_dt, np.concatenate(edges), np.concatenate(rest),
                 np.ones(len(x), bool),
                 np.concatenate([c.mesh.triangles + c.first for c in simulation.cloths]),
                 _tetrahedra(simulation))


def _tetrahedra(simulation) -> tuple[np.ndarray, np.ndarray]:
    """Return the tetrahedra of all bodies, and their volumes at rest [m³]."""
    found = np.concatenate([c.mesh.tetrahedra + c.first for c in simulation.cloths])
    p = np.concatenate([cloth.mesh.positions for cloth in simulation.cloths])
    a, b, c, d = (p[found[:, k]] for k in range(4))
    return found, ((b - a) * np.cross(c - a, d - a)).sum(1) / 6.0


def _span(simulation, stored: float) -> float:
    """Return m g times the size of the cloths, and what there is at the start [J]."""
    state = simulation.state
    size = sum(float(np.linalg.norm(np.ptp(cloth.mesh.positions, axis=0)))
               for cloth in simulation.cloths)
    fall = float(state.mass.sum() * np.linalg.norm(state.gravity)) * size
    return fall + stored + measure.kinetic_energy(state) or 1.0


def _model(trial: Trial, simulation) -> Model:
    """Return what the textbook solver is given: the same particles, edges, hinges, tetrahedra."""
    number = _numbers(simulation)
    edges, rest, alpha = [], [], []
    hinges, angle, hinge_alpha = [np.zeros((0, 4), np.int64)], [np.zeros(0)], [np.zeros(0)]
    for name in ('stretch', 'shear'):
        for these in simulation.effects[name].by_part if name in simulation.effects else ():
            if these.particles.shape[1] == 2:
                edges.append(number[these.particles])
                rest.append(these.rest_length)
                alpha.append(these.compliance)
            else:    # the textbook has both diagonals of a cell, each twice as stiff
                ends = number[these.particles].reshape(-1, 2)
                places = np.concatenate([cloth.mesh.positions for cloth in simulation.cloths])
                edges.append(ends)
                rest.append(np.linalg.norm(places[ends[:, 0]] - places[ends[:, 1]], axis=1))
                alpha.append(np.repeat(0.5 * these.compliance, 2))
    if 'hinge' in simulation.effects:
        these = simulation.effects['hinge'].constraints
        hinges.append(number[these.particles])
        angle.append(these.rest_angle)
        hinge_alpha.append(these.compliance)
    if not edges:    # a finite-element sheet or body: its edges, as stiff as its modulus
        track = _track(simulation, simulation.frame().x)
        stiff = [1.0 / trial.scene['cloths'][cloth.name]['effects'].get(
            'membrane', {}).get('young', 1e3) for cloth in simulation.cloths]
        edges.append(track.edges)
        rest.append(track.rest)
        alpha.append(np.full(len(track.rest), max(stiff)))
    colliders = [placed.entry for placed in simulation.effects['contact'].placed.values()
                 ] if 'contact' in simulation.effects else []
    return Model(
        simulation.state.mass[simulation.slot].astype(float), np.concatenate(edges),
        np.concatenate(rest), np.concatenate(alpha), np.concatenate(hinges),
        np.concatenate(angle), np.concatenate(hinge_alpha), *_tetrahedra(simulation),
        np.concatenate([cloth.mesh.triangles + cloth.first for cloth in simulation.cloths]),
        np.array([_kind(entry) for entry in colliders], np.int64),
        np.array([_size(entry) for entry in colliders]).reshape(-1, 3),
        simulation.effects['contact'].thickness if colliders else 0.0,
        simulation.cloths[0].friction, trial.apart,
        simulation.state.gravity.astype(float))


def _kind(entry) -> int:
    return {'plane': PLANE, 'sphere': SPHERE, 'box': BOX, 'capsule': CAPSULE}[entry.shape]


def _size(entry) -> tuple:
    if entry.plane:
        return tuple(np.array(entry.plane.normal) / np.linalg.norm(entry.plane.normal))
    if entry.box:
        return tuple(0.5 * np.array(entry.box.size))
    if entry.capsule:
        return (entry.capsule.radius, 0.5 * entry.capsule.length, 0.0)
    return (entry.sphere.radius, 0.0, 0.0)
