"""Compile a ``Scene`` to a ``Simulation``: meshes, masses, and the effects that it names."""

from dataclasses import replace
from fractions import Fraction
from math import ceil
from pathlib import Path

import numpy as np

from xpbd_ros.effects import EFFECTS, load as load_effect
from xpbd_ros.errors import brief, InputError
from xpbd_ros.scene.auto import resolve, rounds_away, rounds_moves
from xpbd_ros.scene.device import card_of
from xpbd_ros.scene.grip import weak_grips
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.scene.mesh_file import read_mesh_file, read_table
from xpbd_ros.scene.model import ClothKeys, live_keys, Scene, with_key
from xpbd_ros.scene.stability import needed_substeps, stability_limit
from xpbd_ros.scene.threads import with_threads
from xpbd_ros.scene.warp import check_warps
from xpbd_ros.sim.command_check import plain
from xpbd_ros.sim.effect import BuildContext, Built, Cloth
from xpbd_ros.sim.geometry.mesh import grid_mesh, Mesh
from xpbd_ros.sim.geometry.mesh_repair import solid_mesh, surface_mesh
from xpbd_ros.sim.geometry.quaternion import rotate
from xpbd_ros.sim.live_keys import Change
from xpbd_ros.sim.particles.accumulators import Explicit, Jacobi
from xpbd_ros.sim.particles.memory_layout import blocks
from xpbd_ros.sim.particles.state import new_state, SHORT, State, with_solver_storage
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.target_motion import path_length

ONE_PASS = ('gauss_seidel', 'jacobi')
"""methods that project each constraint once per iteration"""
LINES = ('line', 'auto')
"""methods that may solve whole lines; so do the rough frames of a mix"""
LINES_AT_ONCE = 1024
"""threads of a GPU that solve lines, each with scratch memory for one"""
APART = {'jacobi': Jacobi, 'explicit': Explicit}
"""methods that accumulate the displacements of a particle, and their accumulators"""
CHOSEN = ('solver.substeps', 'solver.rough_substeps', 'solver.integrator',
          'solver.rough_integrator')
"""live keys that ``auto`` chooses unless they are given"""
HAND_SPEED = 0.3
"""mean speed that ``auto`` expects of what TF or commands move: that of a robot's hand [m/s]"""
FARTHEST = 1e9
"""largest coordinate of a particle at the start [m]"""
COARSE = 1e-3
"""rounding error over the distance of neighbours above which there is a warning about float32"""


def compile_scene(scene: Scene) -> Simulation:
    """Return a simulation at the scene's start; ``Simulation.compile`` compiles its kernels."""
    card = card_of(scene)
    cloths, x, mass = [], [], []
    dtype = np.dtype(scene.top.solver.precision)
    try:
        meshes = [_mesh(name, keys) for name, keys in scene.cloths.items()]
        check_warps(scene, meshes)
    except InputError as error:
        raise InputError(f'{scene.where}: {brief(str(error))}') from None
    scene = with_threads(scene, meshes)
    places, slots = blocks([mesh.rank if mesh.grid is None else mesh.grid.shape
                            for mesh in meshes], dtype)
    first = 0
    for (name, keys), mesh, block in zip(scene.cloths.items(), meshes, places):
        cloths.append(Cloth(name, mesh, block, first, keys.friction,
                            keys.static_friction))
        q, p = keys.pose.orientation, keys.pose.position
        x.append(np.stack(rotate.py_func(*q, *mesh.positions.T), 1) + p)
        mass.append(mesh.area * keys.density)
        first += len(mesh.positions)
    mass = np.concatenate(mass)
    with np.errstate(over='ignore', divide='ignore'):
        if not (np.isfinite(1.0 / mass).all() and np.isfinite(mass).all()):
            raise InputError(f'{scene.where}: cloths: a particle would weigh {mass.min():.3g} kg; '
                             'correct size, density or resolution')
    for cloth, positions in zip(cloths, x):
        if (far := np.abs(positions).max()) > FARTHEST:
            raise InputError(f'{scene.where}: cloths.{cloth.name}: a particle would be {far:.3g} '
                             f'm away, and {FARTHEST:g} m is the most; correct size, scale or '
                             'pose')
    slot = np.concatenate([cloth.slots for cloth in cloths])
    state = new_state(np.concatenate(x), mass, scene.top.gravity, slot, slots,
                      pins='pin' in scene.effects, dtype=dtype)
    gap = np.zeros(slots)
    for cloth in cloths:
        gap[cloth.slots] = cloth.mesh.gap
    try:
        effects = _build(scene, tuple(cloths), state)
        frame_dt = float(1 / frame_rate(scene))
        solver = resolve(scene.top.solver, effects, state, frame_dt)
        h = frame_dt / solver.substeps
        apart = Explicit if solver.mixes else APART.get(solver.method)
        state = with_solver_storage(
            state, integrator=solver.rough_integrator or solver.integrator, apart=apart,
            constraints=[these.particles for built in effects.values() for these in built.by_part],
            gap=gap, compensates=h < SHORT and rounds_moves(apart, effects))
        rough = solver.rough if solver.mixes and solver.method == 'explicit' else solver
        return Simulation(
            cloths, state, effects, slot=slot, frame_rate=frame_rate(scene), solver=solver,
            retune=Retune(scene, tuple(cloths), state, effects), card=card,
            notes=[*(f'cloths.{cloth.name}.mesh: {text}' for cloth in cloths
                     for text in cloth.mesh.notes),
                   *(text for built in effects.values() for text in built.notes),
                   *_too_coarse(cloths, state),
                   *_too_few(solver, effects, state, frame_dt),
                   *weak_grips(scene, cloths, rough.method, rough.substeps),
                   *_too_short(state, h)])
    except ArithmeticError as error:
        raise InputError(f'{scene.where}: sizes, stiffnesses or densities are too large or too '
                         f'small to compute with ({error}); check their units') from error
    except InputError as error:
        raise InputError(f'{scene.where}: {brief(str(error))}') from None


def _mesh(name: str, keys: ClothKeys) -> Mesh:
    """Return the rest shape of one cloth."""
    if keys.grid is not None:
        return grid_mesh(keys.grid.size, keys.grid.resolution)
    assert keys.mesh is not None
    try:
        vertices, triangles, tetrahedra = read_mesh_file(Path(keys.mesh.file))
    except InputError as error:
        raise InputError(f'cloths.{name}.mesh.file: {error}') from None
    if len(tetrahedra) and keys.material is not None:
        raise InputError(f'cloths.{name}.material: materials are sheets, and {keys.mesh.file} has '
                         'tetrahedra; give density (kg/m³) and the parameters of the effects')
    try:
        with np.errstate(over='ignore', invalid='ignore'):
            vertices = vertices * keys.mesh.scale
            return (solid_mesh(vertices, tetrahedra, keys.mesh.warp) if len(tetrahedra)
                    else surface_mesh(vertices, triangles, keys.mesh.warp))
    except InputError as error:
        raise InputError(f'cloths.{name}.mesh: {keys.mesh.file}: {error}') from None


def _too_coarse(cloths, state: State) -> list[str]:
    """Return a warning if float32 rounds positions too coarsely for the mesh; empty if not."""
    if state.x.dtype != np.float32:
        return []
    far = float(np.abs(state.x).max(initial=0.0))
    rounding, gap = far * float(np.finfo(np.float32).eps), min(c.mesh.gap for c in cloths)
    if rounding <= COARSE * gap:
        return []
    return [f'solver.precision: float32 rounds positions {far:.3g} m from the origin to '
            f'{rounding:.2g} m, and neighbours are {gap:.2g} m apart; take float64, or an origin '
            'near the scene']


def _too_few(solver, effects, state: State, frame_dt: float) -> list[str]:
    """Return a warning if one-way NDF2, or ``explicit``, may be unstable with these substeps."""
    if (solver.method, solver.integrator) == ('gauss_seidel', 'ndf2') and (
            solver.substeps < needed_substeps('gauss_seidel', 'ndf2', effects, state, frame_dt)):
        return [f'solver.integrator: ndf2 may be unstable with gauss_seidel and {solver.substeps} '
                'substeps, which do not resolve the stretch; take gauss_seidel_symmetric, or bdf2']
    if solver.method != 'explicit' or solver.substeps >= (
            needed := stability_limit(effects, state) * frame_dt):
        return []
    return [f'solver.substeps: explicit may be unstable with {solver.substeps}, and computes '
            f'unstable frames again with line; give at least {ceil(min(needed, 1e9))}, or take '
            'line']


def _too_short(state: State, h: float) -> list[str]:
    """Return a warning if float32 rounds away what gravity moves positions by in a substep."""
    if not rounds_away(state, h):
        return []
    fall, far = float(np.linalg.norm(state.gravity)) * h * h, np.abs(state.x).max(initial=0.0)
    return [f'solver.precision: float32 rounds positions {far:.3g} m from the origin by up to '
            f'{0.5 * np.spacing(far):.2g} m, and gravity moves them by {fall:.2g} m in a substep: '
            'forces get lost; take float64, or fewer substeps']


def frame_rate(scene: Scene) -> Fraction:
    """Return the frame rate [Hz] as the exact decimal number of the scene file."""
    return Fraction(repr(scene.top.frame_rate))


def _build(scene: Scene, cloths: tuple[Cloth, ...], state: State,
           before: dict[str, Built] | None = None) -> dict[str, Built]:
    built: dict[str, Built] = {}
    solver = scene.top.solver
    pins = 'pin' in scene.effects
    world = BuildContext(
        cloths, state, scene.sections, built, pins, solver.compliance_scale, before or {},
        lambda file: read_mesh_file(Path(file))[:2], read_table,
        forces=pins or solver.iterations > 1 or solver.method not in ONE_PASS,
        lines=solver.method in LINES or bool(solver.rough_frames),
        explicit=solver.method in ('auto', 'explicit'), coloured=solver.order == 'coloured',
        iterations=solver.iterations,
        threads=solver.threads if solver.device == 'cpu' else LINES_AT_ONCE,
        travel=_speed(scene) / scene.top.frame_rate, on_device=solver.device != 'cpu')
    for name in scene.effect_names:
        if EFFECTS[name] == 'scene':
            parameters = scene.effects[name]
        else:
            parameters = {cloth: scene.cloth_effects[cloth.name][name] for cloth in cloths
                          if name in scene.cloth_effects[cloth.name]}
        built[name] = load_effect(name).build(parameters, world)
    return built


def _speed(scene: Scene) -> float:
    """
    Return the mean speed of the fastest pin or collider, as ``auto`` expects it [m/s].

    A scene that has the effect ``pin`` and moves no pin itself leaves that to commands.
    """
    def moved(section: str) -> list[float]:
        return [HAND_SPEED if entry.motion is None else path_length(entry.motion) / max(
            scene.top.duration, entry.motion[-1][0])
            for entry in scene.sections.get(section, {}).values() if entry.motion or entry.frame]
    pins = moved('pins') or [HAND_SPEED] * ('pin' in scene.effects)
    return max([0.0, *pins, *moved('colliders')])


class Retune:
    """
    Compute the change of a running simulation for a new value of a live key.

    Parameters
    ----------
    scene, cloths, state, effects : those of the simulation

    """

    def __init__(self, scene: Scene, cloths, state, effects):
        self.scene = scene
        self.cloths = cloths
        self.state = state
        self.effects = effects

    def __call__(self, key: str, value) -> Change:
        """Return the change of effects, solver and gravity; raise InputError for a bad value."""
        scene = self.check({key: value})
        cloths = tuple(replace(c, friction=scene.cloths[c.name].friction,
                               static_friction=scene.cloths[c.name].static_friction)
                       for c in self.cloths)
        effects = self.effects
        if key not in CHOSEN:    # on which no effect depends
            effects = _build(scene, cloths, self.state, self.effects)
            for name, built in effects.items():
                built.adopt(self.effects[name])
        solver = resolve(scene.top.solver, effects, self.state, float(1 / frame_rate(scene)),
                         live=True)
        self.scene, self.cloths, self.effects = scene, cloths, effects
        return Change(effects, solver, scene.top.gravity)

    def rebind(self, state: State, effects: dict[str, Built]) -> None:
        """Continue with another state and effects of the same scene."""
        self.state, self.effects = state, effects

    def check(self, changes: dict) -> Scene:
        """Return the scene with live keys changed; raise InputError for bad keys or values."""
        known = live_keys(self.scene)
        raw = self.scene.raw
        for key, value in changes.items():
            if key not in known and key not in CHOSEN:
                raise InputError(f'{key}: cannot change while running (these can: '
                                 f'{", ".join(dict.fromkeys((*known, *CHOSEN)))})')
            raw = with_key(raw, key, plain(value))
        scene = scene_from_mapping(raw, where=self.scene.where, name=self.scene.name)
        check_warps(scene, [cloth.mesh for cloth in self.cloths])
        return scene
