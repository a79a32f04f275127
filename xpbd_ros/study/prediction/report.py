"""The report of ``xpbd_ros check``: predictions and warnings for a scene."""

from dataclasses import dataclass, replace
from math import ceil, inf
from typing import Any

import numpy as np

from xpbd_ros.errors import counted
from xpbd_ros.scene.auto import INTEGRATOR, table_of
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.frames import notes_without_tf
from xpbd_ros.scene.grip import carried_tension
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.contact.collider_entries import Entry
from xpbd_ros.sim.contact.distance_field import Field
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stepping.solver import Solver
from xpbd_ros.study.prediction.decay import Decay, decays
from xpbd_ros.study.prediction.loads import in_axes
from xpbd_ros.study.prediction.stiffness import GRAVITY, Row, stiffness, UNPREDICTED
from xpbd_ros.study.prediction.substeps import MOST, needed, STRETCH

ERRORS = (0.1, 0.01, 0.001)
"""relative errors of the stretch for which substeps are predicted"""
WARNED_ERROR = 0.1
"""relative error of a stiffness from which on there is a warning"""
WARNED_STRAIN = 0.01
"""mean strain of a rigid cloth that hangs from a side, from which on there is a warning"""
LARGE, HEAVY = 50.0, 30.0
"""extent [m] and density [kg/m²] beyond those of cloth: as of numbers in cm, mm and g/m²"""


@dataclass(frozen=True)
class Report:
    """Predictions for a scene."""

    solver: Solver
    """setting, with ``auto`` resolved"""
    particles: int
    constraints: int
    stiffness: list[Row]
    decay: list[Decay]
    substeps_for: dict[str, int | None]
    """substeps by relative error of the stretch; None if out of reach; empty for cloth without a
    prediction of it"""
    frame_ms: float
    """expected time of a frame on ``cpu`` [ms]"""
    cpu: str
    """that of the cost table"""
    frame_dt_ms: float
    """frame period [ms]"""
    warnings: list[str]
    notes: tuple[str, ...] = ()
    """repairs of meshes from files, effects without a prediction, and the pressure of pads"""

    @property
    def ok(self) -> bool:
        """True if there are no warnings."""
        return not self.warnings


def check(scene: Scene) -> Report:
    """Return the predictions for a scene, without compiling kernels."""
    simulation = compile_scene(scene)
    solver = simulation.solver
    rows = stiffness(scene, simulation, solver)
    counts = {f'{error:g}': needed(scene, simulation, solver, error) for error in ERRORS
              if any(row.effect in ('shear', *STRETCH) for row in rows)}
    table = table_of(scene.top.solver)
    expected = 1e-6 * solver.substeps * table.substep_ns(
        solver.method, solver.iterations, simulation.effects, simulation.state,
        simulation.frame_dt / solver.substeps, solver.substeps)
    frame_dt_ms = 1e3 * simulation.frame_dt
    warnings = [*_soft(scene, simulation, rows, counts.get('0.1')), *_slow(expected, frame_dt_ms),
                *_unsupported(scene), *_thin(scene, simulation), *_thick(scene, simulation),
                *_units(scene, simulation), *_coarse(scene, simulation)]
    return Report(solver, len(simulation.slot), _count(simulation), rows,
                  decays(scene, simulation, solver), counts, expected, table.cpu, frame_dt_ms,
                  warnings, (*notes_without_tf(scene), *simulation.notes,
                             *_unpredicted(simulation), *_pads(scene, simulation)))


def _unpredicted(simulation: Simulation) -> tuple[str, ...]:
    return tuple(f'{name}: no stiffness is predicted: {why}'
                 for name, why in UNPREDICTED.items() if name in simulation.effects)


def _pads(scene: Scene, simulation: Simulation) -> list[str]:
    """Return the pressure of each pad for a millimetre, and the tension that a grip can take."""
    found = [f'colliders.{name}.pad: presses with {1e-7 * entry.pad.stiffness:.4g} N/cm² per mm '
             f'of indentation ({entry.pad.stiffness:g} Pa/m)'
             for name, entry in scene.sections.get('colliders', {}).items()
             if entry.pad is not None]
    solver = simulation.solver
    if solver.mixes and solver.method == 'explicit':
        solver = solver.rough    # whose frames carry less
    for cloth in simulation.cloths if found and solver.method != 'explicit' else ():
        density = scene.cloths[cloth.name].density
        if density is not None and not len(cloth.mesh.tetrahedra):
            tension = carried_tension(solver.method, cloth, density,
                                      simulation.frame_dt / solver.substeps)
            found.append(f'cloths.{cloth.name}: with {counted(solver.substeps, "substep")} of '
                         f'{solver.method} up to {tension:.3g} N/m go into a grip of pads')
    return found


def _count(simulation: Simulation) -> int:
    return sum(len(built.constraints.particles) for built in simulation.effects.values()
               if built.constraints is not None)


def size_of(scene: Scene, cloth: str) -> str:
    """Return a cloth's name, with its resolution if it is a grid."""
    grid = scene.cloths[cloth].grid
    return cloth if grid is None else f'{cloth}: {grid.resolution[0]}x{grid.resolution[1]}'


def _soft(scene: Scene, simulation: Simulation, rows: list[Row], enough: int | None) -> list[str]:
    """Return warnings about cloths that will be softer or stiffer than asked."""
    found, solver = [], simulation.solver
    for row in rows:
        if np.isinf(row.asked):
            found += _not_rigid(scene, simulation, row)
            continue
        if abs(row.error) <= WARNED_ERROR:
            continue
        where = f' along {row.direction}' if row.direction else ''
        text = (f'{size_of(scene, row.cloth)} at {counted(solver.substeps, "substep")} behaves '
                f'like {_three(row.effective)} {row.unit}{where} ({row.effect}), not '
                f'{row.asked:.6g}')
        if row.effect == 'pressure':
            text = (f'{row.cloth} at {counted(solver.substeps, "substep")} has an overpressure '
                    f'of {_three(row.effective)} Pa, not {row.asked:.4g}')
        if row.effect in STRETCH:
            text += f'; {_remedy(scene, simulation, enough)}'
        else:
            text += f'; {_more(scene, simulation, row)}'
        found.append(text)
    if not found and enough is not None and solver.substeps < enough:
        found.append(f'{solver.substeps} substeps are too few for the stretch waves of this cloth:'
                     f' errors above 10 %; {_remedy(scene, simulation, enough)}')
    return found


def _three(value: float) -> str:
    """Return a number with three digits, without an exponent below a million."""
    return f'{float(f"{value:.3g}"):g}'


def _more(scene: Scene, simulation: Simulation, row: Row) -> str:
    """Return the substeps with which a row is about as stiff as asked, by the law 1 / N²."""
    solver = simulation.solver
    count = ceil(solver.substeps * (abs(row.error) / WARNED_ERROR)**0.5)
    if count <= MOST:
        again = stiffness(scene, simulation, replace(solver, substeps=count))
        error = next(one.error for one in again if (one.cloth, one.effect, one.direction)
                     == (row.cloth, row.effect, row.direction))
        if abs(error) <= 2.0 * WARNED_ERROR:
            return f'about {count} substeps would do'
    return 'more substeps would not do; take more iterations or another method'


def _not_rigid(scene: Scene, simulation: Simulation, row: Row) -> list[str]:
    """Return a warning if edges that ought to be rigid lengthen under the cloth's own weight."""
    cloth = next(c for c in simulation.cloths if c.name == row.cloth)
    density, solver = scene.cloths[row.cloth].density, simulation.solver
    assert density is not None
    long = float(np.ptp(in_axes(cloth.mesh)[:, ('warp', 'weft').index(row.direction or 'warp')]))
    strain = 0.5 * density * GRAVITY * long / row.effective
    if strain <= WARNED_STRAIN:
        return []
    count = ceil(solver.substeps * (strain / WARNED_STRAIN)**0.5)
    line = '' if solver.method == 'line' or cloth.mesh.grid is None else ' or method line'
    return [f'{size_of(scene, row.cloth)} at {counted(solver.substeps, "substep")} behaves '
            f'like {_three(row.effective)} {row.unit} along {row.direction} ({row.effect}), not '
            f'like rigid edges: hung by a side it is {100.0 * strain:.2g} % longer; about {count} '
            f'substeps{line} would do']


def _remedy(scene: Scene, simulation: Simulation, enough: int | None) -> str:
    """Return the substeps, or the method, with which the stretch is resolved."""
    solver = simulation.solver
    ways = [] if enough is None else [f'{enough} substeps']
    if solver.method != 'line':
        line = replace(solver, method='line', integrator=INTEGRATOR['line'])
        count = needed(scene, simulation, line, WARNED_ERROR)
        if count is not None:
            ways.append('method line' if count <= solver.substeps
                        else f'method line with {count} substeps')
    return ' or '.join(ways) + ' would do' if ways else 'no number of substeps would do'


def _slow(expected: float, frame_dt_ms: float) -> list[str]:
    if expected <= frame_dt_ms:
        return []
    return [f'a frame takes about {expected:.3g} ms and there are {frame_dt_ms:.3g}: fewer '
            'substeps, a coarser cloth or a lower frame_rate would hold real time']


def _unsupported(scene: Scene) -> list[str]:
    held = scene.sections.get('pins') or 'pin' in scene.effects or 'contact' in scene.effects
    if held or not any(scene.top.gravity):
        return []
    return ['no pins and no contact: the cloth falls for ever']


def _thin(scene: Scene, simulation: Simulation) -> list[str]:
    """Return warnings about colliders that fit between particles."""
    found = []
    spacing = max((cloth.mesh.gap for cloth in simulation.cloths), default=0.0)
    contact: Any = simulation.effects.get('contact')
    for name, entry in scene.sections.get('colliders', {}).items():
        size = _width(entry, contact.shapes.get(name))
        if size < spacing:
            found.append(f'colliders.{name}: {size:g} m across, and particles are {spacing:.3g} m '
                         'apart: it can pass between them; use a finer cloth')
    return found


def _thick(scene: Scene, simulation: Simulation) -> list[str]:
    """Return warnings about thicknesses in millimetres, and about those that cost much."""
    found = []
    contact, selves = (scene.effects.get(name) for name in ('contact', 'self_collision'))
    size = max(float(np.ptp(cloth.mesh.positions, 0).max()) for cloth in simulation.cloths)
    spacing = max(cloth.mesh.gap for cloth in simulation.cloths)
    if contact is not None and contact.thickness > size:
        found.append(f'effects.contact.thickness: {contact.thickness:g} m, and the largest cloth '
                     f'is {size:.3g} m; thicknesses are in metres')
    if selves is not None and selves.thickness > spacing:
        found.append(f'effects.self_collision.thickness: {selves.thickness:g} m, and particles '
                     f'are {spacing:.3g} m apart: its time grows with the square of the ratio; '
                     'choose a smaller one')
    return found


def _units(scene: Scene, simulation: Simulation) -> list[str]:
    """Return warnings about sizes and densities that look like numbers in other units."""
    found = []
    for cloth in simulation.cloths:
        keys = scene.cloths[cloth.name]
        size = float(np.ptp(cloth.mesh.positions, 0).max())
        if size > LARGE:
            way = 'sizes are in metres' if keys.mesh is None else (
                'unless its file is in metres, give mesh.scale, such as 0.01 for centimetres')
            found.append(f'cloths.{cloth.name}: is {size:.3g} m large; {way}')
        assert keys.density is not None
        if keys.density > HEAVY and not len(cloth.mesh.tetrahedra):
            found.append(f"cloths.{cloth.name}.density: {keys.density:g} kg/m² is no cloth's; "
                         '250 g/m² are 0.25')
    return found


def _width(entry: Entry, shape: Field | np.ndarray | None) -> float:
    """Return the largest spacing of particles that a collider cannot pass between [m]."""
    if entry.plane is not None or entry.heights is not None:
        return inf
    if isinstance(shape, Field):
        return sorted(shape.size)[1]    # particles hit a thin plate too
    if entry.box is not None:
        return sorted(entry.box.size)[1]
    tube = entry.sphere or entry.capsule or entry.cylinder
    assert tube is not None
    return 2.0 * tube.radius


def _coarse(scene: Scene, simulation: Simulation) -> list[str]:
    """Return a warning if float32 loses gravity (doc/numerics.md 2.5)."""
    if simulation.solver.precision != 'float32':
        return []
    h = simulation.frame_dt / simulation.solver.substeps
    fall = max(map(abs, scene.top.gravity)) * h * h
    grain = float(np.spacing(np.abs(simulation.state.x).max()))
    if fall == 0.0 or 0.5 * grain <= 0.01 * fall:
        return []
    return [f'float32 rounds positions to {grain:.2g} m here, and gravity moves a particle by '
            f'{fall:.2g} m in a substep: up to {min(1.0, 0.5 * grain / fall):.0%} of gravity is '
            'lost; take precision float64, or an origin closer to the cloth']
