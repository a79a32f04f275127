"""Every effect with an energy, in motion and at rest, against the reference solver."""

from importlib.util import find_spec
from pathlib import Path
import tempfile

from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.study.reference import equilibrium, limit, problem_of, rms
from xpbd_ros.study.verify.bodies import sphere
from xpbd_ros.study.verify.build import BDF2, G, run
from xpbd_ros.study.verify.case import case, order, value
from xpbd_ros.study.verify.elastic import run_to_rest

_FOLDER = tempfile.TemporaryDirectory(prefix='xpbd_ros_')
FRAMES = 6
SOFT = {'stretch': {'warp': 30.0, 'weft': 20.0}}


def block() -> Path:
    """Write a VTK file of two cubes of 0.1 m, six tetrahedra each, and return its path."""
    corners = [(i, j, k) for i in range(3) for j in range(2) for k in range(2)]
    tetrahedra = [[4 * i + sum((4, 2, 1)[a] for a in way[:n]) for n in range(4)] for i in (0, 1)
                  for way in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (1, 0, 2), (0, 2, 1), (2, 1, 0))]
    file = Path(_FOLDER.name) / 'block.vtk'
    file.write_text('\n'.join([
        '# vtk DataFile Version 3.0', 'block', 'ASCII', 'DATASET UNSTRUCTURED_GRID',
        f'POINTS {len(corners)} double',
        *('{} {} {}'.format(*(0.1 * c for c in corner)) for corner in corners),
        f'CELLS {len(tetrahedra)} {5 * len(tetrahedra)}',
        *('4 {} {} {} {}'.format(*tetrahedron) for tetrahedron in tetrahedra),
        f'CELL_TYPES {len(tetrahedra)}', *['10'] * len(tetrahedra)]) + '\n')
    return file


def scene(substeps: int, names: tuple[str, ...] | None = None, *, damping: float = 0.5
          ) -> Simulation:
    """
    Return a scene with one pinned cloth per effect, which falls from rest.

    Parameters
    ----------
    substeps : of the solver
    names : cloths to keep; None for all
    damping : rate [1/s]

    """
    grid = {'grid': {'size': [0.3, 0.2], 'resolution': [4, 3]}, 'density': 1.0}
    cloths = {
        'membrane': {**grid, 'effects': {'membrane': {'warp': 40.0, 'weft': 25.0, 'shear': 10.0,
                                                      'poisson': 0.3}}},
        'shear': {**grid, 'grid': {'size': [0.3, 0.1], 'resolution': [4, 3]},
                  'effects': {**SOFT, 'shear': {'stiffness': 8.0}}},
        'hinge': {**grid, 'effects': {**SOFT, 'hinge': {'stiffness': 0.02}}},
        'cross_bend': {**grid, 'effects': {**SOFT, 'cross_bend': {'stiffness': 0.02}}},
        'area': {**grid, 'effects': {**SOFT, 'area': {'stiffness': 30.0}}},
        'pressure': {'mesh': {'file': str(sphere(1)[0])}, 'density': 1.0,
                     'effects': {**SOFT, 'pressure': {'amount': 1.01, 'outside': 500.0}}},
        'seam': {**grid, 'effects': SOFT},
        'sewn': {**grid, 'effects': SOFT, 'pose': {'position': [0.0, 0.2, 0.0]}}}
    if find_spec('meshio'):
        cloths['volume'] = {'mesh': {'file': str(block())}, 'density': 100.0,
                            'effects': {'volume': {'young': 3000.0, 'poisson': 0.3}}}
    at = {'pressure': {'near': [0.0, 0.0, 0.1], 'radius': 0.05},
          'volume': {'near': [0.0, 0.0, 0.0], 'radius': 0.01},
          'seam': {'at': 'edge_0x', 'compliance': 0.01}}
    seams = {'seam': {'compliance': 0.01, 'between': [{'cloth': 'seam', 'at': 'edge_1x'},
                                                      {'cloth': 'sewn', 'at': 'edge_0x'}]}}
    chosen = {name: cloth for name, cloth in cloths.items() if names is None or name in names}
    raw = {'gravity': [0.0, 0.0, -G], 'cloths': chosen,
           'solver': {'method': 'gauss_seidel_symmetric', 'integrator': BDF2,
                      'substeps': substeps},
           'pins': {name: {'cloth': name, **at.get(name, {'at': 'edge_0x'})} for name in chosen
                    if name != 'sewn'},
           'effects': {'force': {'per_mass': [1.0, -2.0, 0.5]}, 'damping': {'rate': damping}},
           **({'seams': seams} if 'seam' in chosen else {})}
    return compile_scene(scene_from_mapping(raw, where='a case', name='case'))


@case('V29', 'every effect with an energy, in motion', slow=True)
def energies():
    """RMS error of the positions after 0.1 s of falling is of second order."""
    first = scene(64)
    found = limit(problem_of(first), FRAMES * first.frame_dt, 1e-9)
    counts = (32, 64, 128, 256)
    errors: dict[str, list[float]] = {}
    for count in counts:
        simulation = scene(count)
        x = run(simulation, FRAMES).x
        for cloth in simulation.cloths:
            errors.setdefault(cloth.name, []).append(
                rms(x[cloth.particles] - found.x[cloth.particles]))
    for name, got in errors.items():
        yield order(name, 0.0, [1 / 60 / count for count in counts], got, 'm', 2.0, 1e-6,
                    step='substep [s]')


@case('V30', 'every effect with an energy, at rest', slow=True)
def rest():
    """RMS error of the positions at rest, against the equilibrium of forces."""
    simulation = scene(64, damping=20.0)
    x = run_to_rest(simulation, 1e-11, 1500).x
    exact = equilibrium(problem_of(simulation))
    for cloth in simulation.cloths:
        yield value(cloth.name, 0.0, rms(x[cloth.particles] - exact[cloth.particles]), 'm', 1e-5,
                    absolute=True)
