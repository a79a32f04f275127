"""Pins: what they hold, where it goes, and the wrench on them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.meshes import file_of
from support.scenes import (
    DOWN,
    GRAVITY,
    hang,
    run,
    run_until_still,
    SETTINGS,
    simulate,
    with_effects,
)
from support.tiers import quick_only, slow
from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import (
    Grasp,
    MovePin,
    Pose,
    Release,
    ReleaseAll,
    Reset,
    SetKey,
    Twist,
)
from xpbd_ros.sim.measure import elastic_energy, momentum

STRETCH = {'stretch': {'compliance': 1e-4}}
SOME = ('gauss_seidel', 'backward_euler'), ('line', 'bdf2')
"""settings of the quick tier"""


def sheet(grid=(5, 4), **options):
    """Return a sheet of 0.4 m × 0.3 m in the plane z = 0 that can be pinned."""
    return simulate(grid, (0.4, 0.3), effects=STRETCH, scene_effects={
        'pin': {'max_pins': 3}, 'damping': {'rate': 0.0}}, **options)


def test_pins_of_the_scene_are_told_of_before_the_first_frame():
    simulation = sheet(pins={'hand': {'cloth': 'c', 'at': 'corner_00'}})
    pin = simulation.frame().pins['hand']
    assert pin.pose.position == tuple(simulation.frame().x[0])
    assert not np.any([pin.linear, pin.angular, pin.force, pin.torque])


def test_a_pin_that_turns_says_how_fast():
    simulation = sheet(pins={'hand': {'cloth': 'c', 'at': 'corner_00'}})
    turned = tuple(Rotation.from_rotvec([0.6, 0.0, 0.8]).as_quat())
    simulation.step([MovePin('hand', Pose(simulation.frame().pins['hand'].pose.position, turned))])
    before, after = (Rotation.from_quat(pin.pose.orientation) for pin in (
        simulation.frame().pins['hand'], simulation.step().pins['hand']))
    way = 60.0 * (after * before.inv()).as_rotvec()
    assert way[0] > 0.1
    np.testing.assert_allclose(simulation.frame().pins['hand'].angular, way, rtol=1e-6)


def held(simulation, frame, name='hand'):
    """Return the numbers of the particles that a pin holds, in natural order."""
    return np.sort(frame.pins[name].particles)


def test_a_grasp_holds_the_particles_within_its_radius_only():
    simulation = sheet()
    point = (0.1, 0.1, 0.0)
    frame = simulation.step([Grasp('hand', Pose(point), 0.11)])
    start = simulation.natural(simulation._start)
    near = np.linalg.norm(start - point, axis=1) <= 0.11
    assert near.sum() == 5
    np.testing.assert_array_equal(held(simulation, frame), np.flatnonzero(near))
    np.testing.assert_array_equal(frame.inv_mass == 0.0, near)
    np.testing.assert_allclose(frame.x[near], start[near], atol=1e-15)


def test_what_is_held_keeps_its_place_in_the_pins_axes():
    """Wherever the pin goes and however it turns: x = p + R q."""
    simulation = sheet(substeps=3)
    turn = Rotation.from_rotvec([0.1, 0.4, -0.2])
    grip = Pose((0.1, 0.1, 0.0), tuple(turn.as_quat()))
    start = simulation.frame().x
    frame = simulation.step([Grasp('hand', grip, 0.15)])
    taken = held(simulation, frame)
    offsets = turn.inv().apply(start[taken] - grip.position)
    goal = Rotation.from_rotvec([0.3, -0.5, 1.2])
    for k in range(40):
        frame = simulation.step([MovePin('hand', Pose((0.2, 0.0, 0.4), tuple(goal.as_quat())))]
                                if k == 0 else [])
        pose = frame.pins['hand'].pose
        np.testing.assert_allclose(
            frame.x[taken], Rotation(pose.orientation).apply(offsets) + pose.position, atol=1e-14)
    np.testing.assert_allclose(pose.position, (0.2, 0.0, 0.4), atol=1e-15)
    assert abs(np.dot(pose.orientation, goal.as_quat())) == pytest.approx(1.0, abs=1e-12)


def test_what_is_held_moves_evenly_through_the_substeps():
    """So it has a velocity, and what hangs on it is pulled, not thrown."""
    velocities = []
    for substeps in (1, 4):
        simulation = sheet(substeps=substeps)
        run(simulation, 2, [Grasp('hand', Pose(), 0.01)])
        frame = simulation.step([MovePin('hand', Pose((0.03, 0.0, 0.0)))])
        velocities.append(frame.v[0])
        assert frame.pins['hand'].linear == pytest.approx([1.8, 0.0, 0.0])
    np.testing.assert_allclose(velocities, [[1.8, 0.0, 0.0]] * 2, rtol=1e-12, atol=1e-15)


def test_a_release_gives_the_mass_back_and_the_motion_goes_on():
    simulation = simulate((1, 1), density=3.0, substeps=5, rate=50, effects=STRETCH,
                          scene_effects={'pin': {}, 'damping': {'rate': 0.0}})
    weight = simulation.frame().inv_mass
    simulation.step([Grasp('hand', Pose(), 0.01)])
    for k in range(1, 10):
        frame = simulation.step([MovePin('hand', Pose((0.02 * k, 0.0, 0.01 * k)))])
    assert frame.inv_mass[0] == 0.0
    before, here = frame.v[0].copy(), frame.x[0].copy()
    frame = simulation.step([Release('hand')])
    np.testing.assert_array_equal(frame.inv_mass, weight)
    assert dict(frame.pins) == {}
    h = simulation.frame_dt / 5
    fallen = np.array([0.0, 0.0, -GRAVITY * h * 5])
    np.testing.assert_allclose(before, [1.0, 0.0, 0.5], rtol=1e-10)
    np.testing.assert_allclose(frame.v[0], before + fallen, rtol=1e-10)
    np.testing.assert_allclose(frame.x[0], here + before * 5 * h + fallen * 3 * h, rtol=1e-10)


@pytest.mark.parametrize('integrator', [slow('backward_euler'), 'bdf2'])
def test_what_is_let_go_at_rest_starts_from_rest(integrator):
    """Not with what BDF2 would make of the pin's sudden stop."""
    simulation = simulate((1, 1), rate=50, effects=STRETCH, method='line', integrator=integrator,
                          scene_effects={'pin': {}, 'damping': {'rate': 0.0}}, gravity=(0, 0, 0))
    simulation.step([Grasp('hand', Pose(), 0.01)])
    for k in range(1, 6):
        simulation.step([MovePin('hand', Pose((0.02 * k, 0.0, 0.0)))])
    frame = simulation.step()
    np.testing.assert_array_equal(frame.v[0], 0.0)
    here = frame.x[0]
    frame = run(simulation, 2, [Release('hand')])
    np.testing.assert_array_equal(frame.x[0], here)


def test_a_pin_on_and_off_every_frame_stays_finite():
    """H14."""
    simulation = sheet(substeps=2)
    for k in range(100):
        frame = simulation.step([Grasp('hand', Pose(tuple(simulation.frame().x[0])), 0.15)]
                                if k % 2 == 0 else [Release('hand')])
        assert frame.refused == ()
        assert np.isfinite(frame.x).all()
    assert np.abs(frame.v).max() < 20.0


def test_an_empty_grasp_reports_the_distance_to_free_particles():
    simulation = sheet()
    simulation.step([Grasp('a', Pose(), 0.11)])
    frame = simulation.step([Grasp('b', Pose(), 0.15)])
    a, b = (set(held(simulation, frame, name).tolist()) for name in 'ab')
    assert a == {0, 1, 5}
    assert b == {6}
    frame = simulation.step([Grasp('c', Pose((0.0, 0.0, 1.0)), 0.2)])
    gap = np.linalg.norm(frame.x - [0, 0, 1.0], axis=1)[frame.inv_mass > 0.0].min()
    (_, reason), = frame.refused
    start, distance = reason.split('the nearest is ')
    assert start == "pin 'c': no free particle within 0.2 m of [0.0, 0.0, 1.0]; "
    assert float(distance.split()[0]) == pytest.approx(gap, rel=1e-2)
    simulation.step([Release('b'), Grasp('b', Pose(), 10.0)])
    (_, reason), = simulation.step([Grasp('c', Pose(), 0.2)]).refused
    assert reason == "pin 'c': no particle is free; pins hold all of them"


def test_beyond_the_capacity_a_grasp_is_refused_with_the_number():
    simulation = sheet()
    corners = [(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (0.0, 0.3, 0.0), (0.4, 0.3, 0.0)]
    grasps = [Grasp(name, Pose(corner), 0.01) for name, corner in zip('abcd', corners)]
    frame = simulation.step(grasps)
    assert frame.refused == ((grasps[3], 'all 3 pins are in use (effects.pin.max_pins)'),)
    frame = simulation.step([Release('b'), grasps[3]])
    assert frame.refused == ()
    assert list(frame.pins) == ['a', 'c', 'd']
    for name, corner in (('a', 0), ('c', 15), ('d', 19)):
        np.testing.assert_array_equal(held(simulation, frame, name), [corner])
    assert dict(simulation.step([ReleaseAll()]).pins) == {}
    assert (simulation.frame().inv_mass > 0.0).all()


def test_a_lifetime_ends_by_itself_unless_renewed():
    simulation = sheet()
    grasp = Grasp('hand', Pose(), 0.01, lifetime_ns=100_000_000)
    simulation.step([grasp])
    for frame in range(2, 7):
        held = simulation.step()
        assert ('hand' in held.pins, held.news) == (True, ()), frame
    frame = simulation.step()
    assert 'hand' not in frame.pins
    assert frame.news == ("pin 'hand' released: no command within its lifetime of 0.1 s",)
    assert simulation.step().news == ()
    assert simulation.state.inv_mass[0] > 0.0
    start = simulation.frame().x[0]
    grasp = Grasp('hand', Pose(tuple(start)), 0.01, lifetime_ns=100_000_000)
    for _ in range(20):
        frame = simulation.step([grasp])
        assert 'hand' in frame.pins
    np.testing.assert_allclose(frame.x[0], start, atol=1e-15)


def test_a_target_renews_a_lifetime_too():
    simulation = sheet()
    simulation.step([Grasp('hand', Pose(), 0.01, lifetime_ns=100_000_000)])
    for _ in range(20):
        assert 'hand' in simulation.step([MovePin('hand', Pose())]).pins
    for _ in range(5):
        assert 'hand' in simulation.step().pins
    assert 'hand' not in simulation.step().pins


def test_commands_of_one_message_act_together_or_not_at_all():
    """Whatever they would do to one another: what is let go may be grasped, but not twice."""
    simulation = sheet()
    corners = [tuple(simulation.frame().x[i].tolist()) for i in (0, 4, 15, 19)]
    a, b, c, d = (Grasp(name, Pose(corner), 0.01) for name, corner in zip('abcd', corners))
    again = Grasp('e', Pose(corners[0]), 0.01)
    up = MovePin('a', Pose((0.0, 0.0, 0.05)))
    frame = simulation.step([(a, b, c, d)])
    assert frame.refused == ((a, 'all 3 pins are in use (effects.pin.max_pins); no command with '
                                 'it is applied'),)
    assert (dict(frame.pins), frame.applied) == ({}, ())
    assert (frame.inv_mass > 0.0).all()
    assert simulation.step([(a, again)]).pins == {}
    frame = simulation.step([(a, Release('a'), again, b)])
    assert (list(frame.pins), frame.refused) == (['e', 'b'], ())
    frame = simulation.step([(ReleaseAll(), a), (up, MovePin('missing', Pose()))])
    assert frame.refused == ((up, "pin 'missing' holds nothing (holding: a); no command with it "
                                  'is applied'),)
    assert frame.pins['a'].pose.position == corners[0], 'it was not moved'
    assert simulation.step([(up, Release('a'), ReleaseAll())]).refused == ()


def test_commands_of_the_whole_simulation_go_alone():
    """Not with some of what they are sent with done, and all of it told as done."""
    simulation, grasp, key = sheet(), Grasp('a', Pose(), 0.01), SetKey('gravity', [0.0, 0.0, 0.0])
    for group in ((key, grasp), (grasp, key), (Reset(), MovePin('missing', Pose()))):
        name = 'Reset' if Reset() in group else 'SetKey'
        frame = simulation.step([group])
        assert frame.refused == ((group[0], f'{name}: goes alone, not in a tuple; no command '
                                            'in it is applied'),)
        assert (frame.applied, dict(frame.pins)) == ((), {})
    assert simulation.state.gravity[2] == -GRAVITY
    assert simulation.step([(key,)]).applied == (key,)


def test_jitter_of_target_arrival_does_not_shake_the_pin_force():
    """30 Hz, 10 ms more or less: the force on the pin is as smooth as with targets in time."""
    def forces(uneven):
        simulation = sheet(pins={'hand': {'cloth': 'c', 'at': 'edge_0x'}})
        start = np.array(simulation.frame().pins['hand'].pose.position)
        late = np.random.default_rng(3).uniform(0.0, uneven, 40)
        waiting = [(k / 30.0 + late[k], k / 30.0) for k in range(40)]
        found = []
        for frame in range(110):
            asked = []
            while waiting and waiting[0][0] <= frame / 60.0 + 1e-6:
                t = waiting.pop(0)[1]
                height = 0.05 * (1.0 - np.cos(np.pi * min(t, 1.0)))
                asked.append(MovePin('hand', Pose((*start[:2], float(start[2] + height))), None,
                                     10**9 + round(t * 1e9)))
            found.append(simulation.step(asked).pins['hand'].force)
        return np.array(found)
    even, uneven = forces(0.0), forces(0.02)
    jumps = [np.abs(np.diff(found[30:, 2])).max() for found in (even, uneven)]
    assert jumps[1] <= 1.2 * jumps[0]


def test_a_grasp_of_a_pin_that_holds_moves_it():
    simulation = sheet()
    simulation.step([Grasp('hand', Pose(), 0.01)])
    frame = run(simulation, 10, [Grasp('hand', Pose((0.0, 0.0, 0.02)), 5.0)])
    np.testing.assert_array_equal(held(simulation, frame), [0])
    np.testing.assert_allclose(frame.x[0], [0.0, 0.0, 0.02], atol=1e-15)


@pytest.mark.parametrize('command', [Release('x'), MovePin('x', Pose())])
def test_a_pin_that_holds_nothing_is_refused_with_those_that_do(command):
    simulation = sheet()
    assert simulation.step([command]).refused == ((command, "pin 'x' holds nothing (holding: "
                                                   'none)'),)
    simulation.step([Grasp('hand', Pose(), 0.01)])
    assert simulation.step([command]).refused == ((command, "pin 'x' holds nothing (holding: "
                                                   'hand)'),)


@pytest.mark.parametrize('method, integrator', quick_only(
    SETTINGS[:-1], SOME[0], ('line', 'ndf2')))    # explicit needs more substeps
@pytest.mark.parametrize('substeps, iterations', [(1, 1), (6, 3)])
def test_the_wrench_at_rest_is_the_weight(substeps, iterations, method, integrator):
    """Exactly so at any setting: what falls short of stiffness still pulls with its weight."""
    simulation = hang(8, damping=20.0, effects={'stretch': {'compliance': 1e-3}}, density=0.7,
                      substeps=substeps, iterations=iterations, method=method,
                      integrator=integrator)
    state = run_until_still(simulation, speed=1e-10).pins['top']
    weight = 0.7 * GRAVITY
    np.testing.assert_allclose(state.force, [0.0, 0.0, -weight], atol=1e-6 * weight)
    np.testing.assert_allclose(state.torque, 0.0, atol=1e-6 * weight)


def test_the_torque_is_about_the_pose():
    """Two particles held 0.4 m apart, from poses with known arms."""
    for where in ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.3, -0.5, 0.7)):
        simulation = simulate((2, 1), (0.4, 1.0), effects=STRETCH, density=2.5, scene_effects={
            'pin': {}, 'damping': {'rate': 0.0}})
        frame = run(simulation, 3, [Grasp('hand', Pose(where), 5.0)])
        half = 0.5 * np.array([0.0, 0.0, -0.4 * 2.5 * GRAVITY])
        expected = sum(np.cross(np.subtract(x, where), half) for x in ([0, 0, 0], [0.4, 0, 0]))
        np.testing.assert_allclose(frame.pins['hand'].force, 2.0 * half, atol=1e-12)
        np.testing.assert_allclose(frame.pins['hand'].torque, expected, atol=1e-12)


def test_two_pins_share_the_weight_and_their_torques_balance_it():
    simulation = simulate(
        (9, 3), (1.0, 0.2), effects={'stretch': {'compliance': 1e-4}}, density=0.5, substeps=100,
        iterations=3, scene_effects={'damping': {'rate': 15.0}},
        pins={'a': {'cloth': 'c', 'at': 'edge_x0', 'target': [0.2, 0.1, 0.0]},
              'b': {'cloth': 'c', 'at': 'edge_x1'}})
    frame = run_until_still(simulation, speed=1e-9)
    a, b = frame.pins['a'], frame.pins['b']
    weight = 0.5 * 0.2 * GRAVITY
    np.testing.assert_allclose(a.force + b.force, [0.0, 0.0, -weight], atol=1e-6 * weight)
    np.testing.assert_allclose(a.force[2], b.force[2], rtol=1e-3)
    assert a.force[0] > 0.1 * weight    # each is pulled towards the other


@pytest.mark.parametrize('substeps', [1, 5])
def test_a_pin_that_accelerates_feels_m_g_minus_a(substeps):
    """Each pin with the acceleration of what it holds itself."""
    simulation = simulate((2, 1), density=3.0, effects={'stretch': {'compliance': 1e300}},
                          substeps=substeps, rate=50,
                          scene_effects={'pin': {}, 'damping': {'rate': 0.0}})
    simulation.step([Grasp('still', Pose(), 0.01), Grasp('hand', Pose((1.0, 0.0, 0.0)), 0.01)])
    place, speed = 1.0, 0.0
    acceleration, dt = 4.0, simulation.frame_dt
    for _ in range(10):
        speed += acceleration * dt
        place += speed * dt
        frame = simulation.step([MovePin('hand', Pose((place, 0.0, 0.0)))])
        np.testing.assert_allclose(frame.pins['hand'].force,
                                   [-1.5 * acceleration, 0.0, -1.5 * GRAVITY], rtol=1e-9)
        np.testing.assert_allclose(frame.pins['still'].force, [0.0, 0.0, -1.5 * GRAVITY],
                                   rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize('substeps, accuracy', [(25, 5e-3), (400, 2e-4)])
def test_the_wrench_is_the_rate_of_momentum_of_all_that_is_held(substeps, accuracy):
    """Newton's second law, in every frame of a violent swing: F = M g - dP/dt."""
    simulation = simulate(
        (5, 4), (0.4, 0.3), effects={'stretch': {'compliance': 1e-3}}, substeps=substeps,
        pose={'orientation': DOWN}, scene_effects={'damping': {'rate': 0.0}},
        pins={'a': {'cloth': 'c', 'at': 'edge_x0', 'motion': [
            [0.0, 0.0, 0.0, 0.0], [0.2, 0.3, 0.0, 0.1], [0.4, 0.0, 0.2, 0.0]]}})
    state = simulation.state
    before = np.zeros(3)
    for _ in range(30):
        frame = simulation.step()
        after = momentum(state)
        expected = state.mass.sum() * state.gravity - (after - before) / simulation.frame_dt
        error = np.linalg.norm(frame.pins['a'].force - expected)
        assert error < accuracy * np.linalg.norm(expected)
        before = after


def test_an_edge_between_two_pins_pulls_both_at_rest():
    """H10: stretched to three times its length."""
    simulation = simulate(
        (2, 1), effects={'stretch': {'compliance': 0.01}}, gravity=(0, 0, 0), density=0.001,
        scene_effects={'damping': {'rate': 0.0}},
        pins={'a': {'cloth': 'c', 'at': 'corner_00'},
              'b': {'cloth': 'c', 'at': 'corner_01', 'target': [3.0, 0.0, 0.0]}})
    frame = run(simulation, 60)
    np.testing.assert_allclose(frame.x, [[0, 0, 0], [3, 0, 0]], atol=1e-14)
    np.testing.assert_allclose(frame.pins['a'].force, [200.0, 0.0, 0.0], rtol=1e-12)
    np.testing.assert_allclose(frame.pins['b'].force, [-200.0, 0.0, 0.0], rtol=1e-12)


@pytest.mark.parametrize(('name', 'stiffness', 'mesh'), [
    ('bend', 1.0, False), slow('bend', 1.0, True), slow('hinge', 1.0, False),
    slow('area', 100.0, False)])
def test_pins_that_hold_all_of_an_element_feel_the_slope_of_its_energy(name, stiffness, mesh):
    """Nothing moves, and yet each constraint has the multiplier -C / α."""
    places = 0.1 * np.array([[i % 3, i // 3, 0] for i in range(6)])
    strip = file_of(places, [[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]])
    simulation = simulate(
        (3, 2), (0.2, 0.1), mesh=strip if mesh else False, gravity=(0, 0, 0),
        effects={name: {'stiffness': stiffness}}, scene_effects={'damping': {'rate': 0.0}},
        pins={'a': {'cloth': 'c', 'at': [0, 1, 3, 4]}, 'b': {'cloth': 'c', 'at': [2, 5]}})
    home = np.array(simulation.frame().pins['b'].pose.position)
    simulation.step([MovePin('b', Pose(tuple(home + [0.02, 0.01, 0.05])))])
    frame = run(simulation, 20)
    constraints, held = simulation.effects[name].constraints, simulation.slot[[2, 5]]
    slope = np.zeros(3)
    for axis in range(3):
        for step in (1e-6, -1e-6):
            moved = simulation.state.x.copy()
            moved[axis, held] += step
            slope[axis] += constraints.energy(moved) / (2.0 * step)
    assert np.linalg.norm(slope) > 0.5
    np.testing.assert_allclose(frame.pins['b'].force, -slope, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize('square', [False, True])
def test_pins_that_hold_all_of_a_cloth_feel_the_slope_of_its_energy(square):
    """Of stretch, shear and bending together, on square cells and on oblong ones."""
    simulation = with_effects((4, 3), size=(0.3, 0.2 if square else 0.3), gravity=(0, 0, 0), pins={
        'a': {'cloth': 'c', 'at': list(range(8))}, 'b': {'cloth': 'c', 'at': 'edge_1x'}},
        colliders={})
    home = np.array(simulation.frame().pins['b'].pose.position)
    simulation.step([MovePin('b', Pose(tuple(home + [0.02, 0.01, 0.05])))])
    frame, held = run(simulation, 20), simulation.slot[8:]
    x = simulation.state.x
    slope = np.zeros(3)
    for axis in range(3):
        for step in (1e-6, -1e-6):
            x[axis, held] += step
            slope[axis] += elastic_energy(simulation) / (2.0 * step)
            x[axis, held] -= step
    assert np.linalg.norm(slope) > 0.5
    np.testing.assert_allclose(frame.pins['b'].force, -slope, rtol=1e-5, atol=1e-6)


def test_a_target_10_m_away_is_reached_late_and_reported():
    """H13."""
    simulation = sheet(substeps=20)
    simulation.step([Grasp('hand', Pose(), 0.01)])
    simulation.step([MovePin('hand', Pose((10.0, 0.0, 0.0)))])
    for _ in range(118):
        frame = simulation.step()
        assert frame.pins['hand'].limited
        assert simulation.stats()['pins_at_max_speed'] == 1
        assert np.linalg.norm(frame.v, axis=1).max() <= 2.0 * 5.0 + GRAVITY * 2.0
    frame = run(simulation, 3)
    assert not frame.pins['hand'].limited
    np.testing.assert_array_equal(frame.x[0], [10.0, 0.0, 0.0])


def test_a_twist_sets_the_pace():
    simulation = sheet()
    simulation.step([Grasp('hand', Pose(), 0.01)])
    frame = simulation.step([MovePin('hand', Pose((0.1, 0, 0)), Twist((0.3, 0.0, 0.0)))])
    np.testing.assert_allclose(frame.v[0], [0.3, 0.0, 0.0], rtol=1e-9)


@pytest.mark.parametrize('at, expected', [
    ('corner_00', [0]), ('corner_01', [4]), ('corner_10', [15]), ('corner_11', [19]),
    ('edge_0x', [0, 1, 2, 3, 4]), ('edge_1x', [15, 16, 17, 18, 19]), ('edge_x0', [0, 5, 10, 15]),
    ('edge_x1', [4, 9, 14, 19]), ([7, 2, 7], [2, 7])])
def test_places_mean_rows_and_columns(at, expected):
    simulation = sheet(pins={'a': {'cloth': 'c', 'at': at}})
    frame = run(simulation, 3)
    start = simulation.natural(simulation._start)
    np.testing.assert_array_equal(held(simulation, frame, 'a'), expected)
    np.testing.assert_allclose(frame.x[expected], start[expected], atol=1e-15)
    np.testing.assert_allclose(frame.pins['a'].pose.position,
                               start[expected].mean(0), atol=1e-15)


def test_near_and_motion_from_the_scene():
    simulation = sheet(pins={'a': {'cloth': 'c', 'near': [0.4, 0.3, 0.0], 'radius': 0.11,
                                   'motion': [[0.0, 0.4, 0.3, 0.0], [1.0, 0.4, 0.3, 0.5]]}})
    frame = run(simulation, 30)
    np.testing.assert_array_equal(held(simulation, frame, 'a'), [14, 18, 19])
    np.testing.assert_allclose(frame.x[19], [0.4, 0.3, 0.25], atol=1e-9)


def test_pins_of_the_scene_share_no_particle():
    """The first takes it; else a release of one would let go what the other holds."""
    simulation = sheet(pins={'a': {'cloth': 'c', 'at': 'edge_0x'},
                             'b': {'cloth': 'c', 'at': 'edge_x0'}})
    frame = simulation.step()
    np.testing.assert_array_equal(held(simulation, frame, 'a'), [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(held(simulation, frame, 'b'), [5, 10, 15])
    frame = simulation.step([Release('b')])
    np.testing.assert_array_equal(np.flatnonzero(frame.inv_mass == 0.0), [0, 1, 2, 3, 4])


@pytest.mark.parametrize('pins, text', [
    ({'a': {'cloth': 'd', 'at': 'corner_00'}}, "pins.a.cloth: unknown cloth 'd' (known: c)"),
    ({'a': {'cloth': 'c', 'at': 'corner_02'}},
     "pins.a: at: unknown place 'corner_02' (known: corner_00, corner_01, corner_10, corner_11, "
     'edge_0x, edge_1x, edge_x0, edge_x1, or a list of particle indices)'),
    ({'a': {'cloth': 'c', 'at': [20]}},
     'pins.a.at: indices must be from 0 to 19 (got [20])'),
    ({'a': {'cloth': 'c', 'at': [-1, 3]}},
     'pins.a.at: indices must be from 0 to 19 (got [-1, 3])'),
    ({'a': {'cloth': 'c', 'at': []}}, 'pins.a: at: must name at least one particle'),
    ({'a': {'cloth': 'c'}}, "pins.a: needs either 'at' or 'near', and only one of them"),
    ({'a': {'cloth': 'c', 'at': 'corner_00', 'near': [0, 0, 0]}},
     "pins.a: needs either 'at' or 'near', and only one of them"),
    ({'a': {'cloth': 'c', 'near': [9, 0, 0], 'radius': 0.1}},
     'pins.a: no particle within 0.1 m of [9.0, 0.0, 0.0]; the nearest is 8.6 m away'),
    ({'a': {'cloth': 'c', 'at': 'corner_00', 'target': [0, 0, 0], 'motion': [[0, 0, 0, 0]]}},
     "pins.a: needs either 'target' or 'motion', not both"),
    ({'a': {'cloth': 'c', 'at': 'corner_00', 'motion': [[1, 0, 0, 0], [0, 0, 0, 0]]}},
     'pins.a: motion: times must rise (got [1.0, 0.0])'),
    ({'a': {'cloth': 'c', 'at': 'corner_00'}, 'b': {'cloth': 'c', 'at': [0]}},
     'pins.b: other pins hold all that it names'),
    ({name: {'cloth': 'c', 'at': 'corner_00'} for name in 'abcd'},
     'pins: 4 pins, but effects.pin.max_pins is 3; raise it')])
def test_a_pin_without_sense_is_refused(pins, text):
    with pytest.raises(InputError) as error:
        sheet(pins=pins)
    assert str(error.value) == f'small.yaml: {text}'


COMPLIANCE = 0.01
SPRUNG = pytest.mark.parametrize('method, integrator', quick_only(SETTINGS, *SOME))


def on_spring(*, at='corner_00', slip=None, **options):
    """Return a strip of 6.9 N that hangs from a pin that gives way, and may slip."""
    slip = {} if slip is None else {'slip': slip}
    return simulate((6, 1), (1.0, 1.0), pose={'orientation': DOWN}, density=0.7, effects={
        'stretch': {'warp': 500.0, 'weft': 500.0}}, pins={'top': {
            'cloth': 'c', 'at': at, 'compliance': COMPLIANCE, **slip}},
        scene_effects={'damping': {'rate': 20.0}}, **options)


@SPRUNG
def test_a_pin_gives_way_by_its_compliance_for_each_newton(method, integrator):
    """Exactly so at any setting: m g α; and the wrench is the weight, the particle's own in it."""
    simulation = on_spring(method=method, integrator=integrator,
                           substeps=20 if method == 'explicit' else 2)
    frame = run(simulation, 900)
    weight = 0.7 * GRAVITY
    assert frame.x[0, 2] == pytest.approx(-weight * COMPLIANCE, rel=1e-7)
    np.testing.assert_allclose(frame.pins['top'].force, [0.0, 0.0, -weight], atol=1e-7 * weight)
    assert frame.inv_mass.min() > 0.0


def test_what_a_pin_holds_together_gives_way_together():
    """Six particles share the weight, unevenly; the pin as a whole gives way by m g α."""
    simulation = on_spring(at=list(range(6)))
    frame = run_until_still(simulation, speed=1e-10)
    start = simulation.natural(simulation._start)
    lowered = simulation.state.mass[simulation.slot] @ (frame.x - start)[:, 2] / 0.7
    assert (frame.x - start)[:, 2].mean() == pytest.approx(-0.7 * GRAVITY * COMPLIANCE, rel=1e-7)
    assert lowered < 0.0
    assert frame.pins['top'].force[2] == pytest.approx(-0.7 * GRAVITY, rel=1e-7)
    simulation.step([Release('top')])
    assert run(simulation, 5).x[0, 2] < frame.x[0, 2] - 0.01


def lifted(slip, rise=4.0, mass=0.35):
    """Yield frames of a particle that a pin lifts faster and faster, from the frame 20 on."""
    simulation = simulate((1, 1), density=mass, effects=STRETCH, scene_effects={
        'pin': {'slip': slip}, 'damping': {'rate': 0.0}})
    frame = simulation.step([Grasp('hand', Pose(), 0.01)])
    for k in range(2, 40):
        yield simulation, frame
        t = simulation.frame_dt * max(0, k - 20)
        frame = simulation.step([MovePin('hand', Pose((0.0, 0.0, 0.5 * rise * t * t)))]
                                if 'hand' in simulation.effects['pin'].held else [])


def test_a_pin_slips_where_the_cloth_pulls_harder_and_not_below():
    """F = m (g + a); it is said once, with the force."""
    force = 0.35 * (GRAVITY + 4.0)
    assert not any(frame.news for _, frame in lifted(1.001 * force))
    frames = [(simulation, frame) for simulation, frame in lifted(0.999 * force)]
    simulation = frames[-1][0]
    (k,) = [k for k, (_, frame) in enumerate(frames) if frame.news]
    assert 19 <= k <= 22
    assert frames[k][1].news == (f"pin 'hand' slipped: the cloth pulled with {force:.3g} N, and "
                                 f'it holds {0.999 * force:g} N',)
    assert frames[k][1].pins['hand'].force[2] == pytest.approx(-force, rel=1e-6)
    assert frames[k][1].inv_mass[0] > 0.0
    assert all(dict(frame.pins) == {} for _, frame in frames[k + 1:])
    assert simulation.stats()['pins_slipped'] == 1


@pytest.mark.parametrize('share, slips', [(1.001, 0), (0.999, 1)])
def test_a_pin_on_a_spring_slips_at_the_same_force(share, slips):
    """Damped, so that the force rises to the weight and no further."""
    simulation = simulate((1, 1), density=0.35, effects=STRETCH, pins={'a': {
        'cloth': 'c', 'at': 'corner_00', 'compliance': COMPLIANCE,
        'slip': share * 0.35 * GRAVITY}}, scene_effects={'damping': {'rate': 100.0}})
    run(simulation, 400)
    assert simulation.stats()['pins_slipped'] == slips


def test_pins_of_a_scene_say_for_themselves_what_they_hold():
    """Weight 6.9 N: one slips, and then the other; alike in every run, and anew after a reset."""
    runs = []
    for _ in range(2):
        simulation = simulate((2, 1), density=0.7, effects=STRETCH, pins={
            'a': {'cloth': 'c', 'at': 'corner_00', 'slip': 3.0},
            'b': {'cloth': 'c', 'at': 'corner_01', 'compliance': 1e-4}},
            scene_effects={'pin': {'slip': 5.0}, 'damping': {'rate': 0.0}}, substeps=20)
        runs.append([(frame.news, simulation.hash()) for frame in (
            simulation.step() for _ in range(40))])
        assert simulation.stats()['pins_slipped'] == 2
    assert runs[0] == runs[1]
    said = [text.split(':')[0] for news, _ in runs[0] for text in news]
    assert said == ["pin 'a' slipped", "pin 'b' slipped"]
    frame = simulation.step([Reset()])
    assert set(frame.pins) == {'a', 'b'}
    assert simulation.stats()['pins_slipped'] <= 1


def test_a_scene_without_them_has_no_springs():
    simulation = sheet()
    assert [type(data).__name__ for data in simulation.effects['pin'].parts] == ['Pin']


def test_what_a_spring_holds_is_not_grasped_twice():
    simulation = on_spring()
    frame = simulation.step([Grasp('hand', Pose(), 0.01)])
    assert len(frame.refused) == 1
    simulation.step([Release('top')])
    assert simulation.step([Grasp('hand', Pose(tuple(simulation.frame().x[0])), 0.01)
                            ]).refused == ()


def test_a_compliance_scale_is_one_of_pins_too():
    simulation = on_spring(scale=2.0)
    assert run_until_still(simulation, speed=1e-10).x[0, 2] == pytest.approx(
        -0.7 * GRAVITY * 2.0 * COMPLIANCE, rel=1e-7)
    assert simulation.step([SetKey('solver.compliance_scale', 1.0)]).refused == ()
    assert run_until_still(simulation, speed=1e-10).x[0, 2] == pytest.approx(
        -0.7 * GRAVITY * COMPLIANCE, rel=1e-7)
