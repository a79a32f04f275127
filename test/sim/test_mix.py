"""A mix of methods: ``explicit`` in calm frames, ``line`` in rough ones and after them."""

from dataclasses import replace

import numpy as np
import pytest

from support.newton import balance
from support.scenes import GRAVITY, run, run_until_still, simulate
from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.ros.chosen_keys import chosen_keys, with_chosen_keys
from xpbd_ros.scene.auto import CALM_FRAMES
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.cost_table import SHIPPED
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.scene.save import explicit
from xpbd_ros.sim.checkpoint import checkpoint, restore
from xpbd_ros.sim.commands import MovePin, Pose, Reset, SetKey, SetState
from xpbd_ros.sim.measure import angular_momentum, momentum
from xpbd_ros.sim.stepping import explicit_guard

PINS = {'a': {'cloth': 'c', 'at': 'corner_00'}, 'b': {'cloth': 'c', 'at': 'corner_01'}}
EFFECTS = {'stretch': {'warp': 60.0, 'weft': 40.0}, 'shear': {'stiffness': 5.0},
           'bend': {'stiffness': 1e-3}}
STIFF = {**EFFECTS, 'stretch': {'warp': 6000.0, 'weft': 4000.0}}
AT_REST = {'pin': {}, 'damping': {'rate': 0.0}, 'force': {'per_mass': [0.0, 0.0, 0.0]}}
"""effects that do nothing at these values: one step for nearly all tests here"""


def sheet(method='auto', integrator=None, substeps=None, **options):
    """Return a small cloth that swings from two corners."""
    return simulate((6, 5), density=0.2, method=method, integrator=integrator, substeps=substeps,
                    **{'effects': EFFECTS, 'pins': PINS, 'scene_effects': AT_REST, **options})


def again(simulation, commands=()):
    """Return a simulation of the scene as a log has it, after the same live keys."""
    text = explicit(simulation._retune.scene, simulation.solver)
    return compile_scene(scene_from_mapping(text, where='log', name='log'))


def rough_in(monkeypatch, frames):
    """Let the check find these frames unstable, counted from 1, and all others calm."""
    asked = []

    def is_stable(*_, **__):
        asked.append(len(asked) + 1)
        return asked[-1] not in frames
    monkeypatch.setattr(explicit_guard, 'is_stable', is_stable)


def test_calm_frames_are_those_of_explicit():
    mixed, line = sheet(), sheet('line')
    solver = mixed.solver
    assert (solver.method, solver.integrator, solver.mixes) == ('explicit', 'leapfrog', True)
    assert (solver.rough.integrator, solver.rough.substeps) == (
        line.solver.integrator, line.solver.substeps)
    plain = sheet('explicit', 'leapfrog')
    assert plain.solver.substeps == solver.substeps
    assert solver.reason.startswith(f'auto: explicit, leapfrog, {solver.substeps} substeps, about')
    assert f'; rough frames: line, ndf2, {line.solver.substeps} substeps' in solver.reason
    np.testing.assert_array_equal(run(mixed, 20).x, run(plain, 20).x)
    assert mixed.stats()['method_switches'] == mixed.stats()['line_frames'] == 0


def test_a_rough_stretch_is_of_line_and_ends_after_calm_frames(monkeypatch):
    """The same bits as ``line`` from the state where it takes over; no frame is tried twice."""
    rough_in(monkeypatch, {5, 9})
    mixed = sheet()
    run(mixed, 4)
    line = sheet('line', mixed.solver.rough_integrator, mixed.solver.rough_substeps)
    line.state.x[:], line.state.v[:] = mixed.state.x, mixed.state.v
    for k in range(1 + 4 + CALM_FRAMES):
        assert mixed.stats()['line_frames'] == k
        frame, expected = mixed.step(), line.step()
        np.testing.assert_array_equal(frame.x, expected.x)
        np.testing.assert_array_equal(frame.pins['a'].force, expected.pins['a'].force)
    assert mixed.setting.method == 'explicit'
    plain = sheet('explicit', 'leapfrog', mixed.solver.substeps)
    plain.state.x[:], plain.state.v[:] = mixed.state.x, mixed.state.v
    np.testing.assert_array_equal(mixed.step().x, plain.step().x)
    assert mixed.stats()['method_switches'] == 2
    assert mixed.stats()['line_frames'] == 5 + CALM_FRAMES


@pytest.mark.parametrize('far', [0.0, 100.0])
def test_rounding_is_not_taken_for_instability(far):
    """A cloth at rest without gravity moves by rounding only."""
    mixed = sheet(pins={}, gravity=(0.0, 0.0, 0.0), effects=STIFF,
                  pose={'position': [far, 0.0, 0.0], 'orientation': [0.1, 0.2, 0.3, 0.9]})
    run(mixed, 60)
    assert 0.0 < np.abs(mixed.state.v).max() < 1e-9
    assert mixed.stats()['line_frames'] == 0


def test_a_switch_loses_no_momentum(monkeypatch):
    rough_in(monkeypatch, {3, 40})
    mixed = sheet(pins={}, gravity=(0.0, 0.0, 0.0))
    state, slot = mixed.state, mixed.slot
    state.v[:, slot] = np.random.default_rng(1).normal(0.0, 0.3, (3, len(slot)))
    before = momentum(state), angular_momentum(state)
    for _ in range(44):
        mixed.step()
        np.testing.assert_allclose(momentum(state), before[0], atol=1e-13)
    assert mixed.stats()['method_switches'] == 3
    turned = np.abs(angular_momentum(state) - before[1]).max()
    assert turned < 0.05 * np.abs(before[1]).max()


def test_what_an_unstable_frame_leaves_does_not_reach_the_next(monkeypatch):
    """It may leave numbers that are none in all that it writes: elements overflow in a frame."""
    hashes = []
    for left in (0.0, np.nan):
        swing, asked = sheet(), []

        def is_stable(*_, swing=swing, asked=asked, left=left, **__):
            asked.append(None)
            if len(asked) != 3:
                return True
            state = swing.state
            for array in (state.x, state.x_prev, state.v, state.reaction, *(
                    getattr(part, 'edges', part).force for name in EFFECTS
                    for part in swing.effects[name].parts)):
                array[:] = left
            return False
        monkeypatch.setattr(explicit_guard, 'is_stable', is_stable)
        run(swing, CALM_FRAMES + 6)
        stats = swing.stats()
        assert (stats['method_switches'], stats['frames_taken_back']) == (2, 0)
        hashes.append(swing.hash())
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize('compliance', [0.0, slow(0.01)])
def test_pins_give_the_momentum_in_the_frames_of_a_switch(compliance, monkeypatch):
    """Newton's law in each frame, to rounding, as pins are shaken; in those of a switch too."""
    rough_in(monkeypatch, {5, 12, 50})
    mixed = sheet(pins={name: {**pin, 'compliance': compliance} for name, pin in PINS.items()})
    places = {name: np.array(pin.pose.position) for name, pin in mixed.frame().pins.items()}

    def shaken(frame):
        way = 0.05 * np.sin(20.0 * 1e-9 * frame.time_ns) * np.array([1.0, 0.5, 0.8])
        return [MovePin(name, Pose(tuple(place + way))) for name, place in places.items()]
    found = balance(mixed, [shaken] * 60)
    assert mixed.stats()['method_switches'] == 3
    assert found.worst() < 1e-10


def test_a_sheet_falls_through_air_at_its_last_speed_with_either_method(monkeypatch):
    """½ ρ c v² A = M g; published velocities belong to the ends of frames."""
    mixed = sheet(effects={}, pins=None, scene_effects={'drag': {}})
    last = np.sqrt(0.2 * GRAVITY / (0.5 * 1.2 * 1.2))    # with the defaults of drag
    mixed.state.v[2, mixed.slot] = -last
    rough_in(monkeypatch, {3})
    for _ in range(6 + CALM_FRAMES):
        np.testing.assert_allclose(mixed.step().v[:, 2], -last, rtol=1e-9)
    assert mixed.stats()['method_switches'] == 2


def test_pins_carry_the_weight_in_the_frames_of_a_switch(monkeypatch):
    """In a sheet so soft in shear that it rests alike with either method."""
    mixed = sheet(effects={**EFFECTS, 'shear': {'stiffness': 1.0}},
                  scene_effects={**AT_REST, 'damping': {'rate': 10.0}})
    run_until_still(mixed, speed=1e-7)
    rough_in(monkeypatch, {2})
    for _ in range(4 + CALM_FRAMES):
        pins = mixed.step().pins
        np.testing.assert_allclose(sum(pins[name].force for name in 'ab'),
                                   [0.0, 0.0, -0.2 * GRAVITY], atol=2e-3)
    assert mixed.stats()['method_switches'] == 2


def test_a_crumpled_cloth_takes_line_until_it_is_calm():
    mixed = sheet(effects=STIFF, scene_effects={**AT_REST, 'damping': {'rate': 2.0}})
    places = np.random.default_rng(2).uniform(-0.2, 0.2, 3 * len(mixed.slot))
    mixed.step([SetState('c', tuple(places))])
    assert mixed.setting.method == 'line'
    run(mixed, 400)
    assert mixed.setting.method == 'explicit'
    assert mixed.stats()['line_frames'] > CALM_FRAMES
    assert mixed.stats()['frames_taken_back'] == 0


@pytest.mark.slow
@pytest.mark.parametrize('precision', ['float64', 'float32'])
def test_any_number_of_threads_gives_the_same_bits(precision, monkeypatch):
    hashes = []
    for threads in (1, 2):
        rough_in(monkeypatch, {4})
        keys = {'solver.threads': threads, 'solver.precision': precision,
                'cloths.sheet.grid.resolution': [17, 17]}
        mixed = compile_scene(load_scene('swing', keys))
        run(mixed, 8 + CALM_FRAMES)
        assert mixed.stats()['method_switches'] == 2
        hashes.append(mixed.hash())
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize('way', ['save', 'checkpoint'])
def test_the_frames_left_with_line_are_part_of_a_state(way, monkeypatch):
    rough_in(monkeypatch, {4})
    mixed = sheet()
    run(mixed, 10)
    other = sheet()
    if way == 'save':
        other.restore(mixed.save())
    else:
        restore(other, checkpoint(mixed))
    assert other.setting.method == 'line'
    monkeypatch.setattr(explicit_guard, 'is_stable', lambda *_, **__: True)
    for _ in range(CALM_FRAMES):
        mixed.step()
        other.step()
        assert other.hash() == mixed.hash()
    assert other.setting.method == mixed.setting.method == 'explicit'


def test_a_reset_begins_with_explicit(monkeypatch):
    rough_in(monkeypatch, {2})
    mixed = sheet()
    run(mixed, 3)
    assert mixed.setting.method == 'line'
    mixed.step([Reset()])
    assert mixed.setting.method == 'explicit'
    np.testing.assert_array_equal(mixed.frame().x, run(sheet(), 1).x)


def test_stiffer_cloth_takes_line_and_the_log_of_it_repeats():
    """In a log ``auto`` is resolved, and what it chose later is there as keys."""
    mixed = sheet()
    repeated = again(mixed)
    assert replace(repeated.solver, reason='') == replace(mixed.solver, reason='')
    key, before = 'cloths.c.effects.stretch.warp', chosen_keys(mixed.solver)
    for stiffness, method in ((1e12, 'line'), (90.0, 'explicit'), (0.1, 'explicit'), (60.0,
                                                                                  'explicit')):
        change = [SetKey(key, stiffness)]
        assert not mixed.step(change).refused
        now = chosen_keys(mixed.solver)
        assert not repeated.step([*change, *(
            SetKey(name, value) for name, value in now.items() if value != before[name])]).refused
        before = now
        assert (mixed.solver.method, mixed.solver.mixes) == (method, True)
        assert repeated.hash() == mixed.hash()
        for _ in range(5):
            mixed.step()
            repeated.step()
        assert repeated.hash() == mixed.hash()
        assert np.isfinite(mixed.frame().x).all()
    assert mixed.stats()['frames_taken_back'] == 0


def test_an_integrator_that_changes_while_running_is_in_the_log():
    lines = sheet('line', effects=STIFF)
    repeated, told = again(lines), [lines.solver.integrator]
    for substeps in (1, 40):
        before = chosen_keys(lines.solver)
        frame = with_chosen_keys(lines.step([SetKey('solver.substeps', substeps)]), before,
                                 chosen_keys(lines.solver))
        assert not repeated.step(frame.applied).refused
        told.append(lines.solver.integrator)
        for _ in range(5):
            assert repeated.hash() == lines.hash()
            lines.step()
            repeated.step()
    assert told == ['ndf2', 'bdf2', 'ndf2']


def test_given_substeps_of_a_running_mix_decide_on_the_method():
    mixed = sheet(effects=STIFF)
    enough, rough = mixed.solver.substeps, mixed.solver.rough_substeps
    for count, method in ((2 * enough, 'explicit'), (enough - 1, 'line'), (enough, 'explicit')):
        assert not mixed.step([SetKey('solver.substeps', count)]).refused
        assert (mixed.solver.method, mixed.solver.substeps) == (method, count)
    assert mixed.solver.rough_substeps == rough


@pytest.mark.parametrize('keys', [
    {'substeps': 60}, {'integrator': 'bdf2'}, {'iterations': 2}, {'error_target': 1e-3},
    {'budget_ms': 0.05}])
def test_other_keys_leave_auto_with_line(keys):
    scene = load_scene('swing', {
        'cloths.sheet.grid.resolution': [9, 9],
        **{f'solver.{key}': value for key, value in keys.items()}})
    solver = compile_scene(scene).solver
    assert (solver.method, solver.mixes) == ('line', False)
    assert compile_scene(load_scene('swing', {
        'cloths.sheet.grid.resolution': [9, 9]})).solver.mixes


def test_a_mix_may_exceed_the_budget_by_a_tenth():
    def taken(budget_ms):
        return compile_scene(load_scene('swing', {
            'cloths.sheet.grid.resolution': [9, 9], 'solver.budget_ms': budget_ms}))
    roomy = taken(8.0)
    time = 1e-6 * roomy.solver.substeps * SHIPPED.substep_ns('explicit', 1, roomy.effects,
                                                             roomy.state)
    assert taken(time / 1.09).solver.method == 'explicit'
    assert taken(time / 1.11).solver.method == 'line'


def test_rigid_edges_leave_auto_with_line():
    assert sheet(effects={**EFFECTS, 'stretch': {'compliance': 0.0}}).solver.method == 'line'


@pytest.mark.parametrize('options', [
    {'effects': {**EFFECTS, 'strain_limit': {'max': 0.1}}},
    {'scene_effects': {'self_collision': {'thickness': 0.01}}},
    {'effects': {**EFFECTS, 'tether': {'slack': 0.1}}}])
def test_effects_with_lagging_velocities_or_limits_leave_auto_with_line(options):
    assert sheet(**options).solver.method == 'line'


@pytest.mark.parametrize('name, effect, keys', [
    ('sheet', 'membrane', {}), slow('softbox', 'volume', {}),
    ('sheet', 'area', {'cloths.sheet.effects.area': {'stiffness': 100.0}})])
def test_elements_mix_and_their_energy_and_sides_are_looked_at(name, effect, keys):
    """By the definition in NumPy; what only the substeps' number makes unstable is redone."""
    mixed = compile_scene(load_scene(name, keys))
    assert mixed.solver.mixes
    built = mixed.effects[effect]
    run(mixed, 20)
    assert mixed.stats()['line_frames'] == 0
    mixed.state.x[:] += np.random.default_rng(1).normal(0.0, 2e-3, mixed.state.x.shape)
    assert built.stored_energy(mixed.state) == pytest.approx(
        built.constraints.energy(mixed.state.x), rel=1e-12)
    assert len(built.sides[0]) == len(mixed.cloths[0].mesh.edges)
    few = compile_scene(load_scene(name, {
        **keys, 'solver.method': 'explicit', 'solver.substeps': mixed.solver.substeps // 4}))
    run(few, 60)
    assert few.stats()['explicit_redone'] > 0
    assert np.abs(few.frame().x).max() < 2.0


@pytest.mark.slow
def test_a_balloon_mixes_and_a_switch_keeps_its_momentum(monkeypatch):
    """
    Gas stretches the skin, whose sides are looked at.

    The ball has bounced once, in frame 14, and flies until frame 38: the next impact differs from
    method to method.
    """
    raw = load_scene('balloon').raw
    heights = []
    for rough in ((), (20,)):
        rough_in(monkeypatch, rough)
        balloon = compile_scene(scene_from_mapping(
            {**raw, 'solver': {}}, where=str(load_scene('balloon').where), name='balloon'))
        assert balloon.solver.mixes and balloon.solver.method == 'explicit'
        heights.append([frame.x[:, 2].mean() for frame in (balloon.step() for _ in range(38))])
        assert balloon.stats()['line_frames'] == (19 if rough else 0)
    np.testing.assert_allclose(*heights, atol=1e-4)


@pytest.mark.parametrize('options', [
    {'scene_effects': {'wind': {'velocity': [0.0, 3.0, 0.0]}, 'drag': {}}},
    {'scene_effects': {'contact': {'thickness': 0.01}, 'friction': {}},
     'colliders': {'floor': {'plane': {}}}}])
def test_contact_and_air_mix(options):
    assert sheet(**options).solver.mixes


@pytest.mark.parametrize('solver, text', [
    ({'method': 'line', 'rough_frames': 3}, 'solver.rough_frames: goes with method explicit '
                                            r'\(got line\)'),
    ({'rough_substeps': 3}, r'solver.rough_substeps: goes with method explicit \(got auto\)')])
def test_keys_of_rough_frames_without_explicit_are_refused(solver, text):
    raw = load_scene('swing').raw
    with pytest.raises(InputError, match=text):
        compile_scene(scene_from_mapping({**raw, 'solver': solver}, where='x', name='x'))


@pytest.mark.parametrize('effects, wind', [
    ({'stretch': {'warp': 60.0, 'weft': 40.0}}, 12.0)])
def test_the_work_of_wind_is_not_taken_for_instability(effects, wind):
    """A gust hits light cloth at rest."""
    mixed = simulate((6, 5), density=0.05, method='explicit', integrator='leapfrog', substeps=64,
                     gravity=(0.0, 0.0, 0.0), effects=effects, scene_effects={
                         'wind': {'velocity': [0.0, 0.0, wind]}, 'drag': {}})
    run(mixed, 20)
    assert mixed.stats()['explicit_redone'] == 0


@pytest.mark.slow
def test_the_work_of_gas_is_not_taken_for_instability():
    """The amount of gas is raised by a hundredth at rest."""
    keys = {'solver.method': 'explicit', 'solver.substeps': 400,
            'cloths.balloon.effects.pressure.amount': 1.0}
    balloon = compile_scene(load_scene('balloon', keys))
    run(balloon, 2)
    before = balloon.stats()['explicit_redone']
    balloon.step([SetKey('cloths.balloon.effects.pressure.amount', 1.01)])
    assert balloon.stats()['explicit_redone'] == before


def test_the_work_of_pins_is_not_taken_for_instability():
    """Pins stretch a membrane that is at rest."""
    pulled = compile_scene(load_scene('sheet', {'solver.method': 'explicit'}))
    run(pulled, 40)
    assert pulled.stats()['explicit_redone'] == 0
