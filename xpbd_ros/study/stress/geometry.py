"""Geometry: invalid meshes, folds, collapsed sheets, inverted bodies, random starts."""

from dataclasses import replace
from functools import partial
from pathlib import Path
import tempfile

import numpy as np

from xpbd_ros.study.stress.case import hard, Setting
from xpbd_ros.study.stress.refusals import Refusal
from xpbd_ros.study.stress.scenes import alone, FEW, FIRM, FLAT, LINE, N, sheet, SIZE, USUAL
from xpbd_ros.study.stress.trial import Trial

FOLDER = tempfile.TemporaryDirectory(prefix='xpbd_ros_stress_')
SQUARE = '0 0 0', '1 0 0', '1 1 0', '0 1 0'


def obj(name: str, vertices, faces) -> str:
    """Write an OBJ file and return its path."""
    file = Path(FOLDER.name) / f'{name.replace(" ", "_")}.obj'
    file.write_text('\n'.join([*(f'v {v}' for v in vertices), *(f'f {f}' for f in faces), '']))
    return str(file)


@hard('H6', 'invalid meshes')
def bad_meshes():
    """Invalid meshes are refused, or repaired with a note."""
    for name, vertices, faces, says, mended in (
            ('coincident vertices', (*SQUARE, '1 1 0'), ('1 2 3', '1 5 4'), ('merged',), True),
            ('a triangle twice', SQUARE, ('1 2 3', '1 3 4', '2 3 1'), ('twice',), True),
            ('a vertex of no triangle', (*SQUARE, '5 5 5'), ('1 2 3', '1 3 4'), (
                'no triangle',), True),
            ('a triangle turned over', SQUARE, ('1 2 3', '1 4 3'), ('turned',), True),
            ('a triangle without area', (*SQUARE, '2 0 0'), ('1 2 3', '1 2 5'), (
                'degenerate',), False),
            ('an edge of no length', (*SQUARE, '0 0 0'), ('1 2 3', '1 5 4'), ('merged',), True),
            ('a needle', (*SQUARE, '0.5 1e-14 0'), ('1 2 3', '1 2 5'), ('degenerate',), False),
            ('an edge with three triangles', (*SQUARE, '0 0 1'), ('1 2 3', '1 3 4', '1 3 5'), (
                'more than two triangles',), False),
            ('a vertex that is NaN', ('0 0 nan', *SQUARE[1:]), ('1 2 3', '1 3 4'), (
                'must be finite',), False),
            ('an index without a vertex', SQUARE, ('1 2 3', '1 3 9'), ('does not exist',), False),
            ('an empty file', (), (), ('has no triangles',), False)):
        scene = {'cloths': {'c': {'mesh': {'file': obj(name, vertices, faces)}, 'density': 0.2,
                                  'effects': {'stretch': {'warp': 10.0, 'weft': 10.0}}}}}
        yield Refusal(name, scene, says, mended)


FOLDING = alone({'stretch': {'warp': 1000.0, 'weft': 1000.0}, 'hinge': {'stiffness': 1e-3}},
                pins={'a': 'edge_x0'}, pose=FLAT, gravity=0.0, damping=0.5)


def folded(angle: float, speed: float, x):
    """Return a sheet folded by an angle [rad]; the flap's edge moves at a speed [m/s]."""
    found, v = x.copy(), np.zeros_like(x)
    arm = np.maximum(found[:, 0] - SIZE / 2.0, 0.0)
    over = arm > 0.0
    c, s = np.cos(angle), np.sin(angle)
    found[over, 0] = SIZE / 2.0 + c * arm[over]
    found[over, 2] = s * arm[over]
    v[over] = np.stack([-s * arm, np.zeros_like(arm), c * arm], 1)[over] * speed / (SIZE / 2.0)
    return found, v


NEARLY_SHUT = 2.6
"""fold angle of the book at rest [rad]"""
PAGES = np.array([(SIZE / 6.0 * i, SIZE / 6.0 * j, 0.0) for j in range(3) for i in range(7)])


def book() -> dict:
    """Return the scene of two stiff pages whose hinge is at rest at NEARLY_SHUT."""
    corners = [(7 * j + i, 7 * j + i + 1, 7 * j + i + 8, 7 * j + i + 7)
               for j in range(2) for i in range(6)]
    faces = [f'{p + 1} {q + 1} {r + 1}' for a, b, c, d in corners for p, q, r in (
        (a, b, c), (a, c, d))]
    vertices = [f'{x:.17g} {y:.17g} {z:.17g}' for x, y, z in folded(NEARLY_SHUT, 0.0, PAGES)[0]]
    return alone({'stretch': {'warp': 1000.0, 'weft': 1000.0}, 'hinge': {'stiffness': 1e-3}},
                 mesh={'file': obj('book', vertices, faces)}, pins={}, pose=FLAT, gravity=0.0,
                 damping=0.5)


@hard('H7', 'folds of half a turn and more')
def folds():
    """Hinges at and beyond half a turn cause no jump of force: energy does not rise."""
    settings = (*FEW, replace(LINE, substeps=32), Setting('jacobi', 'backward_euler'))
    for label, angle, speed in (('flat', 0.0, 0.0), ('half a turn', np.pi, 0.0),
                                ('minus half a turn', -np.pi, 0.0),
                                ('through half a turn', 0.9 * np.pi, 2.0)):
        for setting in settings:
            yield Trial(setting, FOLDING, 2.0, start=partial(folded, angle, speed), energy=0.05,
                        strain=2.0, speed=10.0, label=label)
    scene, shut = book(), folded(0.95 * np.pi, 2.0, PAGES)
    for setting in settings:
        yield Trial(setting, scene, 2.0, start=lambda x: shut, energy=0.05, strain=2.0,
                    speed=10.0, label='a book that shuts further')


SHEET = alone({'membrane': {'young': 1000.0, 'poisson': 0.3}})
"""a soft membrane of finite elements, without other effects"""
STIFF = alone({'membrane': {'young': 1e6, 'poisson': 0.3}})


def collapsed(shape: str, x):
    """Return a sheet collapsed along one or two axes, or mirrored; pinned corners stay."""
    found = x.copy()
    inner = np.ones(len(x), bool)
    inner[[N * (N - 1), N * N - 1]] = False
    middle = x.mean(0)
    left = 1e-6 if 'nearly' in shape else 0.0
    if 'line' in shape or 'point' in shape:
        found[inner, 0] = middle[0] + left * (x[inner, 0] - middle[0])
    if 'point' in shape:
        found[inner, 2] = middle[2] + left * (x[inner, 2] - middle[2])
    if shape == 'mirrored':
        found[inner, 0] = 2.0 * middle[0] - found[inner, 0]
    return found, np.zeros_like(x)


@hard('H8', 'collapsed membranes')
def membranes():
    """Collapsed to a line or a point, or mirrored, a membrane recovers its shape."""
    for shape in ('line', 'nearly a line', 'point', 'nearly a point', 'mirrored'):
        for setting in (*FEW, replace(LINE, substeps=32)):
            yield Trial(setting, SHEET, 4.0, start=partial(collapsed, shape), recovery_strain=0.05,
                        label=shape)
            if 'nearly' in shape:
                yield Trial(setting, STIFF, 4.0, start=partial(collapsed, shape),
                            recovery_strain=0.05, strain=2.0, label=f'{shape}, stiff')


def body() -> str:
    """Write a block of 3 × 2 × 2 cells of tetrahedra as VTK and return its path."""
    nx, ny, nz = 3, 2, 2
    points = [(i, j, k) for k in range(nz + 1) for j in range(ny + 1) for i in range(nx + 1)]
    number = {p: n for n, p in enumerate(points)}
    cells = []
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                corner = [number[i + a, j + b, k + c] for c in (0, 1) for b in (0, 1)
                          for a in (0, 1)]
                for a, b in ((1, 3), (3, 2), (2, 6), (6, 4), (4, 5), (5, 1)):    # about 0-7
                    cells.append((corner[0], corner[a], corner[b], corner[7]))
    file = Path(FOLDER.name) / 'body.vtk'
    lines = ['# vtk DataFile Version 2.0', 'body', 'ASCII', 'DATASET UNSTRUCTURED_GRID',
             f'POINTS {len(points)} double',
             *(' '.join(f'{0.05 * c:g}' for c in p) for p in points),
             f'CELLS {len(cells)} {5 * len(cells)}',
             *('4 ' + ' '.join(map(str, c)) for c in cells),
             f'CELL_TYPES {len(cells)}', *['10'] * len(cells), '']
    file.write_text('\n'.join(lines))
    return str(file)


def crushed(shape: str, x):
    """Return a body at rest, inverted, flat, or (nearly) in one point."""
    middle = x.mean(0)
    scale = {'at rest': (1.0, 1.0, 1.0), 'inside out': (1.0, 1.0, -1.0), 'flat': (1.0, 1.0, 0.0),
             'nearly a point': (1e-3, 1e-3, 1e-3), 'a point': (0.0, 0.0, 0.0)}[shape]
    return middle + (x - middle) * scale, np.zeros_like(x)


@hard('H9', 'inverted bodies')
def bodies():
    """Inverted and collapsed bodies recover their volume."""
    def whole(track):
        tetrahedra, rest = track.tetrahedra
        a, b, c, d = (track.x[-1][tetrahedra[:, k]] for k in range(4))
        volume = ((b - a) * np.cross(c - a, d - a)).sum(1) / 6.0
        low = (volume / rest).min()
        return '' if low > 0.5 else f'a tetrahedron has {low:.2g} of its volume'

    scene = alone({'volume': {'young': 2e4, 'poisson': 0.3}}, mesh={'file': body()}, pins={},
                  gravity=0.0, density=200.0, damping=2.0, pose=FLAT)
    for shape in ('at rest', 'inside out', 'flat', 'nearly a point', 'a point'):
        for setting in FEW:
            yield Trial(setting, scene, 3.0, start=partial(crushed, shape), check=whole,
                        recovery_strain=0.05, label=shape)


def flattened(x):
    """Return a sheet compressed to half its length within its plane."""
    found = x.copy()
    top = found[:, 2] > SIZE * (1.0 - 0.5 / N)
    found[~top, 2] = SIZE - 0.5 * (SIZE - found[~top, 2])
    return found, np.zeros_like(x)


def random(x):
    """Return particles at random positions in a box; pinned corners stay."""
    found = np.random.default_rng(7).uniform(0.0, SIZE, x.shape)
    for k in (N * (N - 1), N * N - 1):
        found[k] = x[k]
    return found, np.zeros_like(x)


@hard('H31', 'flattened and random starts')
def starts():
    """The sheet recovers its rest lengths."""
    for setting in USUAL:
        for place in (flattened, random):
            yield Trial(setting, sheet(FIRM), 3.0, start=place, recovery_strain=0.01,
                        label=place.__name__)
