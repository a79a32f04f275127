"""The methods and integrators: orders, symmetry of bits, and what they do when it gets rough."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from support.scenes import GRAVITY, run, simulate
from support.tiers import quick_only, slow
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.sim import measure
from xpbd_ros.sim.backend.simd import width_of

METHODS = ('gauss_seidel', 'gauss_seidel_symmetric', 'line')


def simulation(method: str, integrator: str, substeps: int, **keys):
    """Return the swing, 17 × 17 particles, 5 kN/m."""
    return compile_scene(load_scene('swing', {
        'cloths.sheet.grid.resolution': [17, 17], 'solver.method': method,
        'solver.integrator': integrator, 'solver.substeps': substeps, **keys}))


def pair(method: str, integrator: str, substeps: int):
    """Return two particles on one soft edge, 0.1 m apart, without gravity; 10 Hz about."""
    return compile_scene(scene_from_mapping({
        'gravity': [0, 0, 0],
        'solver': {'method': method, 'integrator': integrator, 'substeps': substeps},
        'cloths': {'rope': {'grid': {'size': [0.1, 0.1], 'resolution': [2, 1]}, 'density': 1.0,
                            'effects': {'stretch': {'compliance': 0.1}}}},
    }, where='test', name='pair'))


def slope(errors: list[float]) -> float:
    """Return the order at which errors fall when the steps are halved each time."""
    return float(np.polyfit(np.arange(len(errors)), -np.log2(errors), 1)[0])


ORDERS = {'backward_euler': 1, 'bdf2': 2, 'ndf2': 2}
QUICK = ('gauss_seidel', 'backward_euler'), ('line', 'backward_euler'), ('line', 'bdf2')


@pytest.mark.parametrize(('method', 'integrator'), [
    pytest.param(method, integrator, marks=[pytest.mark.slow] * (
        (method, integrator) not in QUICK))
    for method in METHODS for integrator in ORDERS])
def test_oscillation_converges_at_the_order_of_the_integrator(method, integrator):
    errors = []
    for substeps in (16, 32, 64, 128):
        two = pair(method, integrator, substeps)
        slots = two.slot
        two.state.x[0, slots[1]] = 0.12
        for _ in range(11):
            frame = two.step()
        mass = two.state.mass[slots]
        omega = np.sqrt((1 / mass).sum() / 0.1)
        exact = 0.1 + 0.02 * np.cos(omega * 11 / 60)
        errors.append(abs(frame.x[1, 0] - frame.x[0, 0] - exact))
    assert slope(errors) == pytest.approx(ORDERS[integrator], abs=0.15)


@pytest.mark.parametrize('integrator', ['backward_euler', 'bdf2', slow('ndf2')])
def test_a_spinning_pair_loses_momentum_at_its_order(integrator):
    errors = []
    for substeps in (32, 64, 128, 256):
        two = pair('line', integrator, substeps)
        radius = 0.05
        two.state.v[1, two.slot] = 2.0 * np.pi * radius * np.array([-1.0, 1.0])
        before = measure.angular_momentum(two.state)[2]
        for _ in range(30):
            two.step()
        errors.append(abs(measure.angular_momentum(two.state)[2] / before - 1))
    assert slope(errors) == pytest.approx(ORDERS[integrator], abs=0.15)


PROGRAM = """
import sys
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
sheet = compile_scene(load_scene('swing', {
    'solver.method': 'line', 'solver.substeps': 4, 'cloths.sheet.grid.resolution': [23, 19],
    'cloths.sheet.effects.bend.stiffness': 1e-4}))
for _ in range(6):
    sheet.step()
print(sheet.hash())
"""
ROPES = """
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
sheet = compile_scene(scene_from_mapping({
    'solver': {'method': 'gauss_seidel', 'integrator': 'backward_euler', 'substeps': 4},
    'cloths': {'c': {'grid': {'size': [0.9, 0.8], 'resolution': [23, 19]}, 'density': 1.0,
                     'effects': {'stretch': {'compliance': 0.1}}}}}, where='x', name='x'))
sheet.state.x[2, sheet.slot] = 0.01 * sheet.state.x[0, sheet.slot]**2
sheet.state.v[:, sheet.slot[::7]] = 0.3
for _ in range(6):
    sheet.step()
print(sheet.hash())
"""
PATHS = """
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
for precision in ('float64', 'float32'):
    skin = compile_scene(load_scene('balloon', {'solver.method': 'line', 'solver.substeps': 8,
                                                'solver.precision': precision}))
    for _ in range(30):
        skin.step()
    print(skin.hash())
"""
LAYERS = """
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
towel = compile_scene(load_scene('fold', {'solver.method': 'line', 'solver.substeps': 8}))
for _ in range(240):
    towel.step()
assert towel.stats()['self_contacts'] > 100
print(towel.hash())
"""
BARE = PROGRAM.replace(""",
    'cloths.sheet.effects.bend.stiffness': 1e-4""", '').replace("'line'", "'gauss_seidel'")
TOUCHING = PROGRAM.replace("'swing'", "'drape'").replace('sheet.grid', 'cover.grid').replace(
    "'cloths.sheet.effects.bend.stiffness': 1e-4",
    "'cloths.cover.pose.position': [-0.5, -0.5, 0.33]")


@pytest.mark.parametrize(('program', 'widths'), [
    pytest.param(ROPES, ('128', ''), id='ropes, narrow and native'),
    *(pytest.param(program, ('128', '256', '512'), id=name, marks=pytest.mark.slow)
      for name, program in (('bare', BARE), ('free', PROGRAM), ('layers', LAYERS),
                            ('paths', PATHS), ('touching', TOUCHING)))])
def test_same_bits_whatever_the_vector_width(program, widths):
    """The cache of kernels is one folder per width; the native one has the step already."""
    found = {}
    for bits in widths:
        done = subprocess.run(
            [sys.executable, '-c', program], capture_output=True, text=True, check=False,
            env={**os.environ, 'XPBD_ROS_VECTOR_BITS': bits})
        if bits == '512' and done.returncode == -signal.SIGILL:
            continue    # a CPU without AVX-512
        assert done.returncode == 0, done.stderr
        found[bits] = done.stdout
    assert len(set(found.values())) == 1, found


@pytest.mark.parametrize('text', ['abc', '1024', '64', '-1'])
def test_a_vector_width_that_there_is_not_is_refused(text):
    with pytest.raises(InputError, match='variable XPBD_ROS_VECTOR_BITS: must be one of 32, 128'):
        width_of(text)


@pytest.mark.parametrize('method', [
    METHODS[0], pytest.param(METHODS[1], marks=pytest.mark.slow), METHODS[2]])
def test_a_palindromic_sweep_keeps_a_sheet_nearly_symmetric(method):
    sheet = simulation(method, 'backward_euler', 32)
    for _ in range(20):
        frame = sheet.step()
    x = frame.x.reshape(17, 17, 3)
    mirrored = x[:, ::-1] * (-1, 1, 1) + (1, 0, 0)
    assert np.abs(x - mirrored).max() < 0.02


def test_stiff_swing_is_right_with_far_fewer_substeps():
    """At 16 × 1 lines with BDF2 beat plain XPBD at 128 × 1 by far (doc/numerics.md 3.2)."""
    def at_half_a_second(method, integrator, substeps):
        sheet = simulation(method, integrator, substeps)
        for _ in range(30):
            frame = sheet.step()
        return frame.x

    truth = at_half_a_second('line', 'bdf2', 256)
    error = {key: np.sqrt(((at_half_a_second(*key) - truth)**2).sum(1).mean())
             for key in (('line', 'bdf2', 16), ('gauss_seidel', 'backward_euler', 128))}
    assert error['line', 'bdf2', 16] < 0.2 * error['gauss_seidel', 'backward_euler', 128]


@pytest.mark.slow
@pytest.mark.parametrize('method', METHODS)
def test_float32_follows_float64(method):
    frames = {}
    for precision in ('float64', 'float32'):
        sheet = simulation(method, 'backward_euler', 8, **{'solver.precision': precision})
        for _ in range(12):
            frame = sheet.step()
        frames[precision] = frame.x
        assert sheet.state.x.dtype == precision
    assert np.abs(frames['float32'] - frames['float64']).max() < 1e-3


@pytest.mark.parametrize('method, integrator, mesh', [
    ('line', 'ndf2', False), slow('gauss_seidel', 'backward_euler', False),
    slow('line', 'bdf2', False), slow('line', 'ndf2', True),
    slow('gauss_seidel_symmetric', 'bdf2', True), slow('jacobi', 'backward_euler', False),
    slow('jacobi', 'backward_euler', True)])
def test_float32_keeps_its_digits_in_short_steps(method, integrator, mesh):
    """g h² is less than the last bit of x here; v must not be made of them."""
    x = {}
    for precision in ('float64', 'float32'):
        sheet = simulate((17, 17), mesh=mesh,
                         effects={'stretch': {'warp': 5000.0, 'weft': 5000.0}},
                         pins={'p': {'cloth': 'c', 'at': [36 if mesh else 288]}}, density=0.2,
                         pose={'position': [0.0, 0.0, 1.5]}, method=method,
                         integrator=integrator, substeps=256, precision=precision)
        for _ in range(12):
            frame = sheet.step()
        x[precision] = frame.x
    deviation = np.sqrt(((x['float32'] - x['float64'])**2).sum(1).mean())
    assert 0.0 < deviation < 1e-4


@pytest.mark.parametrize('integrator', [
    'backward_euler', pytest.param('ndf2', marks=pytest.mark.slow)])
@pytest.mark.parametrize('effect', quick_only([
    {'damping': {'rate': 0.4}}, {'drag': {}}, {'force': {'per_mass': [0.0, 0.1, 0.0]}}],
    {'force': {'per_mass': [0.0, 0.1, 0.0]}}), ids=repr)
def test_float32_feels_forces_below_its_last_digit(effect, integrator):
    """A fall of 0.5 m in 1280 substeps, in each of which they move it by less than 10 nm."""
    def fall(precision, scene_effects):
        return run(simulate((4, 3), (0.6, 0.4), pose={'position': [0.0, 0.5, 0.5]}, density=0.5,
                            gravity=(0, 0, -GRAVITY), substeps=64, integrator=integrator,
                            precision=precision, scene_effects=scene_effects), 20).x

    plain, truth = fall('float64', {}), fall('float64', effect)
    assert np.abs(truth - plain).max() > 3e-3
    assert np.abs(fall('float32', effect) - truth).max() < 1e-4
