"""Stretch and shear at rest: hanging strips, chains, patches."""

from functools import cache

import numpy as np
from scipy.optimize import brentq

from xpbd_ros.study.numbering import natural_indices
from xpbd_ros.study.verify.build import build, DOWN, G, hold, place, run
from xpbd_ros.study.verify.case import case, order, value


def hanging(n, modulus, **options):
    """Return a damped strip of n edges, 1 m long and wide, that hangs from its first particle."""
    return build((n + 1, 1), (1.0, 1.0), {'stretch': {'warp': modulus, 'weft': modulus}},
                 density=0.2, pose={'orientation': DOWN}, pins=hold(top='corner_00'),
                 effects_={'damping': {'rate': 10.0}}, **options)


def run_to_rest(simulation, speed=1e-13, frames=4000):
    """Advance until no particle is faster than ``speed`` [m/s]; return the last frame."""
    for _ in range(frames):
        frame = simulation.step()
        if np.abs(frame.v).max() < speed:
            break
    return frame


@case('V6', 'strip that hangs by its own weight')
def strip():
    """The elongation is ρ g L² / 2 E with any number of edges, as the last mass is half."""
    for n in (5, 40):
        modulus = 100.0
        simulation = hanging(n, modulus, method='line', integrator='bdf2', substeps=32)
        frame = run_to_rest(simulation)
        yield value(f'elongation, {n} edges', 0.2 * G / (2.0 * modulus), -frame.x[-1, 2] - 1.0,
                    'm', 1e-9)
        yield value(f'force on the pin, {n} edges', -0.2 * G, frame.pins['top'].force[2], 'N',
                    1e-9)


@case('V7', 'artificial compliance of unconverged Gauss-Seidel')
def artificial_compliance():
    """The residual of edge j is C_j = α_j T_j - h² Σ A_jk T_k, over edges k swept after j."""
    n, modulus = 16, 1000.0

    def gives(substeps, iterations=1):
        simulation = hanging(n, modulus, substeps=substeps, iterations=iterations)
        run_to_rest(simulation, 1e-12)
        edges = simulation.effects['stretch'].constraints
        return (edges.residual(simulation.state.x),
                natural_indices(simulation)[edges.particles])

    mass = 0.2 / n * np.array([1.0] * n + [0.5])
    h2 = {k: (1 / 60 / k)**2 / (1.0 + 10.0 / 60 / k) for k in (4, 8, 16, 32)}
    artefact = []
    for substeps, square in h2.items():
        got, ends = gives(substeps)
        tension = G * np.array([mass[max(pair):].sum() for pair in ends])
        law = tension / (modulus * n)
        for j, pair in enumerate(ends):
            for k in range(j + 1, len(ends)):
                for shared in set(pair) & set(ends[k]):
                    if shared:    # particle 0 is pinned
                        law[j] += square / mass[shared] * tension[k]
        artefact.append((got - tension / (modulus * n)).sum() / square * h2[4])
        if substeps in (4, 32):
            worst = np.argmax(np.abs(got / law - 1.0))
            yield value(f'worst edge of {n}, {substeps} substeps', law[worst], got[worst], 'm',
                        1e-9)
    steps = [1 / 60 / k for k in h2]
    yield order('elongation beyond the exact one', 0.0, steps,
                [a * h2[k] / h2[4] for a, k in zip(artefact, h2)], 'm', 2.0, 1e-3,
                step='substep [s]')
    for iterations in (4, 8):
        got, ends = gives(1, iterations)
        tension = G * np.array([mass[max(pair):].sum() for pair in ends])
        w = 1.0 / mass
        w[0] = 0.0
        square = (1 / 60)**2 / (1.0 + 10.0 / 60)
        law = tension * (1.0 / (modulus * n) + square * w[ends].sum(1) / (2.0 * iterations))
        yield value(f'mean law, {iterations} iterations', law.sum(), got.sum(), 'm', 0.1)


@cache
def catenary(ratio: float) -> tuple[float, float, float]:
    """Return sag / D, H / (q D) and end tension / (q S) of an inextensible rope, S = ratio D."""
    u = brentq(lambda u: np.sinh(u) / u - ratio, 1e-6, 20.0)    # u = D / 2 a
    return (np.cosh(u) - 1.0) / (2.0 * u), 1.0 / (2.0 * u), np.cosh(u) / (2.0 * u * ratio)


@case('V8', 'catenary')
def rope():
    """A rigid chain of 1.5 times its span takes the shape and the forces of a catenary."""
    def hung(n):
        simulation = build((n + 1, 1), (1.5, 1.0), {'stretch': {'compliance': 0.0}},
                           substeps=32, method='line', integrator='bdf2',
                           effects_={'damping': {'rate': 10.0}}, pins=hold(
                               a='corner_00', b={'at': 'corner_01', 'target': [1.0, 0, 0]}))
        frame = run(simulation, 420)
        force = frame.pins['b'].force
        # the weight of the pinned particle, half an edge, acts on the pin and not on the rope
        return -frame.x[n // 2, 2], -force[0] / G, np.hypot(force[0], force[2]) / (1.5 * G)

    sizes = (8, 16, 32)
    got = np.array([hung(n) for n in sizes])
    for k, (name, expected) in enumerate(zip(('sag / D', 'H / q D', 'end tension / q S'),
                                             catenary(1.5))):
        yield order(name, expected, [1.5 / n for n in sizes], got[:, k], '', 2.0, 2e-3,
                    step='edge [m]')


@case('V13', 'moduli of lattice and membrane')
def patch():
    """
    With square cells C11 = warp + shear, C22 = weft + shear and C12 = C66 = shear.

    With oblong cells C11 = warp, C22 = weft, C12 = 0 and C66 = shear. A membrane has the energy
    density Eᵀ S E / 2 under any affine deformation, with S of plane stress (Jones 1975).
    """
    warp, weft, shear, e = 70.0, 40.0, 15.0, 1e-5
    for cells, size, added in (('1:1', (0.5, 0.4), shear), ('3:1', (1.5, 0.4), 0.0),
                               ('1:3', (0.5, 1.2), 0.0), ('1.01:1', (0.505, 0.4), 0.0)):
        area = size[0] * size[1]
        simulation = build((6, 5), size, {'stretch': {'warp': warp, 'weft': weft},
                                          'shear': {'stiffness': shear}})
        x = simulation.frame().x

        def energy(xx, yy, xy, simulation=simulation, x=x, area=area):
            total = 0.0
            for sign in (e, -e):
                bent = x + sign * x @ np.array([[xx, 0.5 * xy, 0], [0.5 * xy, yy, 0], [0, 0, 0]])
                place(simulation, bent)
                total += sum(simulation.effects[name].constraints.energy(simulation.state.x)
                             for name in ('stretch', 'shear'))
            return total / (e * e * area)

        c11, c22 = energy(1, 0, 0), energy(0, 1, 0)
        for name, expected, got in (('C11', warp + added, c11), ('C22', weft + added, c22),
                                    ('C12', added, 0.5 * (energy(1, 1, 0) - c11 - c22)),
                                    ('C66', shear, energy(0, 0, 1))):
            yield value(f'{name}, cells {cells}', expected, got, 'N/m', 1e-5, scale=shear)
        poisson, other = 0.35, 0.35 * weft / warp
        simulation = build((6, 5), size, {'membrane': {
            'warp': warp, 'weft': weft, 'shear': shear, 'poisson': poisson}})
        f = np.array([[1.1, 0.3, 0.0], [-0.2, 0.9, 0.0], [0.4, -0.1, 1.0]])
        place(simulation, x @ f.T)
        green = 0.5 * (f.T @ f - np.eye(3))
        e11, e22, g12 = green[0, 0], green[1, 1], 2.0 * green[0, 1]
        yield value(f'membrane, cells {cells}', 0.5 * area * (
            (warp * e11**2 + 2.0 * other * warp * e11 * e22 + weft * e22**2)
            / (1.0 - poisson * other) + shear * g12**2),
            simulation.effects['membrane'].constraints.energy(simulation.state.x), 'J', 1e-12)
