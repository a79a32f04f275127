"""Contact and friction: Coulomb's law on inclines and around a cylinder."""

import numpy as np

from xpbd_ros.study.cases.build import build, G, place, run
from xpbd_ros.study.cases.case import case, order, value

MU = 0.4
GAP = 0.001


def on_plane(degrees: float, *, speed: float = 0.0, **options):
    """Return a particle on a plane that falls towards +x at some angle; gravity is what turns."""
    a = np.radians(degrees)
    simulation = build((1, 1), gravity=(G * np.sin(a), 0.0, -G * np.cos(a)), friction=MU,
                       pose={'position': [0.0, 0.0, GAP]},
                       colliders={'slope': {'plane': {}, 'friction': MU}},
                       effects_={'contact': {'thickness': GAP}, 'friction': {}}, **options)
    place(simulation, simulation.frame().x, [[speed, 0.0, 0.0]])
    return simulation


@case('V14', 'incline')
def incline():
    """It sticks where tan θ ≤ μ, else slides with a = g (sin θ - μ cos θ), exactly per step."""
    for degrees in (10.0, 21.7):
        frame = run(on_plane(degrees, substeps=4), 60)
        yield value(f'way in 1 s at {degrees:g}°', 0.0, frame.x[0, 0], 'm', 1e-9, absolute=True)
    for degrees in (21.9, 30.0, 60.0):
        a = np.radians(degrees)
        frame = run(on_plane(degrees, substeps=4), 60)
        yield value(f'acceleration at {degrees:g}°', G * (np.sin(a) - MU * np.cos(a)),
                    frame.v[0, 0], 'm/s²', 1e-9)


@case('V15', 'sliding to a stop')
def stop():
    """The way v² / (2 μ g), less v h / 2."""
    expected = 2.0**2 / (2.0 * MU * G)
    counts = (2, 4, 8, 16)
    got = [run(on_plane(0.0, speed=2.0, substeps=k), 60).x[0, 0] for k in counts]
    h = 1 / 60 / counts[-1]
    yield value('what the step takes of it', -0.5 * 2.0 * h, got[-1] - expected, 'm', 0.02)
    yield order('way', expected, [1 / 60 / k for k in counts], got, 'm', 1.0, 5e-3,
                step='substep [s]')
