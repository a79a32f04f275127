"""Shear: what a sheared sheet pulls with, and how ``line`` sweeps it."""

import numpy as np
import pytest

from support.scenes import run, simulate
from xpbd_ros.sim.commands import MovePin, Pose
from xpbd_ros.sim.stepping.launches import flattened, launches_of, Shared
from xpbd_ros.sim.stepping.methods import SOFT


def test_a_sheared_sheet_pulls_with_its_modulus():
    """F = G γ w, for a row of oblong cells that two pins hold by their whole length."""
    modulus, angle = 30.0, 1e-4
    simulation = simulate((6, 2), (0.5, 0.2), effects={'shear': {'stiffness': modulus}},
                          gravity=(0, 0, 0), pins={
                              'low': {'cloth': 'c', 'at': 'edge_0x'},
                              'high': {'cloth': 'c', 'at': 'edge_1x'}})
    assert simulation.step().pins['high'].force == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    frame = run(simulation, 5, [MovePin('high', Pose((0.25 + 0.2 * angle, 0.2, 0.0)))])
    force = modulus * angle * 0.5
    assert frame.pins['high'].force[0] == pytest.approx(-force, rel=1e-3)
    assert frame.pins['low'].force[0] == pytest.approx(force, rel=1e-3)


def stiffness(sheet):
    """Return the stiffness of shear at rest [N/m], shape (3 slots, 3 slots)."""
    shear, slots = sheet.effects['shear'].constraints, len(sheet.state.mass)
    found = np.zeros((slots, 3, slots, 3))
    for i, g, alpha in zip(shear.particles, slopes(shear, sheet.state.x), shear.compliance):
        for a, b in np.ndindex(len(i), len(i)):
            found[i[a], :, i[b], :] += np.outer(g[a], g[b]) / alpha
    return found.reshape(3 * slots, 3 * slots)


def slopes(shear, x):
    """Return ∂C/∂x, shape (constraints, particles of each, 3)."""
    if hasattr(shear, 'slopes'):
        return shear.slopes(x)
    d = x[:, shear.particles[:, 0]] - x[:, shear.particles[:, 1]]
    n = (d / np.linalg.norm(d, axis=0)).T
    return np.stack([n, -n], 1)


@pytest.mark.parametrize('size', [(1.0, 1.0), (1.0, 0.7)])
def test_the_rate_is_about_the_highest_frequency_of_shear(size):
    """Squared [1/s²]; that of corners, where one diagonal acts on a quarter of the mass."""
    sheet = simulate((8, 8), size, effects={'shear': {'stiffness': 5.0}})
    mass, rate = np.repeat(sheet.state.mass, 3), sheet.effects['shear'].rate
    there = mass > 0.0
    scale = np.sqrt(np.outer(mass[there], mass[there]))
    highest = np.linalg.eigvalsh(stiffness(sheet)[np.ix_(there, there)] / scale).max()
    assert 0.7 * highest <= rate <= highest


def soft(excess, effects):
    """Return a rumpled sheet without weight; ``excess`` is ρ of its shear over SOFT."""
    unit = simulate((6, 6), effects={'shear': {'stiffness': 1.0}})
    modulus = excess * SOFT / unit.effects['shear'].rate * 120.0**2
    sheet = simulate((6, 6), method='line', gravity=(0, 0, 0), substeps=2,
                     effects={**effects, 'shear': {'stiffness': modulus}})
    sheet.state.x[:] += np.random.default_rng(0).normal(0.0, 0.01, sheet.state.x.shape)
    return sheet


def test_soft_effects_are_swept_forth_and_then_back_in_reverse_order():
    """With half of W: bending, then shear; in the next substep shear, then bending."""
    sheet = soft(0.99, {'bend': {'stiffness': 1e-3}})
    bend, shear = (sheet.effects[name].constraints for name in ('bend', 'shear'))
    m = 120.0**-2 / np.where(sheet.state.mass > 0.0, sheet.state.mass, np.inf)
    x = sheet.state.x.copy()

    def project(these, c):
        i = these.particles[c]
        if these is bend:
            residual, g = x[:, i] @ bend.weight[c], bend.weight[c][:, None]
        else:
            g = slopes(shear, x)[c]
            residual = shear.residual(x)[c]
        df = -residual / (0.5 * (m[i] @ (g**2).sum(1)) + these.compliance[c])
        np.add.at(x.T, i, m[i, None] * g * df)

    order = [(these, c) for these in (bend, shear) for c in range(len(these.particles))]
    v = np.zeros_like(x)
    for sweep in (order, order[::-1]):
        start = x.copy()
        x += v / 120.0
        for these, c in sweep:
            project(these, c)
        v = 120.0 * (x - start)
    np.testing.assert_allclose(run(sheet, 1).x, sheet.natural(x), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize('excess, sweeps', [
    (0.99, ['solve_stretch', 'project_Shear', 'solve_stretch', 'project_Stretch']),
    (1.01, ['project_Shear', 'solve_stretch', 'solve_stretch', 'project_Shear',
            'project_Stretch'])])
def test_soft_shear_is_swept_between_the_two_solves_of_the_lines(excess, sweeps):
    sheet = soft(excess, {'stretch': {'warp': 100.0, 'weft': 100.0}})
    _, *arguments = sheet._arguments()
    launches = launches_of(*arguments, Shared(np.zeros(1, np.int64), np.zeros(2, np.int64)))
    names = [each.name for each in flattened(launches)]
    assert [name for name in names if name in sweeps] == 2 * sweeps
