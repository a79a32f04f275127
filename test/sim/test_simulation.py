"""A simulation as a whole: time, frames, commands, repetition, invariance."""

from fractions import Fraction
import gc
import os
from pathlib import Path
import subprocess
import sys
import weakref

from numba.core.dispatcher import Dispatcher
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.scenes import EXAMPLES, FEW, run, simulate, with_effects
from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import (
    Grasp,
    MoveCollider,
    MovePin,
    Pose,
    Release,
    ReleaseAll,
    Reset,
    SetKey,
    Twist,
)
from xpbd_ros.sim.measure import angular_momentum, momentum
from xpbd_ros.sim.particles.state import history_arrays

ROOT = Path(__file__).resolve().parents[2]
CLOTH = {name: EXAMPLES[name] for name in ('bend', 'shear', 'stretch')}
MOVING = {
    'pins': {'a': {'cloth': 'c', 'at': 'corner_00',
                   'motion': [[0.0, 0.0, 0.0, 0.0], [0.5, 0.2, 0.0, 0.3], [1.0, 0.2, 0.4, 0.1]]}},
    'colliders': {'table': {'plane': {}, 'position': [0.0, 0.0, -0.005]},
                  'block': {'box': {'size': [0.2, 0.2, 0.2]}, 'motion': [
                      [0.0, 0.5, 0.5, -0.2], [0.5, 0.5, 0.5, 0.1]]}}}
COMMANDS = {
    5: [Grasp('hand', Pose((1.0, 1.0, 0.0)), 0.3)],
    6: [MovePin('hand', Pose((1.0, 0.8, 0.3), (0.0, 0.6, 0.0, 0.8)), None, 0)],
    20: [MoveCollider('block', Pose((0.4, 0.5, 0.05)), Twist((0.1, 0.0, 0.0)), 0)],
    25: [SetKey('cloths.c.effects.stretch.warp', 90.0), SetKey('solver.substeps', 7)],
    30: [Release('hand'), Release('missing')],
}


METHODS = pytest.mark.parametrize('options', [
    {}, pytest.param({'method': 'gauss_seidel_symmetric', 'integrator': 'bdf2'},
                     marks=pytest.mark.slow),
    {'method': 'line', 'integrator': 'ndf2', 'names': FEW},
    slow({'method': 'line', 'integrator': 'bdf2'})], ids=lambda options: (
        options.get('method', 'plain') + ('-few' if 'names' in options else '')))


def story(**options):
    """Return the hash of every frame of a run in which something of each kind happens."""
    simulation = with_effects(substeps=5, iterations=2, **MOVING, **options)
    hashes = []
    for k in range(40):
        simulation.step(COMMANDS.get(k, ()))
        hashes.append(simulation.hash())
    return hashes


@METHODS
def test_two_runs_have_the_same_bits(options):
    """V28."""
    hashes = story(**options)
    assert hashes == story(**options)
    assert len(set(hashes)) == len(hashes)


def in_another_process(call: str) -> str:
    """Return what a function of this file returns there."""
    path = os.pathsep.join([str(ROOT), str(ROOT / 'test')])
    code = f'from sim.test_simulation import *; print({call})'
    return subprocess.run([sys.executable, '-c', code], env={**os.environ, 'PYTHONPATH': path},
                          capture_output=True, text=True, check=True,
                          timeout=120).stdout.strip()


def test_another_process_has_the_same_bits():
    assert in_another_process('story()') == str(story())


def variants() -> int:
    """Return how many kernels there are, for all types."""
    return sum(len(each.overloads) for each in gc.get_objects() if isinstance(each, Dispatcher))


def variants_after_compiling(**options) -> int:
    """Return how many kernels a run adds once its scene is compiled."""
    simulation = with_effects(substeps=5, iterations=2, **MOVING, **options)
    simulation.compile()
    before = variants()
    assert before >= 4
    for k in range(40):
        simulation.step(COMMANDS.get(k, ()))
    return variants() - before


@METHODS
def test_nothing_is_left_to_compile_when_frames_must_come(options):
    """In real time a compiler costs frames."""
    assert in_another_process(f'variants_after_compiling(**{options})') == '0'


@METHODS
def test_the_hash_sees_the_last_bit_of_anything(options):
    simulation = with_effects(**options)
    seen = {simulation.hash()}
    state, last = simulation.state, simulation.slot[-1]
    arrays = [state.x[2], state.v[2], state.inv_mass]
    if state.history is not None:
        arrays += [*(array[2] for array in history_arrays(state)), state.history.fresh]
    for array in arrays:
        array[last] = np.nextafter(array[last], 9.0)
        seen.add(simulation.hash())
    assert len(seen) == 1 + len(arrays)


@METHODS
@pytest.mark.parametrize('rate', [60.0, 50.0])
def test_after_a_reset_the_run_repeats_to_the_bit_though_time_goes_on(options, rate):
    """Keyframes of pins and colliders restart as well; a frame is not a whole number of ns."""
    simulation = with_effects(substeps=5, rate=rate, **MOVING, **options)
    first, first_poses = [], []
    for _ in range(20):
        frame = simulation.step()
        first.append(simulation.hash())
        first_poses.append([place.pose for place in (
            *frame.pins.values(), *frame.colliders.values())])
    run(simulation, 26, [Grasp('hand', Pose((1.0, 1.0, 0.0)), 0.3)])
    for k in range(20):
        frame = simulation.step([Reset()] if k == 0 else ())
        assert frame.index == 47 + k
        assert [place.pose for place in (
            *frame.pins.values(), *frame.colliders.values())] == first_poses[k]
        assert simulation.hash() == first[k]
        assert list(frame.pins) == ['a']


@METHODS
def test_a_live_key_set_to_what_it_is_changes_no_bit(options):
    """What was built anew goes on from where the old one was."""
    plain, touched = (with_effects(substeps=5, **MOVING, **options) for _ in range(2))
    hand = [Grasp('hand', Pose((1.0, 1.0, 0.0)), 0.3)]
    turned = [MoveCollider('block', Pose((0.4, 0.5, 0.05)), Twist((0.1, 0.0, 0.0)), 0)]
    for k in range(30):
        commands = hand if k == 3 else turned if k == 6 else []
        plain.step(commands)
        touched.step(commands + ([SetKey('cloths.c.effects.stretch.warp',
                                         EXAMPLES['stretch']['warp'])] if k in (2, 4, 9) else []))
        assert plain.hash() == touched.hash(), k


def test_a_live_key_frees_the_effects_before_it_without_the_collector():
    simulation = with_effects(**MOVING)
    simulation.step()
    before = [weakref.ref(built) for built in simulation.effects.values()]
    gc.disable()
    try:
        simulation.step([SetKey('gravity', [0.0, 0.0, -8.0])])
        assert [each() for each in before] == [None] * len(before)
    finally:
        gc.enable()


@pytest.mark.parametrize('key, value, text', [
    ('cloths.c.effects.stretch.warp', -1, 'must be > 0 N/m (got -1)'),
    ('cloths.c.effects.stretch.warp', float('nan'), 'must be finite N/m (got nan)'),
    ('cloths.c.density', 2.0, 'cloths.c.density: cannot change while running (these can: '),
    ('solver.substeps', 0, 'solver.substeps: must be at least 1 (got 0)'),
    ('gravity', [0, 0], 'gravity: must be 3 numbers in m/s² (got 2)'),
    ('gravity.x', 1, 'gravity.x: cannot change while running (these can: '),
    ('gravity.x', 1, ', solver.rough_substeps, '),
    ('', 1, ': cannot change while running (these can: ')])
def test_a_bad_live_key_is_refused_and_nothing_happens(key, value, text):
    plain, touched = (with_effects(substeps=3) for _ in range(2))
    command = SetKey(key, value)
    for simulation, commands in ((plain, []), (touched, [command])):
        simulation.step()
        frame = simulation.step(commands)
        simulation.step()
    refused, = run(touched, 1, [command]).refused
    assert refused[0] is command
    assert text in refused[1]
    plain.step()
    assert frame.applied == ()
    assert plain.hash() == touched.hash()
    with pytest.raises(InputError):
        touched.check({key: value})


def test_live_keys_act():
    simulation = simulate((1, 1), gravity=(0, 0, -1), rate=10)
    frame = simulation.step([SetKey('gravity', [0.0, 0.0, 3.0])])
    assert frame.applied == (SetKey('gravity', [0.0, 0.0, 3.0]),)
    assert frame.v[0, 2] == pytest.approx(0.3)
    simulation.step([SetKey('solver.substeps', 4), SetKey('solver.iterations', 2)])
    assert (simulation.solver.substeps, simulation.solver.iterations) == (4, 2)
    simulation = with_effects()
    before = simulation.effects['bend'].constraints.compliance
    simulation.step([SetKey('cloths.c.effects.bend.stiffness', 500.0 * 2e-3)])
    np.testing.assert_allclose(simulation.effects['bend'].constraints.compliance, before / 500.0,
                               rtol=1e-12)
    simulation.step([SetKey('effects.contact.thickness', 0.02)])
    assert simulation.effects['contact'].contacts.thickness[0] == 0.02
    simulation.step([SetKey('colliders.table.friction', 0.125)])
    assert simulation.effects['friction'].data.coefficient[0, 0] == 0.25    # √(0.5 · 0.125)
    assert simulation.effects['friction'].data.contacts is simulation.effects['contact'].contacts


@pytest.mark.parametrize('command', [Grasp('a', Pose(), 0.1), Release('a'), ReleaseAll(),
                                     MovePin('a', Pose()), MoveCollider('b', Pose())])
def test_what_the_scene_has_no_effect_for_is_refused(command):
    frame = simulate((2, 2)).step([command])
    assert frame.refused == ((command, f'{type(command).__name__}: the scene has no effect that '
                              'does this'),)


def test_commands_act_in_their_order():
    simulation = with_effects()
    there = Pose((1.0, 1.0, 0.0))
    commands = [Grasp('b', there, 0.01), Release('b'), Grasp('c', there, 0.01),
                Grasp('d', there, 0.01)]
    frame = simulation.step(commands)
    assert frame.applied == tuple(commands[:3])
    assert [command for command, _ in frame.refused] == commands[3:]
    assert list(frame.pins) == ['a', 'c']


def test_frames_are_exact_in_time():
    """V28; 29.97 frames per second, told in decimals, are exactly that."""
    for rate, frame, seconds in ((60.0, 3 * 60, 3), (29.97, 2997, 100), (1.0, 7, 7)):
        simulation = simulate((1, 1), rate=rate)
        assert simulation.frame_rate == Fraction(str(rate))
        assert simulation.time_ns(frame) == seconds * 10**9
    simulation = simulate((1, 1), rate=60)
    assert [simulation.step().time_ns for _ in range(3)] == [16666667, 33333333, 50000000]
    assert simulation.index == simulation.frame().index == 3


def test_a_frame_shares_nothing_with_the_simulation():
    """It stays what it was, and what is written into it goes nowhere."""
    plain, touched = (with_effects() for _ in range(2))
    frame, same = plain.step(), touched.step()
    for array in (same.x, same.v, same.inv_mass):
        array[:] = 1.0
    before = [array.copy() for array in (frame.x, frame.v, frame.inv_mass)]
    plain.step()
    touched.step()
    assert plain.hash() == touched.hash()
    for array, old in zip((frame.x, frame.v, frame.inv_mass), before):
        np.testing.assert_array_equal(array, old)
    for entries in (frame.pins, frame.colliders):
        with pytest.raises(TypeError):
            entries['new'] = None


@pytest.mark.parametrize('integrator', ['backward_euler', 'bdf2'])
def test_substeps_of_another_length_move_nothing_by_themselves(integrator):
    """BDF2 must not take the last substep for one of the new length."""
    simulation = simulate((1, 1), gravity=(0, 0, 0), substeps=4, method='line',
                          integrator=integrator, scene_effects={'damping': {'rate': 0.0}})
    simulation.state.v[0, simulation.slot] = 2.0
    for k, substeps in enumerate((4, 64, 1, 7)):
        frame = simulation.step([SetKey('solver.substeps', substeps)])
        np.testing.assert_allclose(frame.x[0], [2.0 * (k + 1) / 60, 0.0, 0.0], atol=1e-14)
        np.testing.assert_allclose(frame.v[0], [2.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize('first', [30, 3])
def test_the_integrator_that_is_told_after_a_live_change_is_the_one_that_runs(first):
    """NDF2 has storage for BDF2 too; what began with BDF2 stays with it."""
    stiff = {'names': FEW, 'method': 'line', 'scale': 1e-4, 'pose': {'position': [0.0, 0.0, 0.05]}}
    live = with_effects(substeps=first, integrator=None, **stiff)
    told = []
    for substeps in (first, 33 - first, first):
        if live.index:
            assert not live.apply([SetKey('solver.substeps', substeps)])
        told.append(live.solver.integrator)
        live.state.v[2] = np.where(live.state.x[0] < 0.5, -3.0, 3.0)    # on the table, and up
        given = with_effects(substeps=substeps, integrator=told[-1], **stiff)
        for name in ('x', 'x_prev', 'v'):
            getattr(given.state, name)[:] = getattr(live.state, name)
        for _ in range(10):
            frame, expected = live.step(), given.step()
            np.testing.assert_array_equal(frame.x, expected.x)
            np.testing.assert_array_equal(frame.v, expected.v)
            np.testing.assert_array_equal(frame.pins['a'].force, expected.pins['a'].force)
            np.testing.assert_array_equal(frame.colliders['table'].force,
                                          expected.colliders['table'].force)
    assert told == (['ndf2', 'bdf2', 'ndf2'] if first == 30 else ['bdf2'] * 3)
    assert np.abs(frame.colliders['table'].force).max() > 0.1


def test_an_integrator_without_storage_is_refused():
    for begun, known in (('bdf2', 'bdf2'), ('ndf2', 'ndf2, bdf2')):
        simulation = simulate((2, 2), method='line', integrator=begun)
        (_, why), = simulation.apply([SetKey('solver.integrator', 'backward_euler')])
        assert why == ('solver.integrator: backward_euler cannot begin while running (these can: '
                       f'{known}); start with it')


def test_compiling_moves_nothing():
    simulation = with_effects(pose={'position': [0.0, 0.0, 2.0]})
    before = simulation.hash()
    simulation.compile()
    assert simulation.hash() == before
    assert simulation.index == 0


@pytest.mark.parametrize('grid', [
    (7, 1), *(slow(grid) for grid in ((1, 1), (2, 1), (1, 2), (1, 7), (2, 2)))])
@pytest.mark.parametrize('options', [
    {'names': (*FEW, 'damping', 'friction')}, slow({}),
    slow({'method': 'line', 'integrator': 'bdf2'}),
    slow({'method': 'gauss_seidel_symmetric', 'integrator': 'bdf2'})],
    ids=lambda options: options.get('method', 'few' if options else 'plain'))
def test_the_smallest_cloths_run(options, grid):
    """H22."""
    simulation = with_effects(grid, substeps=3, **options, pins={
        'a': {'cloth': 'c', 'at': 'corner_00', 'target': [0.0, 0.0, 0.5]}})
    frame = run(simulation, 60, [Grasp('hand', Pose((0.0, 0.0, 0.0)), 5.0)])
    frame = run(simulation, 60, [ReleaseAll()])
    assert np.isfinite(frame.x).all()
    assert frame.x[:, 2].min() >= -1e-9
    assert frame.inv_mass.min() > 0.0


def tumble(*, names=None, **options):
    """Return a free cloth that spins and deforms, far above the table."""
    scene_effects = {'pin': {}, 'damping': {'rate': 0.0}, 'contact': {'thickness': 0.005},
                     'friction': {}}
    if names:
        scene_effects = {name: scene_effects[name] for name in ('pin', 'contact')}
    simulation = simulate((6, 5), (1.0, 0.7), gravity=(0, 0, 0), scene_effects=scene_effects,
                          effects={'stretch': CLOTH['stretch']} if names else CLOTH,
                          colliders={'table': {'plane': {}, 'position': [0.0, 0.0, -1e3]}},
                          **options)
    rng = np.random.default_rng(4)
    x = simulation.frame().x
    simulation.state.v[:, simulation.slot] = (rng.normal(size=x.shape)
                                              + np.cross([1.0, 2.0, 3.0], x)).T
    return simulation


@METHODS
def test_a_free_cloth_keeps_its_momentum(options):
    """V20: every gradient sums to zero."""
    simulation = tumble(substeps=4, iterations=2, **options)
    before = momentum(simulation.state)
    steps = 4 * 120
    run(simulation, 120)
    largest = (simulation.state.mass * np.linalg.norm(simulation.state.v, axis=0)).sum()
    np.testing.assert_allclose(momentum(simulation.state), before, rtol=0.0,
                               atol=1e-14 * steps * largest)


def test_loss_of_angular_momentum_falls_with_the_substep():
    """Backward Euler loses it in proportion to the substep (V4)."""
    lost = []
    for substeps in (32, 64, 128):
        simulation = tumble(substeps=substeps)
        before = angular_momentum(simulation.state)
        run(simulation, 30)
        lost.append(np.linalg.norm(angular_momentum(simulation.state) - before)
                    / np.linalg.norm(before))
    assert lost[0] < 0.2
    assert lost[0] / lost[1] == pytest.approx(2.0, rel=0.1)
    assert lost[1] / lost[2] == pytest.approx(2.0, rel=0.1)


def hung(*, turn=None, offset=(0.0, 0.0, 0.0), length=1.0, mass=1.0, time=1.0):
    """Return where a cloth is that hung by two corners for a second, in other units or places."""
    turn = turn or Rotation.identity()
    gravity = turn.apply([0.0, 0.0, -9.80665]) * length / time**2
    simulation = simulate(
        (6, 5), (1.0 * length, 0.7 * length), density=0.2 * mass / length**2,
        effects={'bend': {'stiffness': 1e-3 * mass * length**2 / time**2},
                 'shear': {'stiffness': 5.0 * mass / time**2},
                 'stretch': {'warp': 50.0 * mass / time**2, 'weft': 40.0 * mass / time**2}},
        gravity=gravity.tolist(), rate=60.0 / time, substeps=6,
        colliders={'table': {'plane': {}, 'position': [0.0, 0.0, -1e6 * length]}},
        pose={'position': list(offset), 'orientation': turn.as_quat().tolist()},
        pins={'a': {'cloth': 'c', 'at': 'corner_00'}, 'b': {'cloth': 'c', 'at': 'corner_01'}},
        scene_effects={'damping': {'rate': 0.5 / time}, 'friction': {},
                       'contact': {'thickness': 0.005 * length}})
    frame = run(simulation, 60)
    assert np.abs(frame.v).max() > 0.1 * length / time
    return turn.inv().apply(frame.x - offset) / length


def test_results_do_not_depend_on_place_rotation_or_units():
    """V24: millimetres, grams and tenths of a second give the same cloth."""
    plain = hung()
    np.testing.assert_allclose(hung(turn=Rotation.random(random_state=1)), plain, atol=1e-9)
    np.testing.assert_allclose(hung(length=1e3, mass=1e3), plain, atol=1e-9)
    np.testing.assert_allclose(hung(time=10.0, length=1e-3), plain, atol=1e-9)
    np.testing.assert_allclose(hung(offset=(3e3, -4e3, 20.0)), plain, atol=1e-7)


def test_a_scale_of_two_to_the_power_of_n_changes_no_bit():
    np.testing.assert_array_equal(hung(length=2.0**10, mass=2.0**-7), hung())


def test_times_of_frames_are_exact_and_round_to_even():
    """At 60 Hz, and at rates whose periods end in half a nanosecond."""
    for rate in (60.0, 29.97, 1024.0):
        simulation = simulate((2, 2), rate=rate)
        for frame in (*range(7), 10**6 + 1, 10**9 + 1):
            assert simulation.time_ns(frame) == round(frame * 10**9 / simulation.frame_rate)
