"""Short and long substeps, small cloths, long runs, unsafe settings."""

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from xpbd_ros.study.stress.case import hard, Setting
from xpbd_ros.study.stress.refusals import Refusal
from xpbd_ros.study.stress.scenes import alone, FEW, FLAT, LINE, N, sheet, SIZE, USUAL
from xpbd_ros.study.stress.trial import Trial

GENTLE = 0.05


@hard('H19', 'substeps from 1e-5 to 0.1 s')
def steps():
    """
    Long substeps make the cloth softer, never unstable.

    In 10 µs gravity moves a particle by 1e-9 m, and float32 rounds its position by up to 1.5e-8 m,
    so gravity is lost. A note reports that, and the strain stays bounded.
    """
    for setting in USUAL:
        if setting.method == 'explicit' or setting.iterations > 1:
            continue
        for rate, substeps, seconds in ((10.0, 1, 4.0), (60.0, 1, 3.0), (60.0, 100, 1.0),
                                        (1000.0, 100, 0.2)):
            lost = setting.precision == 'float32' and rate > 60.0
            bounds = ({'strain': 0.5, 'reports': ('forces get lost',)} if lost
                      else {'energy': GENTLE})
            yield Trial(replace(setting, substeps=substeps), sheet(pose=FLAT, rate=rate), seconds,
                        label=f'at {rate:g} Hz', **bounds)


@hard('H22', 'the smallest cloths')
def small():
    """Run one particle, one row, no constraints; cloths without particles are refused."""
    for grid in ((1, 1), (2, 1), (1, 2), (N, 1), (1, N), (2, 2)):
        for setting in FEW:
            yield Trial(setting, sheet(grid=grid, pins={'a': [0]}), 1.0, energy=GENTLE,
                        label=f'{grid[0]}x{grid[1]}')
    for setting in FEW:
        yield Trial(setting, {'cloths': {'c': {'grid': {'size': [1.0, 1.0], 'resolution': [3, 3]},
                                               'density': 1.0}}}, 1.0, energy=GENTLE,
                    label='no constraints', textbook=False)
    yield Refusal('no particles', sheet(grid=(0, 5)), ('resolution[0]: must be at least 1',))
    yield Refusal('no cloths', {'cloths': {}}, ('cloths: missing',))


@hard('H25', 'a long run')
def long():
    """In ten minutes nothing drifts at rest, and in two a swing gains no energy."""
    def drift(track):
        way = np.abs(track.x[-1] - track.x[len(track.x) // 2]).max()
        return '' if way <= 1e-9 else f'drifts {way:.1e} m in half of it'

    for setting in FEW:
        yield Trial(setting, sheet(), 600.0, check=drift, energy=1e-9, label='at rest',
                    textbook=False)
        yield Trial(setting, sheet(pose=FLAT, damping=1e-300), 120.0, energy=GENTLE,
                    label='swinging')


def rough(kind: str, seed: int, x):
    """Return a start with random velocities or positions; pinned corners stay."""
    random = np.random.default_rng(seed)
    found, v = x.copy(), np.zeros_like(x)
    inner = np.ones(len(x), bool)
    inner[[N * (N - 1), N * N - 1]] = False
    if kind == 'velocities':
        v[inner] = random.uniform(-3.0, 3.0, (inner.sum(), 3))
    else:
        found[inner] += random.uniform(-1.0, 1.0, (inner.sum(), 3)) * 0.05 * SIZE / (N - 1)
    return found, v


def bare(n: int, **effects) -> dict:
    """Return a level sheet of 1 m, held at two corners, without damping."""
    return alone({'stretch': {'warp': 5e3, 'weft': 5e3}, 'shear': {'stiffness': 5.0}, **effects},
                 grid=(n, n), size=(1.0, 1.0), damping=1e-300, pose=FLAT)


def scattered(x):
    """Return particles at random positions in a box of the sheet's size; pinned corners stay."""
    n = round(len(x)**0.5)
    found = np.random.default_rng(1).uniform(-0.5, 0.5, x.shape) + x.mean(0)
    found[[n * (n - 1), n * n - 1]] = x[[n * (n - 1), n * n - 1]]
    return found, np.zeros_like(x)


def overshoot(simulation) -> None:
    """Set the relaxation of Jacobi to 1, with which it diverges."""
    simulation.state.apart.per_relaxation[:] = 1.0


@hard('H32', 'rough starts, and a relaxation that diverges')
def unsafe():
    """Under-resolved settings stay bounded; diverging ones are rolled back and reported."""
    settings = [replace(LINE, substeps=count) for count in (1, 2, 4)]
    settings += [Setting('gauss_seidel_symmetric', 'bdf2', count) for count in (1, 4)]
    settings += [Setting('explicit', 'leapfrog', 100)]
    for setting, kind in product(settings, ('velocities', 'positions')):
        yield Trial(setting, sheet(), 3.0, start=partial(rough, kind, 1), energy=0.2,
                    label=kind)
    for integrator, substeps in product(('bdf2', 'ndf2'), (2, 4, 8)):
        setting = replace(LINE, integrator=integrator, substeps=substeps)
        for scene, place, label in (
                (bare(21), scattered, 'particles anywhere'),
                (bare(41, shear={'stiffness': 2500.0}), None, 'stiff in shear'),
                (bare(31, bend={'stiffness': 1.0}), None, 'stiff in bending')):
            yield Trial(setting, scene, 2.0, start=place, energy=1e-6, label=label)
    yield Trial(Setting('jacobi', 'backward_euler'), sheet(), 3.0, make_unsafe=overshoot,
                start=partial(rough, 'velocities', 1), reports=('frames_taken_back',),
                textbook=False, label='relaxation too large')
