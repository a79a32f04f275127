"""Air and bodies: a sheet that falls in air, a balloon, a ball filled with water."""

from functools import cache
from pathlib import Path
import tempfile

import numpy as np
from scipy.optimize import brentq

from xpbd_ros.study.verify.build import BDF2, BE, build, G, hold, NDF2, run
from xpbd_ros.study.verify.case import case, order, value

_FOLDER = tempfile.TemporaryDirectory(prefix='xpbd_ros_')
RADIUS, YOUNG, POISSON = 0.1, 200.0, 0.3


@case('V17', 'terminal speed in air')
def falling():
    """A level sheet falls at v = v_t tanh(g t / v_t), with v_t = sqrt(2 ρ g / (ρ_air C))."""
    density, air, grip = 0.1, 1.2, 1.2
    terminal = np.sqrt(2.0 * density * G / (air * grip))

    def speed(frames, substeps, method='gauss_seidel', integrator=BE):
        sheet = build((4, 4), (0.3, 0.3), density=density, substeps=substeps, method=method,
                      integrator=integrator, effects_={'drag': {'density': air, 'normal': grip}})
        return -run(sheet, frames).v[:, 2].mean()

    t, counts = 6 / 60, (2, 4, 8, 16)
    yield value('terminal speed, 2 substeps', terminal, speed(120, 2), 'm/s', 1e-9)
    for method, integrator, order_expected, tolerance in (
            ('gauss_seidel', BE, 1.0, 5e-3), ('line', BDF2, 2.0, 1e-4), ('line', NDF2, 2.0, 1e-4),
            ('explicit', 'leapfrog', 2.0, 1e-4)):
        yield order(f'speed after 0.1 s, {integrator}', terminal * np.tanh(G * t / terminal),
                    [1 / 60 / k for k in counts],
                    [speed(6, k, method, integrator) for k in counts], 'm/s', order_expected,
                    tolerance, step='substep [s]')


@cache
def sphere(splits: int) -> tuple[Path, np.ndarray]:
    """Return OBJ file and triangles of a sphere, an icosahedron refined ``splits`` times."""
    golden = 0.5 * (1.0 + 5.0**0.5)
    x = np.array([np.roll([0.0, a, b * golden], k) for k in range(3) for a in (-1, 1)
                  for b in (-1, 1)]) / np.hypot(1.0, golden)
    near = np.linalg.norm(x[:, None] - x, axis=2) < 1.2
    corners = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)
               if near[i, j] and near[j, k] and near[k, i]]
    for _ in range(splits):
        points, finer = {tuple(p): n for n, p in enumerate(x.tolist())}, []
        for i, j, k in corners:
            a, b, c = (points.setdefault(tuple((p / np.linalg.norm(p)).tolist()), len(points))
                       for p in (x[i] + x[j], x[j] + x[k], x[k] + x[i]))
            finer += [(i, a, c), (j, b, a), (k, c, b), (a, b, c)]
        corners, x = finer, np.array(list(points))
    triangles = np.array(corners)
    a, b, c = (x[triangles[:, k]] for k in range(3))
    inward = (np.cross(b, c) * a).sum(1) < 0.0
    triangles[inward] = triangles[inward][:, ::-1]
    file = Path(_FOLDER.name) / f'sphere_{splits}.obj'
    file.write_text(''.join([*('v {!r} {!r} {!r}\n'.format(*p) for p in (RADIUS * x).tolist()),
                             *('f {} {} {}\n'.format(*t) for t in (triangles + 1).tolist())]))
    return file, triangles


def volume_of(x: np.ndarray, triangles: np.ndarray) -> float:
    """Return the volume inside a closed surface [m³]."""
    a, b, c = (x[triangles[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


def ball(splits, skin, **options):
    """Return a ball with the effects ``skin`` and no gravity, its triangles, its volume [m³]."""
    file, triangles = sphere(splits)
    simulation = build(mesh=file, effects=skin, density=0.2, gravity=(0, 0, 0),
                       effects_={'damping': {'rate': 20.0}}, **options)
    return simulation, triangles, volume_of(simulation.frame().x, triangles)


@case('V18', 'balloon', slow=True)
def balloon():
    """
    The overpressure of a membrane of tension T is 2 T / R, with T = Y / (1 - ν) (R / R0 - 1).

    The radius R, and with it the pressure, follows from the amount of gas.
    """
    outside, amount, splits = 1e4, 1.002, (1, 2, 3)

    def beyond(stretch):
        inner = outside * (1.0 - (1.0 + stretch)**3 / amount)
        return inner - 2.0 * YOUNG / (1.0 - POISSON) * stretch / (RADIUS * (1.0 + stretch))

    stretch = brentq(beyond, 0.0, 0.1)
    expected = 2.0 * YOUNG / (1.0 - POISSON) * stretch / (RADIUS * (1.0 + stretch))
    got = []
    for k in splits:
        simulation, _, _ = ball(k, {'membrane': {'young': YOUNG, 'poisson': POISSON},
                                    'pressure': {'amount': amount, 'outside': outside,
                                                 'kappa': 1.0}}, substeps=50, iterations=40)
        run(simulation, 20)
        got.append(simulation.stats()['overpressure_c_pa'])
    yield order('overpressure', expected, [0.5**k for k in splits], got, 'Pa', 2.0, 1e-2,
                step='edge, relative')


@case('V19', 'closed volume under a squash')
def squash():
    """A ball of water that two pins compress keeps its volume."""
    height = np.loadtxt(sphere(2)[0], usecols=3, max_rows=162)
    tip, foot = int(np.argmax(height)), int(np.argmin(height))
    for part in (0.1, 0.3):
        simulation, triangles, before = ball(
            2, {'stretch': {'warp': YOUNG, 'weft': YOUNG},
                'pressure': {'outside': 1e9, 'kappa': 1.0}}, substeps=20, iterations=30,
            pins=hold(foot=[foot], tip={'at': [tip], 'motion': [
                [0.0, 0.0, 0.0, RADIUS], [0.5, 0.0, 0.0, RADIUS * (1.0 - 2.0 * part)]]}))
        frame = run(simulation, 90)
        yield value(f'volume, {part:.0%} flatter, over that before', 1.0,
                    volume_of(frame.x, triangles) / before, '', 1e-6)
