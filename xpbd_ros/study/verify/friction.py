"""Contact and friction: Coulomb's law on inclines, around a cylinder and between pads."""

import numpy as np

from xpbd_ros.sim.commands import Grasp, MoveCollider, MovePin, Pose
from xpbd_ros.study.verify.build import build, G, place, run
from xpbd_ros.study.verify.case import case, order, value

MU = 0.4
GAP = 0.001
DRAWN, TURNED = 0.3, 0.45
"""μ of a strip that is drawn over a cylinder, and of one over a turning cylinder"""
ALONG_Y = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""quaternion of a cylinder whose axis points along -y"""


def on_plane(degrees: float, *, speed: float = 0.0, **options):
    """Return a particle on an inclined plane; gravity is tilted by the angle, not the plane."""
    a = np.radians(degrees)
    simulation = build((1, 1), gravity=(G * np.sin(a), 0.0, -G * np.cos(a)), friction=MU,
                       pose={'position': [0.0, 0.0, GAP]},
                       colliders={'slope': {'plane': {}, 'friction': MU}},
                       effects_={'contact': {'thickness': GAP}, 'friction': {}}, **options)
    place(simulation, simulation.frame().x, [[speed, 0.0, 0.0]])
    return simulation


@case('V14', 'incline')
def incline():
    """It sticks if tan θ ≤ μ, else its acceleration is g (sin θ - μ cos θ) in each step."""
    for degrees in (10.0, 21.7):
        frame = run(on_plane(degrees, substeps=4), 60)
        yield value(f'distance in 1 s at {degrees:g}°', 0.0, frame.x[0, 0], 'm', 1e-9,
                    absolute=True)
    for degrees in (21.9, 30.0, 60.0):
        a = np.radians(degrees)
        frame = run(on_plane(degrees, substeps=4), 60)
        yield value(f'acceleration at {degrees:g}°', G * (np.sin(a) - MU * np.cos(a)),
                    frame.v[0, 0], 'm/s²', 1e-9)


@case('V15', 'sliding to a stop')
def stop():
    """The distance is v² / (2 μ g), less v h / 2 by the time step."""
    expected = 2.0**2 / (2.0 * MU * G)
    counts = (2, 4, 8, 16)
    got = [run(on_plane(0.0, speed=2.0, substeps=k), 60).x[0, 0] for k in counts]
    h = 1 / 60 / counts[-1]
    yield value('error by the time step', -0.5 * 2.0 * h, got[-1] - expected, 'm', 0.02)
    yield order('distance', expected, [1 / 60 / k for k in counts], got, 'm', 1.0, 5e-3,
                step='substep [s]')


def round_a_drum(n: int, mu: float, radius: float = 0.1):
    """Return a strip over half a cylinder, stretched by 2 % and pinned, and its ends [m]."""
    arc, straight = np.pi * radius, 0.15
    total = arc + 2.0 * straight
    strip = build((n + 1, 1), (total / 1.02, 1.0), {'stretch': {'warp': 200.0, 'weft': 200.0}},
                  density=0.2, gravity=(0, 0, 0), substeps=None, method='auto', integrator=None,
                  friction=mu,
                  colliders={'bar': {'cylinder': {'radius': radius - GAP, 'length': 1.0},
                                     'orientation': list(ALONG_Y), 'friction': mu}},
                  effects_={'contact': {'thickness': GAP}, 'friction': {},
                            'damping': {'rate': 1.0}})
    s = np.linspace(-straight, arc + straight, n + 1)
    angle = np.clip(s / radius, 0.0, np.pi)
    x = np.stack([-radius * np.cos(angle), np.zeros(n + 1), radius * np.sin(angle)], 1)
    x[:, 2] -= np.maximum(-s, 0.0) + np.maximum(s - arc, 0.0)
    place(strip, x)
    ends = {'hold': x[0], 'pull': x[-1]}
    strip.step([Grasp(name, Pose(tuple(end.tolist())), 1e-3) for name, end in ends.items()])
    return strip, ends


def drawn(n: int) -> float:
    """Return the ratio of the mean end forces of a strip that two pins draw over a cylinder."""
    strip, ends = round_a_drum(n, DRAWN)
    pulls, speed = [], 0.05
    for k in range(1, 91):
        way = {'hold': speed * k / 60.0, 'pull': -speed * k / 60.0}
        frame = strip.step([MovePin(name, Pose((end[0], 0.0, end[2] + way[name])))
                            for name, end in ends.items()])
        pulls.append([frame.pins[name].force[2] for name in ('hold', 'pull')])
    return pull_over_hold(pulls[45:])


def turned(n: int) -> float:
    """Return the ratio of the mean end forces of a strip over a turning cylinder."""
    strip, _ = round_a_drum(n, TURNED)
    pulls = []
    for k in range(1, 121):
        c, s = np.cos(k / 120.0), np.sin(k / 120.0)    # half the angle, at 1 rad/s
        about_x, about_w = ALONG_Y[0], ALONG_Y[3]
        frame = strip.step([MoveCollider('bar', Pose((0.0, 0.0, 0.0), (
            c * about_x, s * about_w, -s * about_x, c * about_w)))])
        pulls.append([frame.pins[name].force[2] for name in ('hold', 'pull')])
    ratio = pull_over_hold(pulls[60:])
    return max(ratio, 1.0 / ratio)


def pull_over_hold(pulls) -> float:
    """Return the ratio of the mean forces; the strip rings, so no mean of the frames' ratios."""
    hold, pull = np.mean(pulls, 0)
    return float(pull / hold)


@case('V16', 'capstan')
def capstan():
    """The end forces of a strip that slides over a cylinder have the ratio e^(μ φ)."""
    for n in (20, 100):
        yield value(f'pull over hold, drawn, {n} edges', np.exp(DRAWN * np.pi), drawn(n), '', 0.01)
    for n in (20, 140, 200):
        yield value(f'pull over hold, turned, {n} edges', np.exp(TURNED * np.pi), turned(n), '',
                    0.01)


def between_pads(load: float, density: float, method: str, integrator: str, substeps: int):
    """
    Return a sheet between two pads that press it 1 mm deep, and its weight along x over 2 μ F.

    ``load`` is that weight; F is the foundation modulus times the indentation and the area.
    """
    stiffness, deep, size = 1e5, 1e-3, (0.1, 0.04)
    force = stiffness * deep * size[0] * size[1]
    g = 2.0 * MU * load * force / (density * size[0] * size[1])
    pads = {name: {'box': {'size': [10.0, 2.0, 0.02]}, 'friction': MU,
                   'position': [0.0, 0.0, side * (0.01 + GAP - deep)],
                   'pad': {'stiffness': stiffness}}
            for name, side in (('upper', 1), ('lower', -1))}
    sheet = build((6, 3), size, {'stretch': {'warp': 500.0, 'weft': 500.0}}, density=density,
                  gravity=(g, 0.0, 0.0), friction=MU, method=method, integrator=integrator,
                  substeps=substeps, colliders=pads,
                  effects_={'contact': {'thickness': GAP}, 'friction': {}})
    return sheet, force, g


@case('V31', 'squeeze between pads')
def clamp():
    """The force is stiffness times indentation and area; the sheet slips at 2 μ F."""
    for method, integrator, substeps, density in (
            ('line', 'bdf2', 4, 0.2), ('line', 'ndf2', 32, 0.05),
            ('gauss_seidel', 'backward_euler', 16, 1.0), ('explicit', 'leapfrog', 64, 0.2)):
        name = f'{method}, {substeps} substeps, {density:g} kg/m²'
        sheet, force, _ = between_pads(0.99, density, method, integrator, substeps)
        frame = run(sheet, 60)
        yield value(f'force, {name}', force, sheet.stats()['pad_force_upper_n'], 'N', 1e-9)
        yield value(f'distance in 1 s at 0.99 of 2 μ F, {name}', 0.0, frame.x[0, 0], 'm', 1e-9,
                    absolute=True)
        sheet, _, g = between_pads(1.01, density, method, integrator, substeps)
        before, after = (run(sheet, 15).v[:, 0].mean() for _ in range(2))
        yield value(f'acceleration at 1.01 of 2 μ F, {name}', g * (1.0 - 1.0 / 1.01),
                    float(after - before) / 0.25, 'm/s²', 1e-6)
