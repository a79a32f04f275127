"""Waves and vibrations of stretch: a swinging chain, a pulse in a strip, energy."""

import numpy as np
from scipy.special import j0

from xpbd_ros.sim import measure
from xpbd_ros.study.verify.build import (
    BDF2,
    BE,
    build,
    crossing,
    DOWN,
    G,
    hold,
    NDF2,
    place,
    run,
)
from xpbd_ros.study.verify.case import case, order, Row, value

J0_ZERO = 2.404825557695773


@case('V21', 'small swings of a hanging chain')
def chain():
    """The first mode has ω = (j01 / 2) √(g / L) and the shape J0(j01 √(1 - s / L))."""
    def frequency(n):
        rope = build((n + 1, 1), (1.0, 1.0), {'stretch': {'compliance': 0.0}},
                     pose={'orientation': DOWN}, pins=hold(top='corner_00'), rate=120.0,
                     substeps=40, method='line', integrator=BDF2)
        x = rope.frame().x
        place(rope, x + np.outer(j0(J0_ZERO * np.sqrt(1.0 + np.clip(x[:, 2], -1.0, 0.0))),
                                 [1e-4, 0, 0]))
        x0 = 1e-4 * j0(0.0)
        times, tip = [0.0], [x0]
        while tip[-1] > 0.0 or len(tip) < 8:
            tip.append(run(rope, 1).x[-1, 0])
            times.append(rope.index / 120.0)
        for _ in range(3):
            tip.append(run(rope, 1).x[-1, 0])
            times.append(rope.index / 120.0)
        return 0.5 * np.pi / crossing(times, tip)

    sizes = (4, 8, 16)
    yield order('ω', 0.5 * J0_ZERO * np.sqrt(G), [1.0 / n for n in sizes],
                [frequency(n) for n in sizes], 'rad/s', 2.0, 5e-3, step='edge [m]')


@case('V23', 'a stretch wave arrives')
def arrival():
    """If one end of a strip starts to move at a constant speed, the other starts at t = L / c."""
    n, modulus, density, speed = 80, 100.0, 0.25, 0.01
    c = np.sqrt(modulus / density)
    rate = 3000.0    # h < edge / 4 c
    strip = build((n + 1, 1), (1.0, 1.0), {'stretch': {'warp': modulus, 'weft': modulus}},
                  density=density, gravity=(0, 0, 0), rate=rate, method='line', integrator=BDF2,
                  pins=hold(end={'at': 'corner_00', 'target': [-1.0, 0, 0], 'max_speed': speed}))
    times, v = [0.0], [0.0]
    while v[-1] < 1.2 * speed:
        frame = run(strip, 1)
        times.append(strip.index / rate)
        v.append(-frame.v[-1, 0])
    yield value('time at which the far end has half of its speed', 1.0 / c,
                crossing(times, v, speed), 's', 0.02)


def swing(n, method, integrator, substeps, modulus=200.0):
    """Return a level sheet that is held by two corners and falls."""
    return build((n, n), (1.0, 1.0), {'stretch': {'warp': modulus, 'weft': modulus},
                                      'shear': {'stiffness': 5.0}}, density=0.2, method=method,
                 integrator=integrator, substeps=substeps,
                 pins=hold(a='corner_10', b='corner_11'))


def energies(simulation, frames: int) -> tuple[np.ndarray, float]:
    """Return the total energy of each frame, start included, and the largest kinetic one [J]."""
    def total():
        return (measure.kinetic_energy(simulation.state) + measure.elastic_energy(simulation)
                + measure.potential_energy(simulation.state))
    found, kinetic = [total()], 0.0
    for _ in range(frames):
        simulation.step()
        found.append(total())
        kinetic = max(kinetic, measure.kinetic_energy(simulation.state))
    return np.array(found), kinetic


EVERY = [(method, integrator) for method in ('gauss_seidel', 'gauss_seidel_symmetric', 'line')
         for integrator in (BE, BDF2, NDF2)]


def energy_rows(settings, n, substeps, seconds, modulus):
    """Yield a row for the rise of energy in a swing, for each (method, integrator)."""
    for method, integrator in settings:
        count = substeps * (1 if method == 'line' else 4)    # Gauss-Seidel is soft with fewer
        found, kinetic = energies(swing(n, method, integrator, count, modulus),
                                  round(60 * seconds))
        above = max(0.0, float((found - found[0]).max()) / kinetic)
        yield Row(f'{method}, {integrator}, {count} substeps', 0.0, above, '', 1e-3, above,
                  'largest rise over the largest kinetic energy')


@case('V27', 'energy of a swing of 2 s')
def energy():
    """It does not rise above that at the start with settings that resolve the waves."""
    usual = [('gauss_seidel', BE), ('gauss_seidel_symmetric', BDF2), ('line', BDF2),
             ('line', NDF2)]
    yield from energy_rows(usual, 9, 12, 2.0, 200.0)


@case('V27', 'energy of a swing of 10 s, 21 x 21', slow=True)
def energy_for_long():
    """It does not rise in 10 s either, at 5 kN/m, with every method and integrator."""
    yield from energy_rows(EVERY, 21, 64, 10.0, 5000.0)
