"""Laws for any parameters: momentum, invariance, symmetry, stiffness, repeatability."""

import numpy as np

from xpbd_ros.study.verify.build import build, G, hold, place, run
from xpbd_ros.study.verify.case import case, order, value


@case('V20', 'momentum of a free body')
def momentum():
    """
    Projections conserve Σ m v up to rounding.

    Σ m x × v is conserved in the limit of short steps, with the order of the integrator.
    """
    for method in ('gauss_seidel', 'line'):
        simulation = build((9, 8), (0.8, 0.7), {
            'stretch': {'warp': 500.0, 'weft': 300.0}, 'shear': {'stiffness': 20.0},
            'bend': {'stiffness': 1e-3}}, gravity=(0, 0, 0), substeps=4, density=0.2,
            method=method, integrator='bdf2' if method == 'line' else 'backward_euler')
        rng = np.random.default_rng(1)
        x = simulation.frame().x
        v = rng.normal(0.0, 1.0, x.shape)
        place(simulation, x + rng.normal(0.0, 0.01, x.shape), v)
        mass = simulation.state.mass[simulation.slot]
        before, size = mass @ v, (mass * np.linalg.norm(v, axis=1)).sum()
        after = mass @ run(simulation, 60).v
        yield value(f'change in 240 substeps, {method}', 0.0,
                    np.abs(after - before).max() / size, '', 240e-12, absolute=True)
    for solver in (*METHODS, {'method': 'line', 'integrator': 'ndf2'}):
        ladder = [16, 32, 64]
        yield order(f'angular momentum after 0.5 s, {solver["method"]} '
                    f'{solver.get("integrator", "backward_euler")}', 1.0,
                    [1.0 / n for n in ladder], [spun(n, **solver) for n in ladder], '',
                    2.0 if 'integrator' in solver else 1.0, 2e-3, step='frame')


def spun(substeps: int, **solver) -> float:
    """Return the angular momentum of a free spinning sheet after 0.5 s, over that at the start."""
    simulation = build((9, 8), (0.8, 0.7), {
        'stretch': {'warp': 50.0, 'weft': 30.0}, 'shear': {'stiffness': 5.0},
        'bend': {'stiffness': 1e-3}}, gravity=(0, 0, 0), substeps=substeps, density=0.2, **solver)
    x, mass = simulation.frame().x, simulation.state.mass[simulation.slot, None]
    v = np.cross([1.0, 2.0, 3.0], x - (mass * x).sum(0) / mass.sum())
    place(simulation, x, v)
    before = (mass * np.cross(x, v)).sum(0)
    frame = run(simulation, 30)
    after = (mass * np.cross(frame.x, frame.v)).sum(0)
    return float(1.0 - np.linalg.norm(after - before) / np.linalg.norm(before))


def sheet(*, turn=0.0, shift=(0.0, 0.0, 0.0), units=(1.0, 1.0), frames=30, **solver):
    """
    Return the positions of a pinned sheet that swings, with all elastic effects of a grid.

    Parameters
    ----------
    turn : rotation of the scene about the z axis [rad]
    shift : displacement of the scene [m]
    units : numbers that stand for one metre and one kilogram
    frames : number of frames
    solver : keys of the solver

    """
    metre, kilogram = units
    q = [0.0, 0.0, np.sin(0.5 * turn), np.cos(0.5 * turn)]
    simulation = build((7, 6), (0.6 * metre, 0.5 * metre), {
        'stretch': {'warp': 200.0 * kilogram, 'weft': 150.0 * kilogram},
        'shear': {'stiffness': 10.0 * kilogram},
        'bend': {'stiffness': 1e-3 * kilogram * metre**2}},
        density=0.2 * kilogram / metre**2, gravity=(0.0, 0.0, -G * metre),
        pose={'orientation': q, 'position': [metre * s for s in shift]},
        pins=hold(a='corner_00', b='corner_10'), **{'substeps': 8, **solver})
    return run(simulation, frames).x


METHODS = ({'method': 'gauss_seidel'}, {'method': 'line', 'integrator': 'bdf2'})


@case('V24', 'invariance')
def invariance():
    """Rotated, displaced and in other units the result is the same up to rounding."""
    for solver in METHODS:
        method, x = solver['method'], sheet(**solver)
        a = 0.7
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        for name, got in (('turned by 0.7 rad', sheet(turn=a, **solver) @ turn),
                          ('moved by 3 m', sheet(shift=(1.0, -2.0, 2.0), **solver) - [1, -2, 2]),
                          ('in mm and g', sheet(units=(1e3, 1e3), **solver) * 1e-3)):
            yield value(f'{name}, {method}', 0.0, np.abs(got - x).max(), 'm', 1e-9, absolute=True)


@case('V25', 'symmetry')
def symmetry():
    """
    A symmetric scene stays symmetric in the limit of short steps, with any order of sweeps.

    The asymmetry falls with the square of the substep, also for integrators of first order, and
    with its fourth power where substeps sweep forward and backward in turn.
    """
    for power, tolerance, solver in ((2.0, 2e-5, METHODS[0]), (4.0, 2e-10, METHODS[1]),
                                     (4.0, 2e-10, {'method': 'line', 'integrator': 'ndf2'})):
        ladder, found = [16, 32, 64], []
        for substeps in ladder:
            grid = run(build((9, 9), (1.0, 1.0), {
                'stretch': {'warp': 100.0, 'weft': 100.0}, 'shear': {'stiffness': 20.0}},
                density=0.2, pins=hold(a='corner_10', b='corner_11'), substeps=substeps,
                **solver), 24).x.reshape(9, 9, 3)
            mirrored = grid[:, ::-1] * [-1, 1, 1] + [1.0, 0, 0]
            found.append(np.sqrt(((grid - mirrored)**2).sum(-1).mean()))
        yield order(f'asymmetry, {solver["method"]} '
                    f'{solver.get("integrator", "backward_euler")}', 0.0,
                    [1.0 / n for n in ladder], found, 'm', power, tolerance, step='frame')


def sag(n: int, iterations: int, frames: int) -> float:
    """Return the depth of the lowest particle of a cloth that hangs by an edge [m]."""
    simulation = build((n, n), (1.0, 1.0), {'stretch': {'warp': 5.0, 'weft': 5.0},
                                            'shear': {'stiffness': 1.0}}, density=0.1,
                       iterations=iterations, pose={'orientation': [0, 0.5**0.5, 0, 0.5**0.5]},
                       effects_={'damping': {'rate': 6.0}}, pins=hold(top='edge_x0'))
    return -run(simulation, frames).x[:, 2].min()


@case('V26', 'stiffness does not depend on iterations')
def iterations():
    """The sag does not depend on the number of iterations (Macklin et al. 2016, figure 6)."""
    found = {k: sag(12, k, 180) for k in (20, 40, 80, 160)}
    for k in (20, 40, 80):
        yield value(f'sag, {k} iterations against 160', found[160], found[k], 'm', 0.01)


@case('V28', 'repeatability')
def repeatable():
    """A second run is bit-identical."""
    for solver in METHODS:
        name = solver['method']
        runs = []
        for _ in range(2):
            simulation = build((7, 6), (0.6, 0.5), {
                'stretch': {'warp': 200.0, 'weft': 150.0}, 'shear': {'stiffness': 10.0},
                'bend': {'stiffness': 1e-3}}, substeps=8, density=0.2,
                pins=hold(a='corner_00', b='corner_10'), **solver)
            run(simulation, 20)
            runs.append(simulation)
        differ = runs[0].hash() != runs[1].hash()
        yield value(f'runs that differ, {name}', 0.0, float(differ), '', 0.0, absolute=True)
