"""
Random scenes for cost tables: sheets, meshes and membranes, free, in contact and in wind.

All scenes of a kind name the same effects and shapes, so each kind compiles once. Sizes,
resolution and stiffness are drawn. Meshes are Delaunay triangulations of jittered points.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

CONTACT = {'contact': {'thickness': 0.004}, 'friction': {}}
PLANE = {'plane': {}, 'friction': 0.5}


def random_scenes(count: int, seed: int, folder: Path,
                  kinds: Sequence[Callable[[Any, Path], dict]]) -> dict[str, dict]:
    """
    Return raw scenes by name, all kinds in turn.

    Parameters
    ----------
    count, seed : number of scenes, and seed of what is drawn
    folder : for the files of meshes
    kinds : functions that return a scene, from a NumPy generator and the folder

    """
    return {f'{kind.__name__}_{k // len(kinds)}': {'duration': 1.0, **kind(
        np.random.default_rng((seed, k)), folder)}
        for k, kind in ((k, kinds[k % len(kinds)]) for k in range(count))}


def sheet(draw, *, spacing=(0.012, 0.03), cells=(14, 50), position=(0.0, 0.0, 0.0),
          orientation=(0.0, 0.0, 0.0, 1.0)) -> dict:
    """Return a grid of cotton of drawn size and stiffness."""
    side = draw.uniform(*spacing)
    across, along = draw.integers(*cells, 2)
    return {'grid': {'size': [float(side * (across - 1)), float(side * (along - 1))],
                     'resolution': [int(across), int(along)]},
            'density': float(draw.uniform(0.1, 0.4)), 'friction': 0.5,
            'pose': {'position': [float(a) for a in position],
                     'orientation': [float(a) for a in orientation]},
            'effects': {'stretch': {'warp': stiffness(draw), 'weft': stiffness(draw)},
                        'shear': {'stiffness': float(draw.uniform(2.0, 30.0))},
                        'bend': {'stiffness': 5e-5}}}


def stiffness(draw) -> float:
    """Return a stretch stiffness between 100 and 2000 N/m."""
    return float(np.exp(draw.uniform(np.log(100.0), np.log(2000.0))))


def corners(cloth: str = 'c') -> dict:
    """Return pins at two corners."""
    return {'a': {'cloth': cloth, 'at': 'corner_00'}, 'b': {'cloth': cloth, 'at': 'corner_10'}}


def hanging(draw, folder) -> dict:
    """Return a sheet that swings from two corners."""
    return {'cloths': {'c': sheet(draw)}, 'pins': corners(),
            'effects': {'damping': {'rate': 0.5}}}


def draped(draw, folder) -> dict:
    """Return a sheet that falls over a ball."""
    cloth = sheet(draw, spacing=(0.012, 0.02), position=(-0.25, -0.2, 0.3))
    return {'cloths': {'c': cloth}, 'effects': {'damping': {'rate': 0.5}, **CONTACT},
            'colliders': {'ball': {'sphere': {'radius': float(draw.uniform(0.06, 0.15))},
                                   'position': [0.0, 0.0, 0.13], 'friction': 0.4},
                          'table': PLANE}}


def blown(draw, folder) -> dict:
    """Return a flag in the wind."""
    return {'cloths': {'c': sheet(draw, orientation=(0.7071067811865476, 0, 0,
                                                     0.7071067811865476))},
            'pins': {'mast': {'cloth': 'c', 'at': 'edge_0x'}},
            'effects': {'wind': {'velocity': [float(draw.uniform(2.0, 8.0)), 1.0, 0.0]},
                        'drag': {}}}


def meshed(draw, folder) -> dict:
    """Return an irregular mesh that falls on a table."""
    file = folder / f'mesh_{draw.integers(1 << 40)}.obj'
    write_mesh(file, draw, int(draw.integers(12, 36)), float(draw.uniform(0.3, 0.6)))
    return {'cloths': {'c': {
        'mesh': {'file': str(file)}, 'density': float(draw.uniform(0.1, 0.4)), 'friction': 0.5,
        'pose': {'position': [0.0, 0.0, 0.1], 'orientation': turned(draw, 30.0)},
        'effects': {'stretch': {'warp': stiffness(draw), 'weft': stiffness(draw)},
                    'hinge': {'stiffness': 1e-4}}}},
        'effects': {'damping': {'rate': 0.5}, **CONTACT}, 'colliders': {'table': PLANE}}


def stretched(draw, folder) -> dict:
    """Return a membrane that is pulled at one edge."""
    cloth, wide = sheet(draw, cells=(14, 36)), draw.uniform(50.0, 300.0, 3)
    wide[2] *= 0.3
    cloth['effects'] = {'membrane': {**dict(zip(('warp', 'weft', 'shear'), map(float, wide))),
                                     'poisson': 0.3}}
    width = cloth['grid']['size'][0]
    return {'cloths': {'c': cloth}, 'effects': {'damping': {'rate': 5.0}}, 'pins': {
        'held': {'cloth': 'c', 'at': 'edge_0x'},
        'pulled': {'cloth': 'c', 'at': 'edge_1x', 'motion': [
            [0.0, width, 0.5 * cloth['grid']['size'][1], 0.0],
            [1.0, 1.1 * width, 0.5 * cloth['grid']['size'][1], 0.0]]}}}


def turned(draw, most: float) -> list[float]:
    """Return a random rotation of up to ``most`` degrees, as a quaternion x y z w."""
    axis = draw.normal(size=3)
    angle = np.radians(draw.uniform(0.3, 1.0) * most)
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_quat().tolist()


def write_mesh(file: Path, draw, cells: int, size: float) -> None:
    """Write an OBJ file of a square of about cells² jittered vertices."""
    ticks = np.linspace(-0.5 * size, 0.5 * size, cells)
    points = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2)
    inside = (np.abs(points) < 0.49 * size).all(1)
    points[inside] += draw.uniform(-0.3, 0.3, (inside.sum(), 2)) * size / (cells - 1)
    faces = Delaunay(points).simplices + 1
    file.write_text(''.join([f'v {x:.9g} {y:.9g} 0\n' for x, y in points]
                            + [f'f {a} {b} {c}\n' for a, b, c in faces]))


KINDS = (hanging, draped, blown, meshed, stretched)
"""what cost tables are fitted to"""
