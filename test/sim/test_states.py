"""Saved and loaded states, states that are set, clicks, open pins: commands of a simulation."""

import pickle

import numpy as np
import pytest

from support.scenes import FEW, GRAVITY, run, simulate, with_effects
from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.commands import (
    Click,
    Grasp,
    LoadState,
    MovePin,
    Pose,
    Release,
    Reset,
    SaveState,
    SetKey,
    SetState,
)
from xpbd_ros.sim.particles.state import history_arrays

MOVING = {'a': {'cloth': 'c', 'at': 'corner_00', 'motion': [[0.0, 0.0, 0.0, 0.0],
                                                            [1.0, 0.5, 0.0, 0.5]]}}
FALLING = {'stretch': {'warp': 60.0, 'weft': 40.0}}


def sheet(**options):
    """Return a sheet of 5 × 4 particles with a pinned corner."""
    return simulate((5, 4), effects=FALLING, scene_effects={'pin': {'max_pins': 2}}, **{
        'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}}, **options})


def states(simulation, frames: int, commands=()) -> list[tuple]:
    """Return positions and hashes of the next frames."""
    found = []
    for k in range(frames):
        frame = simulation.step(commands if k == 0 else ())
        assert frame.refused == ()
        found.append((frame.x.tobytes(), simulation.hash()))
    return found


def flat(x) -> tuple[float, ...]:
    """Return positions as ``SetState`` takes them."""
    return tuple(np.ravel(x).tolist())


@pytest.mark.parametrize('options', [
    {'names': FEW, 'method': 'line', 'integrator': 'ndf2'}, slow({'integrator': 'bdf2'})],
    ids=lambda options: options['integrator'])
def test_a_loaded_state_continues_to_the_same_bits_and_time_goes_on(options):
    """With a history, contacts, a pin on keyframes and one with a lifetime."""
    simulation = with_effects(pins=MOVING, **options)
    run(simulation, 6, [Grasp('b', Pose((1.0, 1.0, 0.0)), 0.1, 200_000_000)])
    expected = states(simulation, 12, [SaveState()])
    assert set(simulation.frame().pins) == {'a'}, 'the lifetime is over'
    run(simulation, 30, [Release('a')])
    assert states(simulation, 12, [LoadState()]) == expected
    assert simulation.index == 60
    assert simulation.frame().time_ns == 10**9
    assert states(simulation, 12, [LoadState()]) == expected, 'as often as one likes'


def test_what_follows_a_load_in_the_same_frame_acts_on_the_loaded_state():
    simulation = sheet()
    run(simulation, 5, [Release('a')])
    run(simulation, 5, [SaveState(), Grasp('b', Pose((0.0, 0.0, 0.0)), 0.5)])
    assert list(simulation.step([LoadState(), Grasp('c', Pose((0.0, 0.0, 0.0)), 0.5)]).pins) == [
        'c']


def test_a_load_without_a_save_is_refused():
    frame = sheet().step([LoadState()])
    assert frame.refused == ((LoadState(), 'no state has been saved'),)
    assert frame.applied == ()


def test_live_keys_keep_their_values_over_a_load():
    """As over a reset; what was saved goes on with them."""
    simulation = sheet(integrator='bdf2')
    run(simulation, 3, [SetKey('gravity', [0.0, 0.0, -1.0])])
    run(simulation, 3, [SaveState(), SetKey('gravity', [0.0, 0.0, 5.0]),
                        SetKey('solver.substeps', 3)])
    simulation.step([LoadState()])
    assert simulation.solver.substeps == 3
    assert simulation.state.gravity.tolist() == [0.0, 0.0, 5.0]
    assert simulation.frame().v[-1, 2] > -0.06, 'gravity pulls up now'


def test_a_reset_after_a_load_starts_the_keyframes_again():
    simulation = sheet(pins=MOVING)
    expected = run(simulation, 5, [Reset()]).x
    run(simulation, 10, [SaveState()])
    run(simulation, 10)
    run(simulation, 3, [LoadState()])
    assert (run(simulation, 5, [Reset()]).x == expected).all()


def test_a_loaded_state_keeps_live_keys_that_bound_one_another():
    """In the order of the changes, the first would exceed the bound that was saved."""
    rubbed = {'grid': {'size': [1.0, 1.0], 'resolution': [5, 4]}, 'density': 0.2,
              'effects': FALLING,
              'friction': 0.4, 'static_friction': 0.6}
    simulation = compile_scene(scene_from_mapping({'cloths': {'c': rubbed}}, where='s', name='s'))
    sliding, sticking = 'cloths.c.friction', 'cloths.c.static_friction'
    assert simulation.apply([SaveState(), SetKey(sticking, 0.9), SetKey(sliding, 0.8),
                             SetKey(sticking, 0.85), LoadState()]) == []
    with pytest.raises(InputError, match=r'must be at least friction \(0.8\)'):
        simulation.check({sticking: 0.7})
    simulation.check({sliding: 0.85})


def test_a_state_saved_in_a_copy_is_its_own():
    simulation = sheet()
    expected = states(simulation, 3, [SaveState()])
    other = simulation.save().simulation()
    run(simulation, 3, [SaveState()])
    assert states(other, 3, [LoadState()]) == expected


def test_a_saved_state_stays_in_memory():
    """A pickle of a simulation that holds one, such as a log's checkpoint, holds no threads."""
    simulation = sheet()
    simulation.apply([SaveState()])
    other = pickle.loads(pickle.dumps(simulation.saved))
    with pytest.raises(InputError, match='in the memory of another process'):
        simulation.restore(other)
    simulation.saved = other
    assert simulation.step([LoadState()]).refused[0][1] == 'no state has been saved'


@pytest.mark.parametrize('integrator', ['backward_euler', 'bdf2'])
def test_a_state_that_is_set_is_at_rest_and_pinned_particles_stay(integrator):
    simulation = sheet(integrator=integrator, gravity=(0.0, 0.0, 0.0))
    run(simulation, 5, [MovePin('a', Pose((0.0, 0.0, 0.1)))])
    rest = simulate((5, 4)).frame().x
    frame = simulation.step([SetState('c', flat(rest + [0.0, 0.0, 0.1]))])
    assert frame.x == pytest.approx(rest + [0.0, 0.0, 0.1], abs=1e-12)
    assert np.abs(frame.v).max() < 1e-9
    high = flat(rest + [0.0, 0.0, 0.6])
    assert simulation.apply([SetState('c', high)]) == []
    x = simulation.frame().x
    assert x[0] == pytest.approx([0.0, 0.0, 0.1]), 'held by the pin'
    assert (x[1:, 2] == 0.6).all()
    assert simulation.pending
    assert simulation.step().applied == (SetState('c', high),)
    assert not simulation.pending


def test_a_state_is_set_to_the_positions_of_a_frame_as_they_are():
    simulation, other = sheet(), sheet()
    x = simulation.frame().x + [0.0, 0.0, 0.25]
    for positions in (x, x.tolist(), tuple(map(tuple, x))):
        assert simulation.apply([SetState('c', positions)]) == []
        other.apply([SetState('c', flat(x))])
        assert simulation.hash() == other.hash()
        assert simulation.step().applied == (SetState('c', flat(x)),)
        other.step()


def test_states_that_fit_no_cloth_are_refused():
    simulation = sheet()
    before = simulation.hash()
    for command, text in [
            (SetState('d', (0.0,) * 60), "unknown cloth 'd' (known: c)"),
            (SetState('c', (0.0,) * 57), '19 positions, and c has 20 particles'),
            (SetState('c', (0.0,) * 58), 'positions must be x, y, z of each particle'),
            (SetState('c', (1.0, 2.0)), 'positions must be x, y, z of each particle'),
            (SetState('c', np.zeros((3, 20))), 'of shape (particles, 3) or flat (got (3, 20))'),
            (SetState('c', [[0.0, 0.0, 0.0], [0.0]]), 'a value is not a number'),
            (SetState('c', (float('nan'),) * 60), 'further than 1e+06 m away, or not finite'),
            (Click((0.0, float('inf'), 0.0)), 'is not finite'),
            (Click((0.0, 0.0)), 'must be 3 numbers')]:
        (_, reason), = simulation.apply([command])
        assert text in reason
        assert len(reason) < 300
    assert simulation.hash() == before
    assert not simulation.pending


@pytest.mark.parametrize('integrator', ['ndf2', slow('bdf2'), slow('backward_euler')])
def test_pins_and_colliders_bear_all_cloths_where_the_state_of_one_is_set(integrator):
    """Σ F dt = Σ m (g dt - Δv) of each cloth, to rounding."""
    simulation = compile_scene(scene_from_mapping({
        'solver': {'method': 'line', 'integrator': integrator, 'substeps': 5},
        'cloths': {name: {'grid': {'size': [1.0, 0.8], 'resolution': [5, 4]}, 'density': 1.0,
                          'pose': {'position': [x, 0.0, 0.0]}, 'effects': FALLING}
                   for name, x in (('a', 0.0), ('b', 3.0))},
        'pins': {name: {'cloth': name, 'at': 'corner_00'} for name in 'ab'},
        'colliders': {name: {'sphere': {'radius': 0.3}, 'position': [x, 0.4, -0.4]}
                      for name, x in (('a', 0.5), ('b', 3.5))},
        'effects': {'pin': {}, 'contact': {'thickness': 0.005}}},
        where='small.yaml', name='small'))
    before = run(simulation, 30)
    fall, dt = np.array([0.0, 0.0, -GRAVITY]), simulation.frame_dt
    for k in range(6):
        b = simulation.cloths[1].particles
        frame = simulation.step([SetState('b', flat(before.x[b]))] if k == 0 else ())
        for cloth in simulation.cloths:
            mass, these = simulation.state.mass[cloth.slots], cloth.particles
            start = mass @ before.v[these] * (k > 0 or cloth.name == 'a')    # or it is at rest
            force = frame.pins[cloth.name].force + frame.colliders[cloth.name].force
            assert np.linalg.norm(frame.colliders[cloth.name].force) > 0.1
            assert force * dt == pytest.approx(
                mass.sum() * fall * dt - (mass @ frame.v[these] - start), abs=1e-12)
        before = frame


def test_contacts_are_sought_again_where_a_state_puts_the_cloth():
    """The same states as of a simulation that begins there."""
    def lying(z):
        return with_effects(pins={}, pose={'position': [0.0, 0.0, z]})
    fallen, fresh = lying(0.5), lying(0.0)
    run(fallen, 20)
    x = fresh.frame().x
    expected = [fresh.step().x for _ in range(20)][-1]
    fallen.step([SetState('c', flat(x))])
    assert run(fallen, 19).x == pytest.approx(expected, abs=1e-12)


def test_a_click_pins_the_nearest_particle_and_another_releases_it():
    simulation = sheet()
    place = simulation.frame().x[7]
    (command, reason), = simulation.step([Click(tuple(place + [0.0, 0.0, 0.3]))]).refused
    assert isinstance(command, Click)
    assert reason.startswith('no particle within 0.05 m of [')
    assert '; the nearest is 0.3 m away' in reason
    place = simulation.frame().x[7]
    frame = simulation.step([Click(tuple(place + [0.01, 0.0, 0.02]))])
    assert frame.pins['clicked_0'].particles.tolist() == [7]
    assert frame.x[7] == pytest.approx(place), 'where it was, not at the click'
    frame = simulation.step([Click(tuple(frame.x[9]))])
    assert frame.refused[0][1] == 'all 2 pins are in use (effects.pin.max_pins)'
    frame = simulation.step([Click(tuple(place))])
    assert list(frame.pins) == ['a']
    assert list(simulation.step([Click(tuple(frame.x[0]))]).pins) == [], 'any pin'


def test_clicks_of_one_message_see_each_other():
    simulation = sheet(pins={})
    x = simulation.frame().x
    assert list(simulation.step([(Click(tuple(x[3])), Click(tuple(x[9])))]).pins) == [
        'clicked_0', 'clicked_1']
    frame = simulation.step([(Click(tuple(x[3])), Click(tuple(x[3])), Click(tuple(x[5])))])
    assert frame.refused[0][1] == ('all 2 pins are in use (effects.pin.max_pins); no command with '
                                   'it is applied')


def test_a_pin_of_the_scene_follows_its_target_while_it_is_open():
    simulation = sheet()
    pin = simulation.effects['pin']
    simulation.step([Release('a')])
    frame = simulation.step([MovePin('a', Pose((0.0, 0.0, 1.0)))])
    assert (frame.refused, list(frame.pins)) == ((), [])
    assert pin.pose('a').position == pytest.approx((0.0, 0.0, 5.0 / 60.0)), 'at its max_speed'
    run(simulation, 15)
    assert pin.pose('a').position == (0.0, 0.0, 1.0)
    place = tuple(simulation.frame().x[0].tolist())
    frame = simulation.step([Grasp('a', Pose(place), 0.01)])
    assert pin.pose('a').position == place
    assert list(frame.pins) == ['a']


def test_the_history_is_forgotten_where_particles_are_placed():
    simulation = sheet(integrator='bdf2')
    run(simulation, 4)
    fresh = simulation.state.history.fresh.copy()
    simulation.apply([SetState('c', flat(simulation.frame().x))])
    changed = simulation.state.history.fresh != fresh
    assert changed[simulation.slot].all(), "also the pinned one's, which is that of its force"
    assert len(history_arrays(simulation.state)) == 2
