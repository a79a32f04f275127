"""Scenes of a few particles, and functions that run and measure them."""

import atexit
from functools import cache
from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from support.meshes import ball, box, disc, obj_text
from xpbd_ros.effects import EFFECTS
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stepping import stages

GRAVITY = 9.80665
DOWN = [0.0, 0.5**0.5, 0.0, 0.5**0.5]
"""turns a cloth so that its warp points down"""
EXAMPLES = {
    'pin': {},
    'wind': {'velocity': [0.5, 1.0, 0.2]},
    'drag': {},
    'force': {'per_mass': [0.1, 0.0, -0.2]},
    'damping': {'rate': 1.0},
    'rayleigh': {'time': 0.001},
    'bend': {'stiffness': 2e-3},
    'cross_bend': {'stiffness': 1e-3},
    'hinge': {'warp': 2e-3, 'weft': 1e-3},
    'volume': {'young': 5.0, 'poisson': 0.35},
    'area': {'stiffness': 5.0},
    'pressure': {'outside': 20.0},
    'shear': {'stiffness': 15.0},
    'membrane': {'warp': 2.0, 'weft': 1.5, 'shear': 0.6, 'poisson': 0.3},
    'stretch': {'warp': 60.0, 'weft': 40.0},
    'strain_limit': {'max': 0.2},
    'tether': {'slack': 0.1},
    'seam': {},
    'self_collision': {'thickness': 0.003},
    'contact': {'thickness': 0.005},
    'friction': {},
}
"""parameters for each effect there is, of a cloth of about 1 m"""
SMALL_SHEET = """
duration: 0.25
cloths:
  sheet:
    grid: {size: [0.6, 0.2], resolution: [6, 3]}
    density: 0.2
    effects: {stretch: {warp: 300.0, weft: 300.0}}
pins:
  left: {cloth: sheet, at: corner_00}
"""
"""a scene file for what takes many runs"""
USUAL = ('pin', 'damping', 'bend', 'shear', 'stretch', 'contact', 'friction')
"""what most scenes call for; with all effects there are, a scene compiles for a minute"""
FEW = ('pin', 'stretch', 'contact')
"""less to compile, where the method is what counts"""
SHAPES = {'volume': lambda: box((2, 1, 1), 0.2), 'pressure': lambda: ball(1)}
"""vertices and cells for each effect of cloths that a grid cannot have"""
OF_SHEETS = [name for name, scope in EFFECTS.items() if scope == 'cloth' and name not in SHAPES]
SETTINGS = [*((method, integrator) for method in ('gauss_seidel', 'gauss_seidel_symmetric', 'line',
                                                  'jacobi')
              for integrator in ('backward_euler', 'bdf2')),
            ('line', 'ndf2'), ('explicit', 'leapfrog')]
"""each method with each integrator that goes with it"""


@cache
def disc_file() -> str:
    """Return the name of an OBJ file with a disc of 37 particles, 1 m across."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    file = Path(folder.name) / 'disc.obj'
    file.write_text(obj_text(*disc(3)))
    return str(file)


def simulate(grid=(2, 1), size=(1.0, 1.0), *, mesh: bool | str = False,
             effects: dict | None = None,
             scene_effects: dict | None = None, pins: dict | None = None,
             colliders: dict | None = None, pose: dict | None = None, density: float = 1.0,
             friction: float = 0.5, gravity=(0.0, 0.0, -GRAVITY), rate: float = 60.0,
             substeps: int | None = 1, iterations: int = 1, scale: float = 1.0,
             method: str = 'gauss_seidel', integrator: str | None = 'backward_euler',
             precision: str = 'float64', order: str = 'sequential') -> Simulation:
    """
    Return the simulation of one cloth, ``c``.

    It is a grid, a disc of triangles, or a mesh from a file. ``effects`` belong to the cloth and
    ``scene_effects`` to the scene; ``rate`` is in frames per second, ``scale`` multiplies all
    compliances.
    """
    return compile_scene(scene_from_mapping({
        'gravity': list(gravity), 'frame_rate': rate,
        'solver': {'method': method, 'iterations': iterations,
                   'precision': precision, 'compliance_scale': scale, 'order': order,
                   **{key: value for key, value in (
                       ('integrator', integrator), ('substeps', substeps)) if value is not None}},
        'cloths': {'c': {**({'mesh': {'file': disc_file() if mesh is True else mesh}} if mesh else
                            {'grid': {'size': list(size), 'resolution': list(grid)}}),
                         'density': density, 'friction': friction, 'pose': pose or {},
                         'effects': effects or {}}},
        **{key: value for key, value in (('effects', scene_effects), ('pins', pins),
                                         ('colliders', colliders)) if value is not None},
    }, where='small.yaml', name='small'))


def with_effects(grid=(6, 5), *, names=USUAL, **options: Any) -> Simulation:
    """Return a cloth, pinned at a corner, on a table; it has these effects where a sheet can."""
    names = [name for name in names if name not in SHAPES and not (
        name == 'rayleigh' and options.get('method') in ('line', 'explicit'))]
    kinds = {scope: {name: EXAMPLES[name] for name in names if EFFECTS[name] == scope}
             for scope in ('cloth', 'scene')}
    return simulate(grid, effects=kinds['cloth'], scene_effects=kinds['scene'], **{
        'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}},
        'colliders': {'table': {'plane': {}, 'position': [0.0, 0.0, -0.005]}}, **options})


def hang(n: int = 2, *, length: float = 1.0, damping: float = 10.0, **options: Any) -> Simulation:
    """Return a strip of n particles, 1 m wide, that hangs from its first; damped unless 0."""
    return simulate((n, 1), (length, 1.0), pose={'orientation': DOWN},
                    pins={'top': {'cloth': 'c', 'at': 'corner_00'}},
                    scene_effects={'damping': {'rate': damping}}, **options)


def numbers(simulation: Simulation, slots) -> np.ndarray:
    """Return the numbers, in natural order, of the particles in some slots."""
    number = np.full(simulation.state.x.shape[1], -1)
    number[simulation.slot] = np.arange(len(simulation.slot))
    return number[slots]


def edge_forces(simulation: Simulation, effect: str) -> np.ndarray:
    """Return the multiplier of each edge of an effect [N], negative in tension."""
    built = simulation.effects[effect]
    return built.data.edges.force[built.constraints.index]


def run(simulation: Simulation, frames: int, commands=()):
    """Advance by some frames, the commands before the first, and return the last frame."""
    frame = simulation.step(commands)
    for _ in range(frames - 1):
        frame = simulation.step()
    return frame


def run_until_still(simulation: Simulation, *, speed: float = 1e-13, frames: int = 3000):
    """Advance until nothing moves faster than this [m/s]; fail if that never happens."""
    for _ in range(frames):
        frame = simulation.step()
        if np.abs(frame.v).max() < speed:
            return frame
    raise AssertionError(f'still moving at {np.abs(frame.v).max():.3g} m/s')


def run_stage(stage, data, state, substep) -> None:
    """Run a stage of a part of an effect; what has no ``prepare`` gets its multipliers zeroed."""
    kernel = stages.KERNELS.get((stage, type(data)))
    if kernel is not None:
        order = stage is stages.project_back, False
        kernel(data, state, substep, *order * (kernel in stages.SWEEPS))
    elif stage is stages.prepare and stages.KERNELS.get(
            (stages.project, type(data))) in stages.SWEEPS:
        force = getattr(data, 'edges', data).force
        if force is not None:
            force[:] = 0.0
