"""
Rough starts, 720 of them: sweeps (doc/numerics.md 3) from states far from any solution.

Particles with velocities of 3 m/s each, jittered by 5 % of an edge, crumpled to half the size, or
anywhere in a box; a pin that teleports; pins let go. The energy that a run reaches is compared
with plain Gauss-Seidel's at the same number of substeps, as growth

    1 + max (E(t) - E(0) - W) / S

where W is what the teleporting pin puts in and S what there is to spend: kinetic and elastic
energy at the start, W, and the weight falling by 1 m.
"""

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest

from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.sim import measure
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.commands import Release, Reset
from xpbd_ros.sim.constraints.line_solver import solve_warp, solve_weft
from xpbd_ros.sim.particles.integration import begin, restore_buffers, turned, update_velocity
from xpbd_ros.sim.particles.state import forget, Substep
from xpbd_ros.sim.stepping.stages import (
    kernel_of,
    prepare,
    project,
    project_inequalities,
    solve_lines,
    walk,
)

HERE = 1.01
"""how far a method may be above Gauss-Seidel: rounding, and what a mean over a frame hides"""
KINDS = ('velocities', 'jitter', 'crumpled', 'box', 'teleport', 'release')
SUBSTEPS = (1, 2, 4, 8, 16, 32)
G = 9.80665


def swing(method: str, integrator: str | None, substeps: int, n: int, stiffness: float):
    """Return the swing: a sheet of n x n particles, 1 m wide, at rest, held at two corners."""
    keys = {'method': method, 'integrator': integrator, 'substeps': substeps}
    return compile_scene(load_scene('swing', {
        'cloths.sheet.grid.resolution': [n, n],
        'cloths.sheet.effects.stretch': {'warp': stiffness, 'weft': stiffness},
        **{f'solver.{key}': value for key, value in keys.items() if value is not None}}))


def start(sheet, kind: str, random) -> None:
    """Put the particles where no solver left them."""
    x, v = sheet.state.x, sheet.state.v
    free = sheet.slot[sheet.state.inv_mass[sheet.slot] > 0]
    edge, shape = float(sheet.cloths[0].mesh.spacing[0]), (3, len(free))
    middle = x[:, sheet.slot].mean(1, keepdims=True)
    if kind == 'velocities':
        v[:, free] = random.normal(0.0, 3.0, shape)
    elif kind == 'jitter':
        x[:, free] += random.normal(0.0, 0.05 * edge, shape)
    elif kind == 'crumpled':
        squeeze = np.array([[0.5], [0.5], [1.0]])
        x[:, free] = (middle + squeeze * (x[:, free] - middle)
                      + random.normal(0.0, 0.5 * edge, shape))
    elif kind == 'box':
        x[:, free] = middle + random.uniform(-0.5, 0.5, shape)
    else:
        v[:, free] = random.normal(0.0, 0.05, shape)
    forget(sheet.state)


def teleport(sheet, away) -> None:
    """Put a pin elsewhere between two frames, past its speed limit."""
    held = sheet.effects['pin'].held['left']
    sheet.state.x[:, held.particles] += away[:, None]
    pose = held.motion.pose
    held.motion.pose = replace(pose, position=tuple(pose.position + away))
    held.motion.stop()


def energies(sheet) -> tuple[float, float, float]:
    """Return kinetic, elastic and potential energy [J]."""
    return (measure.kinetic_energy(sheet.state), measure.elastic_energy(sheet),
            measure.potential_energy(sheet.state))


def growth(sheet, kind: str, seed: int, *, frames: int = 120, step=None) -> float:
    """Return how far energy grows beyond what was there; inf where it is no number."""
    random = np.random.default_rng(seed)
    start(sheet, kind, random)
    away = random.normal(size=3)
    away *= 0.3 / np.sqrt((away**2).sum())
    first = energies(sheet)
    spend, put, most = first[0] + first[1] + G * sheet.state.mass.sum(), 0.0, 0.0
    for frame in range(frames):
        commands = []
        if kind == 'teleport' and frame == 30:
            before = energies(sheet)[1]
            teleport(sheet, away)
            put = energies(sheet)[1] - before
            spend += max(put, 0.0)
        if kind == 'release' and frame in (30, 60):
            commands = [Release('left' if frame == 30 else 'right')]
        with np.errstate(all='ignore'):
            (step or sheet.step)(commands)
            now = sum(energies(sheet))
        if not np.isfinite(now) or now > 1e30:
            return np.inf
        most = max(most, (now - sum(first) - put) / spend)
    return 1.0 + most


@cache
def worst(method: str, integrator: str | None, substeps: int, n: int, stiffness: float, kinds,
          seeds, **options) -> dict[tuple[str, int], float]:
    """Return the growth of each start."""
    sheet = swing(method, integrator, substeps, n, stiffness)
    found = {}
    for kind, seed in product(kinds, seeds):
        sheet.apply([Reset()])
        found[kind, seed] = growth(sheet, kind, seed, **options)
    return found


@pytest.mark.parametrize('substeps', [1, 4, 16])
def test_lines_are_finite_and_never_wilder_than_gauss_seidel(substeps):
    plain, lines = (worst(*setting, substeps, 21, 5e3, KINDS, range(1), frames=60) for setting in (
        ('gauss_seidel', 'backward_euler'), ('line', 'bdf2')))
    for key, most in lines.items():
        assert most <= HERE * plain[key], key


@pytest.mark.slow
@pytest.mark.parametrize('stiffness', [5e3, 5e4])
@pytest.mark.parametrize('n', [21, 41])
@pytest.mark.parametrize(('method', 'integrator'), [
    ('auto', None), ('line', 'bdf2'), ('line', 'ndf2'), ('explicit', None)])
def test_all_720_are_finite_and_no_wilder_than_gauss_seidel(method, integrator, n, stiffness):
    """4 times 180: 6 kinds, 5 seeds, 6 numbers of substeps."""
    for substeps in SUBSTEPS:
        plain = worst('gauss_seidel', 'backward_euler', substeps, n, stiffness, KINDS, range(5))
        found = worst(method, integrator, substeps, n, stiffness, KINDS, range(5))
        for key, most in found.items():
            assert most <= HERE * plain[key], (substeps, key)


def one_sweep(effects, state, substep):
    """Sweep on, and solve lines once along warp and once along weft."""


@jit
def solve_once(stretch, state, substep):
    """Do half of what the line method does with its lines."""
    solve_warp(stretch.lines, 0, stretch.edges.force, state)
    solve_weft(stretch.lines, 0, stretch.edges.force, state)


walk(one_sweep, lambda effect, state: (
    solve_once if kernel_of(solve_lines, effect) else kernel_of(project, effect)), opens=True)


@jit(cache_name='test')
def advance_one_sweep(effects, state, frame_dt, substeps):
    """Do what the line method does without its second round and its closing pass."""
    h, now = frame_dt / substeps, state
    for k in range(substeps):
        substep = Substep(h, k / substeps, (k + 1) / substeps, 0, None)
        now = turned(now)
        begin(now, substep)
        prepare(effects, now, substep)
        one_sweep(effects, now, substep)
        project_inequalities(effects, now, substep)
        update_velocity(now, substep)
    restore_buffers(state, now)


@pytest.mark.parametrize(('kinds', 'substeps'), [
    (('velocities', 'jitter'), 4), pytest.param(KINDS, 4, marks=pytest.mark.slow),
    pytest.param(KINDS, 16, marks=pytest.mark.slow)])
def test_one_plain_sweep_of_lines_with_bdf2_is_wilder(kinds, substeps):
    """So that the tests above can fail: its two cures, taken away, are missed."""
    wild = 0
    for stiffness in (5e3, 5e4):
        plain = worst('gauss_seidel', 'backward_euler', substeps, 21, stiffness, kinds, range(2))
        sheet = swing('line', 'bdf2', substeps, 21, stiffness)

        def bare(commands, sheet=sheet):
            assert sheet.apply(commands) == []
            advance_one_sweep(sheet._tuple, sheet.state, sheet.frame_dt, substeps)
        for key, most in plain.items():
            sheet.apply([Reset()])
            sheet._hold()
            wild += growth(sheet, *key, step=bare) > HERE * most
    assert wild >= 2
