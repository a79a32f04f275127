"""
One run of a hard case, by the simulation and by the textbook solver, with the same criteria.

All numbers must stay finite. A case may limit the strain, the speed, the speed at the end and the
rise of energy. It may ask for recovery, that is a return to the strain of the same scene without
the cause within two seconds after the cause, and for messages to the user.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import json
from typing import Any

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
from xpbd_ros.study.edges import edges_of
from xpbd_ros.study.numbering import natural_indices
from xpbd_ros.study.stress.case import Outcome, Setting
from xpbd_ros.study.stress.textbook import advance, BOX, CAPSULE, Model, PLANE, SPHERE
from xpbd_ros.study.stress.trajectory import Trajectory

Paths = Callable[[float], dict]
"""time [s] -> {name: displacement from the start [m], or None for a released pin}"""

ROUNDING_ENERGY = 1e-20
"""the smallest energy scale [J], above that of rounded coordinates"""


@dataclass(frozen=True)
class Trial:
    """One run with one setting, and its criteria."""

    setting: Setting
    scene: dict
    """mapping of a scene without ``solver``"""
    seconds: float = 3.0
    """simulated time [s]"""
    start: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None
    """initial positions of the scene -> initial positions [m] and velocities [m/s] of the run"""
    masses: Callable[[np.ndarray], np.ndarray] | None = None
    """masses of the scene -> masses of the run [kg], shape (particles,)"""
    make_unsafe: Callable[[Simulation], None] | None = None
    """makes a setting unsafe, in a way that no scene can"""
    pins: Paths | None = None
    """motion of the pins"""
    colliders: Paths | None = None
    """motion of the colliders"""
    commands: Callable[[int], Sequence[Command]] | None = None
    """frame -> further commands, which the textbook solver does not get"""
    air: Callable[[float], tuple[float, float, float]] | None = None
    """time [s] -> wind of the textbook solver [m/s]"""
    drag: float = 0.0
    """density of the air of the textbook solver [kg/m³]"""
    cloth_distance: float = 0.0
    """self-collision distance of the textbook solver [m]"""
    cause_end: float = 0.0
    """end of the cause, from which recovery counts [s]"""
    strain: float | None = None
    """largest strain allowed"""
    speed: float | None = None
    """largest speed allowed [m/s]"""
    end_speed: float | None = None
    """largest speed allowed at the end [m/s]"""
    energy: float | None = None
    """largest rise of energy allowed, over the energy scale"""
    recovery_strain: float | None = None
    """tolerance of the recovered strain, absolute or relative to the largest strain"""
    check: Callable[[Trajectory], str] | None = None
    """further criterion; returns a fault, empty if there is none"""
    reports: tuple[str, ...] = ()
    """counters that must not be 0, or texts that must be in messages"""
    note: str = ''
    """where else the user is informed"""
    textbook: bool = True
    """True if the textbook solver can run the case"""
    label: str = ''
    """part of the name that tells attempts with the same setting apart"""

    @property
    def name(self) -> str:
        """Setting and label."""
        return f'{self.setting} {self.label}'.strip()

    def outcome(self) -> Outcome:
        """Run the case with both solvers, and return the result."""
        try:
            with np.errstate(all='ignore'):
                ours = self.simulate()
        except InputError as error:
            text = str(error).split(': ', 1)[-1]
            refused_setting = text.startswith('solver.')
            return Outcome(self.name, refused_setting, reported=text, column=str(self.setting),
                           why='' if refused_setting else 'was refused')
        why, recovery = self.judge(ours, self.baseline_strain('simulate'))
        told = [text for text in self.reports if ours.stats.get(text) or any(
            text in message for message in ours.messages)]
        if len(told) < len(self.reports):
            why.append(f'not reported: {", ".join(set(self.reports) - set(told))}')
        rolled_back = ours.stats.get('frames_taken_back', 0)
        if rolled_back and 'frames_taken_back' not in self.reports:
            why.append(f'{rolled_back} frames rolled back')
        book, book_why = None, ''
        if self.textbook:
            with np.errstate(all='ignore'):
                faults, _ = self.judge(self.run_textbook(), self.baseline_strain('run_textbook'))
            book, book_why = not faults, '; '.join(faults)
        finite = ours.finite
        reported = [f'{text} {ours.stats[text]:g}' if text in ours.stats else
                    next(message for message in ours.messages if text in message)
                    for text in told]
        return Outcome(
            self.name, not why, finite, ours.max_strain if finite else None,
            ours.energy_rise if finite else None,
            None if self.recovery_strain is None else recovery is not None, recovery,
            '; '.join([*reported, *[self.note] * bool(self.note)]), '; '.join(why), book,
            book_why, column=str(self.setting))

    def baseline_strain(self, solver: str) -> float:
        """Return the largest strain in the second half of the same scene without the cause."""
        if self.recovery_strain is None:
            return 0.0
        plain = Trial(self.setting, self.scene, self.seconds, masses=self.masses, drag=self.drag,
                      cloth_distance=self.cloth_distance)
        key = (solver, str(self.setting), json.dumps(self.scene, default=str), self.seconds,
               self.masses)
        if key not in _BASELINES:
            with np.errstate(all='ignore'):
                track = getattr(plain, solver)()
            _BASELINES[key] = track.strain[len(track.x) // 2:].max()
        return _BASELINES[key]

    def judge(self, track: Trajectory, baseline: float) -> tuple[list[str], float | None]:
        """Return the criteria that a run misses, and its recovery time [s] (None: none)."""
        if not track.finite:
            return ['not finite'], None
        why, recovery = [], None
        for name, most, got, unit in (
                ('strain', self.strain, track.max_strain, ''),
                ('speed', self.speed, track.speed.max(), ' m/s'),
                ('speed at the end', self.end_speed, track.at_end(track.speed), ' m/s'),
                ('energy rise', self.energy, track.energy_rise, ' of the energy scale')):
            if most is not None and not got <= most:
                why.append(f'{name} {got:.3g}{unit} (at most {most:g})')
        if self.recovery_strain is not None:
            recovery = track.recovery_time(self.cause_end, baseline + max(
                self.recovery_strain, self.recovery_strain * (track.strain.max() - baseline)))
            if recovery is None:
                why.append(f'strain {track.at_end(track.strain):.3g} at the end '
                           f'(without the cause {baseline:.3g})')
        if self.check is not None and (fault := self.check(track)):
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
        if self.start is not None:
            x, v = self.start(simulation.natural(state.x))
            state.x[:, slot] = state.x_prev[:, slot] = x.T
            state.v[:, slot] = np.where(state.inv_mass[slot] > 0.0, v.T, 0.0)
            forget(state)
        if self.make_unsafe is not None:
            self.make_unsafe(simulation)
        return simulation

    def simulate(self) -> Trajectory:
        """Run the case with the simulation."""
        simulation = self.build()
        start = frame = simulation.frame()
        track = _track(simulation, start.x)
        pin: Any = simulation.effects.get('pin')
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
        track.elastic_energy = measure.elastic_energy(simulation)
        track.energy_scale = _energy_scale(simulation, track.elastic_energy)
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
            track.messages += [reason for _, reason in frame.refused]
        track.free = frame.inv_mass > 0.0
        track.messages += simulation.notes
        track.force = {name: pin.force for name, pin in frame.pins.items()}
        track.hash = simulation.hash()
        return track

    def run_textbook(self) -> Trajectory:
        """Run the case with the textbook solver."""
        simulation = replace(self, make_unsafe=None).build()
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
        track.elastic_energy = measure.elastic_energy(simulation)
        track.energy_scale = _energy_scale(simulation, track.elastic_energy)
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


_BASELINES: dict = {}


def _particles(simulation, name: str) -> np.ndarray:
    """Return the natural indices of the particles that a pin of the scene holds at the start."""
    entry = simulation.effects['pin'].entries[name]
    cloth = simulation.effects['pin'].cloths[entry.cloth]
    return natural_indices(simulation)[cloth.at(entry.at, name)]


def _track(simulation, x) -> Trajectory:
    """Return an empty trajectory of a simulation."""
    return Trajectory(simulation.frame_dt, edges_of(simulation), np.ones(len(x), bool),
                      np.concatenate([c.mesh.triangles + c.first for c in simulation.cloths]),
                      _tetrahedra(simulation))


def _tetrahedra(simulation) -> tuple[np.ndarray, np.ndarray]:
    """Return the tetrahedra of all bodies and their rest volumes [m³]."""
    found = np.concatenate([c.mesh.tetrahedra + c.first for c in simulation.cloths])
    p = np.concatenate([cloth.mesh.positions for cloth in simulation.cloths])
    a, b, c, d = (p[found[:, k]] for k in range(4))
    return found, ((b - a) * np.cross(c - a, d - a)).sum(1) / 6.0


def _energy_scale(simulation, elastic: float) -> float:
    """Return m g times the size of the cloths plus the energy at the start [J]."""
    state = simulation.state
    size = sum(float(np.linalg.norm(np.ptp(cloth.mesh.positions, axis=0)))
               for cloth in simulation.cloths)
    fall = float(state.mass.sum() * np.linalg.norm(state.gravity)) * size
    return max(fall + elastic + measure.kinetic_energy(state), ROUNDING_ENERGY)


def _model(trial: Trial, simulation) -> Model:
    """Return the particles, constraints and colliders of a case for the textbook solver."""
    number = natural_indices(simulation)
    edges, rest, alpha = [], [], []
    hinges, angle, hinge_alpha = [np.zeros((0, 4), np.int64)], [np.zeros(0)], [np.zeros(0)]
    for name in ('stretch', 'shear'):
        for these in simulation.effects[name].by_part if name in simulation.effects else ():
            if these.particles.shape[1] == 2:
                edges.append(number[these.particles])
                rest.append(these.rest_length)
                alpha.append(these.compliance)
            else:    # the textbook solver gets both diagonals of a cell, each twice as stiff
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
    if not edges:    # finite elements: the edges of the mesh, with a comparable stiffness
        mesh_edges = edges_of(simulation)
        stiff = [1.0 / trial.scene['cloths'][cloth.name]['effects'].get(
            'membrane', {}).get('young', 1e3) for cloth in simulation.cloths]
        edges.append(mesh_edges.particles)
        rest.append(mesh_edges.rest)
        alpha.append(np.full(len(mesh_edges.rest), max(stiff)))
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
        simulation.cloths[0].friction, trial.cloth_distance,
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
