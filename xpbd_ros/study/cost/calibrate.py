"""
Measure the cost table of this machine, for ``solver.cost_table``.

Three shipped scenes run with every method, with a clock read between the kernels of the effects
(``study.cost.measure``): a sheet in contact, a mesh, and a sheet in wind. The times of a
constraint are those of the kernels; all that is no effect with constraints or an entry of its own,
such as integration and pins, is counted by slot. Single precision is as in the shipped table.
Sheets of growing size tell from how many particles on a second thread pays.
"""

from collections.abc import Callable, Iterable
from statistics import median
import time

from xpbd_ros.effects.contact import BuiltContact
from xpbd_ros.effects.drag import BuiltDrag
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.cost_table import CostTable, METHODS, SHIPPED
from xpbd_ros.scene.load import load_scene
from xpbd_ros.scene.threads import free_cores
from xpbd_ros.study.cost.measure import Cost, cost

GRID, MESH, AIR = 'drape', 'arch', 'flag'
"""shipped scenes: edges, shear, bending and contact of a grid; edges and hinges of a mesh; drag"""
SHEET, SIDES = 'swing', (45, 64, 91, 128, 181)
"""scene of the sheets, and their particles along each side"""
GAIN = 1.15
"""time with one thread over that with two from which on these pay"""
FRAMES, ROUNDS = 20, 3
"""frames of each run, and runs"""
SUBSTEPS = {'explicit': 80}
"""substeps of each run, where they are not FEW"""
FEW = 16
OWN_NS = {'contact': BuiltContact.ns_per_substep, 'drag': BuiltDrag.ns_per_substep}
"""times of effects whatever the particles, which stay as they are [ns]"""


def calibrate(progress: Callable[[Iterable, str], Iterable] = lambda items, _: items,
              scenes: tuple[str, str, str] = (GRID, MESH, AIR), frames: int = FRAMES,
              rounds: int = ROUNDS) -> CostTable:
    """
    Return the cost table of this machine.

    Parameters
    ----------
    progress : passes the methods on, and shows how far it is
    scenes : as GRID, MESH, AIR
    frames, rounds : of each measurement

    """
    methods = {}
    effects: dict[str, list[float]] = {}
    for method in progress(METHODS, 'methods'):
        grid, irregular = (_measured(name, method, frames, rounds) for name in scenes[:2])
        rows, others = ({row.name: row for row in found.effects if row.present}
                        for found in (grid, irregular))
        methods[method] = {
            'substep': SHIPPED.methods[method]['substep'], 'slot': _by_slot(grid, rows),
            'edge': _ns(rows, 'stretch'), 'hinge': _ns(rows, 'bend'), 'shear': _ns(rows, 'shear'),
            'mesh_edge': _ns(others, 'stretch'), 'mesh_hinge': _ns(others, 'hinge')}
        effects.setdefault('contact', []).append(_by_particle(grid, rows, 'contact'))
    air = _measured(scenes[2], 'line', frames, rounds)
    rows = {row.name: row for row in air.effects if row.present}
    effects['drag'] = [_by_particle(air, rows, 'drag')]
    return CostTable({name: {key: round(float(value), 3) for key, value in entries.items()}
                      for name, entries in methods.items()}, SHIPPED.single,
                     {name: round(float(sum(found) / len(found)), 3)
                      for name, found in effects.items()},
                     particles_per_thread(frames * rounds))


def particles_per_thread(frames: int, sides: Iterable[int] = SIDES) -> float:
    """Return the fewest particles with which each of two threads pays; SHIPPED's on one core."""
    if free_cores() < 2:
        return SHIPPED.particles_per_thread
    for side in sides:
        if gain_of_two_threads(side, frames) >= GAIN:
            break
    return 0.5 * side**2


def gain_of_two_threads(side: int, frames: int) -> float:
    """Return the median time of a frame with one thread over that with two, in turn."""
    both = [compile_scene(load_scene(SHEET, {
        'cloths.sheet.grid.resolution': [side, side], 'solver.method': 'line',
        'solver.substeps': FEW, 'solver.threads': threads})) for threads in (1, 2)]
    times: list[list[float]] = [[], []]
    for simulation in both:
        simulation.compile()
    for _ in range(frames):
        for simulation, took in zip(both, times):
            begin = time.perf_counter()
            simulation.step()
            took.append(time.perf_counter() - begin)
    one, two = map(median, times)
    return one / two


def _measured(name: str, method: str, frames: int, rounds: int) -> Cost:
    """Return the cost of a shipped scene with one method."""
    scene = load_scene(name, {'solver.method': method,
                              'solver.substeps': SUBSTEPS.get(method, FEW)})
    return cost(scene, frames, rounds=rounds)


def _ns(rows: dict, name: str) -> float:
    """Return the time of a constraint of an effect [ns]."""
    if name not in rows or not rows[name].constraints:
        raise InputError(f'cost --calibrate: the scene has no {name}')
    return max(rows[name].ns_per_constraint, 1e-3)


def _by_particle(found: Cost, rows: dict, name: str) -> float:
    """Return the time of an effect for each particle, besides its time per substep [ns]."""
    return max((1e3 * rows[name].us_per_substep - OWN_NS[name]) / found.particles, 0.0)


def _by_slot(found: Cost, rows: dict) -> float:
    """Return the time of all else, for each particle [ns]."""
    own = ('stretch', 'shear', 'bend', 'contact')
    rest = [row.us_per_substep for name, row in rows.items() if name not in own]
    rest += [row.us_per_substep for row in found.others if row.name in ('integration', 'rest')]
    return max(1e3 * sum(rest) / found.particles, 1e-3)
