"""Motion of particles: the integrators against closed forms."""

import numpy as np
from scipy.special import ellipk

from xpbd_ros.study.verify.build import (
    BDF2,
    BE,
    build,
    crossing,
    G,
    hold,
    NDF2,
    place,
    run,
)
from xpbd_ros.study.verify.case import case, order, value

ORDERS = ((BE, 1.0), (BDF2, 2.0), (NDF2, 2.0))


@case('V1', 'free fall')
def free_fall():
    """Backward Euler falls by g h² n (n + 1) / 2 in n steps, exactly."""
    def fallen(substeps, integrator, frames):
        pair = build((2, 1), (1.0, 1.0), {'stretch': {'compliance': 0.0}}, substeps=substeps,
                     integrator=integrator)
        return -run(pair, frames).x[0, 2]

    n, h = 60, 1.0 / 240.0
    yield value('fall in 60 steps, backward Euler', 0.5 * G * h * h * n * (n + 1),
                fallen(4, BE, n // 4), 'm', 1e-12)
    for name, slope in ORDERS:
        counts = (4, 8, 16, 32)
        got = [fallen(k, name, 60) for k in counts]
        yield order(f'fall in 1 s, {name}', 0.5 * G, [1 / 60 / k for k in counts], got, 'm',
                    slope, 1e-3, step='substep [s]')


def oscillator(**options):
    """Return 1 kg on an edge of 1e-3 m/N, stretched by 0.5 m (Macklin et al. 2016, 6.1)."""
    simulation = build((2, 1), (1.0, 1.0), {'stretch': {'compliance': 1e-3}}, density=2.0,
                       gravity=(0, 0, 0), pins=hold(a='corner_00'), **options)
    place(simulation, [[0, 0, 0], [1.5, 0, 0]])
    return simulation


@case('V2', 'oscillator of Macklin et al. 2016')
def one_oscillator():
    """A step scales the amplitude by 1 / √(1 + s²) and adds atan s to the phase, s = ω h."""
    for rate in (60, 240):
        simulation = oscillator(rate=rate)
        u = [0.5] + [run(simulation, 1).x[1, 0] - 1.0 for _ in range(6)]
        twice, square = np.linalg.solve([[u[2], -u[1]], [u[3], -u[2]]], [u[3], u[4]])
        s = np.sqrt(1000.0) / rate
        yield value(f'amplitude per step, h = 1/{rate} s', 1.0 / np.sqrt(1.0 + s * s),
                    np.sqrt(square), '', 1e-8)
        yield value(f'frequency over ω, h = 1/{rate} s', np.arctan(s) / s,
                    np.arccos(0.5 * twice / np.sqrt(square)) / s, '', 1e-8)
    for name, slope in ORDERS:
        counts = (32, 64, 128, 256)
        got = [run(oscillator(substeps=k, integrator=name), 6).x[1, 0] - 1.0 for k in counts]
        yield order(f'displacement at 0.1 s, {name}', 0.5 * np.cos(np.sqrt(1000.0) * 0.1),
                    [1 / 60 / k for k in counts], got, 'm', slope, 0.05, step='substep [s]')


@case('V3', 'Kelvin-Voigt oscillator')
def damped_oscillator():
    """A step scales ‖z‖² by 1 / (1 + c h / m + ω² h²); the decay is exact for h → 0."""
    k, time = 30.0, 0.02

    def pair(**options):
        """Return two free particles of 0.5 kg, stretched by 0.2 m, and their reduced mass."""
        simulation = build((2, 1), (1.0, 1.0), {'stretch': {'compliance': 1.0 / k},
                                                'rayleigh': {'time': time}}, density=1.0,
                           gravity=(0, 0, 0), **options)
        place(simulation, [[-0.1, 0, 0], [1.1, 0, 0]])
        return simulation, 0.5 * simulation.state.mass[simulation.slot[0]]

    simulation, mass = pair()
    frames = [run(simulation, 1) for _ in range(3)]
    z = np.array([[f.x[1, 0] - f.x[0, 0] - 1.0, f.v[1, 0] - f.v[0, 0]] for f in frames])
    h, c = 1 / 60, k * time
    yield value('‖z‖² kept in a step', 1.0 / (1.0 + c * h / mass + k / mass * h * h),
                np.linalg.det(z[1:].T @ np.linalg.inv(z[:2].T)), '', 1e-10)
    a, t = 0.5 * c / mass, 0.2
    w = np.sqrt(k / mass - a * a)
    exact = 0.2 * np.exp(-a * t) * (np.cos(w * t) + a / w * np.sin(w * t))
    for name, slope in ORDERS:
        counts, got = (32, 64, 128, 256), []
        for n in counts:
            x = run(pair(substeps=n, integrator=name)[0], 12).x
            got.append(x[1, 0] - x[0, 0] - 1.0)
        yield order(f'stretch at 0.2 s, {name}', exact, [1 / 60 / n for n in counts], got, 'm',
                    slope, 0.02, step='substep [s]')


@case('V4', 'spinning pair')
def spinning_pair():
    """The loss of angular momentum after one turn falls with the order of the integrator."""
    def momentum(substeps, integrator):
        pair = build((2, 1), (1.0, 1.0), {'stretch': {'compliance': 0.0}}, gravity=(0, 0, 0),
                     substeps=substeps, integrator=integrator)
        w = 2.0 * np.pi
        place(pair, [[-0.5, 0, 0], [0.5, 0, 0]], [[0, -0.5 * w, 0], [0, 0.5 * w, 0]])
        frame = run(pair, 60)
        return np.cross(frame.x, frame.v)[:, 2].sum() / (0.5 * w)

    w2 = (2.0 * np.pi)**2
    for substeps in (1, 4, 16):
        yield value(f'L / L0, backward Euler, h = 1/{60 * substeps} s',
                    1.0 / np.sqrt(1.0 + 2.0 * w2 / (60 * substeps)), momentum(substeps, BE), '',
                    0.005 / substeps)
    for name, slope in ORDERS:
        counts = (16, 32, 64, 128)
        yield order(f'L / L0, {name}', 1.0, [1 / 60 / k for k in counts],
                    [momentum(k, name) for k in counts], '', slope, 0.01, step='substep [s]')


def quarter_period(angle: float, rate: float, integrator: str) -> float:
    """Return a quarter of the period of a rigid pendulum of 1 m [s]."""
    swing = build((2, 1), (1.0, 1.0), {'stretch': {'compliance': 0.0}}, rate=rate,
                  integrator=integrator, pins=hold(a='corner_00'))
    place(swing, [[0, 0, 0], [np.sin(angle), 0, -np.cos(angle)]])
    times, x = [0.0], [np.sin(angle)]
    while x[-1] > 0.0 or len(x) < 8:
        x.append(run(swing, 1).x[1, 0])
        times.append(swing.index / rate)
    x.append(run(swing, 1).x[1, 0])
    return crossing([*times, swing.index / rate], x)


@case('V5', 'pendulum with a rigid link')
def pendulum():
    """The period at amplitude θ0 is T / T0 = (2 / π) K(sin² θ0 / 2)."""
    quarter = 0.5 * np.pi / np.sqrt(G)
    for degrees in (10, 45, 90, 120):
        k = np.sin(np.radians(degrees) / 2)**2
        yield value(f'T / T0 at {degrees}°', 2.0 / np.pi * ellipk(k),
                    quarter_period(np.radians(degrees), 2000.0, BDF2) / quarter, '', 1e-5)
    for name, slope in ORDERS:
        rates = (250.0, 500.0, 1000.0, 2000.0)
        got = [quarter_period(np.pi / 2, rate, name) / quarter for rate in rates]
        yield order(f'T / T0 at 90°, {name}', 2.0 / np.pi * ellipk(0.5), [1 / r for r in rates],
                    got, '', slope, 1e-3, step='substep [s]')
