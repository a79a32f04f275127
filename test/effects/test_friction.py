"""Coulomb's law, step by step."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.scenes import GRAVITY, run, run_stage, simulate, with_effects
from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import MoveCollider, Pose, SetKey, Twist
from xpbd_ros.sim.particles.state import Substep
from xpbd_ros.sim.stepping import stages

MU, R = 0.4, 0.01


def on_a_plane(degrees=0.0, *, mu=MU, pairs=None, **options):
    """Return a particle that lies on a plane with a slope down along +x."""
    angle = np.radians(degrees)
    normal = np.array([np.sin(angle), 0.0, np.cos(angle)])
    return simulate((1, 1), friction=mu, pose={'position': (R * normal).tolist()}, colliders={
        'table': {'plane': {'normal': normal.tolist()}, 'friction': mu}}, scene_effects={
            'pin': {}, 'contact': {'thickness': R},
            'friction': {'pairs': pairs} if pairs else {}}, **options)


@pytest.mark.parametrize('substeps, iterations', [(1, 1), (4, 1), (3, 5)])
def test_it_sticks_below_the_angle_of_friction_and_slides_above(substeps, iterations):
    """V14: atan 0.4 = 21.80°; it does not creep."""
    for degrees, sticks in ((10.0, True), (21.7, True), (21.9, False)):
        simulation = on_a_plane(degrees, substeps=substeps, iterations=iterations)
        start = simulation.state.x[:, 0].copy()
        moved = np.linalg.norm(run(simulation, 120).x[0] - start)
        if sticks:
            assert moved < 1e-12
        else:
            assert moved > 0.02


@pytest.mark.parametrize('degrees', [21.9, 30.0, 60.0])
@pytest.mark.parametrize('substeps', [1, 4])
def test_it_slides_with_g_sin_minus_mu_cos(degrees, substeps):
    """V14, exactly in every step."""
    simulation = on_a_plane(degrees, substeps=substeps)
    angle = np.radians(degrees)
    downhill = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    expected = GRAVITY * (np.sin(angle) - MU * np.cos(angle))
    for k in range(1, 61):
        v = simulation.step().v[0]
        assert v @ downhill == pytest.approx(expected * k / 60, rel=1e-6, abs=1e-9)
        assert np.linalg.norm(v - (v @ downhill) * downhill) < 1e-9


def test_sliding_stops_after_v2_over_2_mu_g_to_first_order():
    """V15: short by v h / 2."""
    speed = 2.0
    exact = speed**2 / (2.0 * MU * GRAVITY)
    for substeps in (1, 2, 4, 8):
        simulation = on_a_plane(substeps=substeps)
        simulation.state.v[:, 0] = (speed, 0.0, 0.0)
        frame = run(simulation, 60)
        h = simulation.frame_dt / substeps
        assert frame.x[0, 0] - exact == pytest.approx(-0.5 * speed * h, rel=0.1)
        np.testing.assert_allclose(frame.v, 0.0, atol=1e-9)


def test_it_acts_against_the_motion_in_any_direction():
    simulation = on_a_plane(substeps=3)
    simulation.state.v[:, 0] = (-1.2, 1.6, 0.0)
    np.testing.assert_allclose(simulation.step().v[0], (1.0 - MU * GRAVITY / 60 / 2.0)
                               * np.array([-1.2, 1.6, 0.0]), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize('mu', [0.0, 100.0])
def test_the_extremes_of_the_coefficient(mu):
    """H29: none, and far beyond what sticking needs."""
    simulation = on_a_plane(mu=mu, substeps=2)
    simulation.state.v[:, 0] = (1.0, 0.0, 0.0)
    frame = run(simulation, 30)
    assert frame.x[0, 0] == pytest.approx(0.5 if mu == 0.0 else 0.0, abs=1e-9)


def test_a_pair_has_the_geometric_mean_unless_it_has_its_own():
    simulation = simulate(
        (1, 1), friction=0.9, pose={'position': [0.0, 0.0, R]}, colliders={
            'a': {'plane': {}, 'friction': 0.4}, 'b': {'plane': {}, 'friction': 0.0}},
        scene_effects={'pin': {}, 'contact': {'thickness': R},
                       'friction': {'pairs': {'c': {'b': 0.7}}}})
    simulation.step()
    np.testing.assert_allclose(simulation.effects['friction'].data.coefficient[0, :3],
                               [0.6, 0.7, 0.0], rtol=1e-15)
    simulation = on_a_plane(30.0, mu=0.0, pairs={'c': {'table': 0.6}})
    assert np.linalg.norm(run(simulation, 60).v) < 1e-12    # tan 30° = 0.577


@pytest.mark.parametrize('pairs, text', [
    ({'d': {'table': 0.1}}, "effects.friction.pairs: unknown cloth ['d']"),
    ({'c': {'chair': 0.1}},
     "effects.friction.pairs.c: unknown collider ['chair'] (known: table)"),
    ({'c': {'table': -0.1}}, 'effects.friction.pairs.c.table: must be at least 0 (got -0.1)'),
    ({'c': {'table': {'friction': 0.3, 'static_friction': 0.2}}},
     'effects.friction.pairs.c.table: static_friction: must be at least friction (0.3) (got 0.2)'),
    ({'c': {'table': {'static_friction': 0.2}}},
     'effects.friction.pairs.c.table.friction: missing')])
def test_a_pair_of_strangers_is_refused(pairs, text):
    with pytest.raises(InputError) as error:
        on_a_plane(pairs=pairs)
    assert str(error.value) == f'small.yaml: {text}'


def test_a_conveyor_drags_what_lies_on_it_to_its_speed():
    """A collider at rest whose surface moves: with μ g until it keeps up, then not at all."""
    simulation = on_a_plane(substeps=4)
    frame = simulation.step([MoveCollider('table', Pose(), Twist((0.0, 0.5, 0.0)))])
    assert frame.v[0, 1] == pytest.approx(MU * GRAVITY / 60, rel=1e-9)
    frame = run(simulation, 30)
    np.testing.assert_allclose(frame.v[0], [0.0, 0.5, 0.0], atol=1e-9)
    np.testing.assert_allclose(frame.colliders['table'].linear, 0.0)


def test_a_ball_that_spins_drives_what_lies_on_it():
    """At its top the surface moves with ω × r, along (ω_y, -ω_x), faster than the particle."""
    simulation = simulate(
        (1, 1), friction=MU, pose={'position': [0.0, 0.0, 0.3 + R]}, substeps=4,
        colliders={'ball': {'sphere': {'radius': 0.3}, 'friction': MU}},
        scene_effects={'pin': {}, 'contact': {'thickness': R}, 'friction': {}})
    frame = simulation.step([MoveCollider('ball', Pose(), Twist((0, 0, 0), (3.0, 4.0, 0.0)))])
    np.testing.assert_allclose(frame.v[0], MU * GRAVITY / 60 * np.array([0.8, -0.6, 0.0]),
                               rtol=0.0, atol=1e-3)


def test_a_turntable_carries_what_lies_on_it_round():
    simulation = on_a_plane(substeps=8)
    simulation.state.x[:, 0] = (0.2, 0.0, R)
    frame = run(simulation, 60, [MoveCollider('table', Pose(), Twist((0, 0, 0), (0, 0, 1.0)))])
    x, y, _ = frame.x[0]
    assert np.arctan2(y, x) == pytest.approx(1.0, abs=0.03)    # it needs 0.05 s to keep up
    assert np.hypot(x, y) == pytest.approx(0.2, abs=0.002)
    assert np.linalg.norm(frame.v) == pytest.approx(0.2, rel=0.01)


@pytest.mark.parametrize('speed', [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0)])
def test_a_turning_surface_carries_particles_on_a_circle(speed):
    """
    At 3 rad/s for 2 s: on the circle about the axis where the surface is at rest.

    That is the table's position, or where its other velocity and the turn cancel.
    """
    simulation = on_a_plane(substeps=4)
    axis = np.array([0.0, speed[0] / 3.0])
    start = np.array([0.15, 0.1])
    simulation.state.x[:, 0] = (*start, R)
    simulation.state.v[:2, 0] = 3.0 * np.array([axis[1] - start[1], start[0] - axis[0]])
    table = MoveCollider('table', Pose(), Twist(speed, (0.0, 0.0, 3.0)))
    frame = run(simulation, 120, [table])
    radius = np.linalg.norm(start - axis)
    assert np.linalg.norm(frame.x[0, :2] - axis) == pytest.approx(radius, abs=5e-6)


def test_cloth_rides_on_a_moving_table_without_slipping():
    """With a large coefficient it keeps its place in the table's axes."""
    simulation = with_effects((5, 4), substeps=4, pins={}, colliders={
        't': {'box': {'size': [3.0, 3.0, 0.2]}, 'position': [0.5, 0.5, -0.105], 'friction': 1e4}})
    start = simulation.natural(simulation._start)
    run(simulation, 10)
    for k in range(60):
        turn = Rotation.from_rotvec([0.0, 0.0, 0.01 * k])
        frame = simulation.step([MoveCollider('t', Pose(
            (0.5 + 0.01 * k, 0.5, -0.105), tuple(turn.as_quat().tolist())))])
    pose = frame.colliders['t'].pose
    expected = Rotation(pose.orientation).apply(start - [0.5, 0.5, -0.105]) + pose.position
    np.testing.assert_allclose(frame.x, expected, rtol=0.0, atol=5e-5)
    assert pose.position[0] > 1.0


def test_a_push_that_is_taken_back_takes_its_friction_back():
    """In a later iteration, when another constraint has lifted the particle off."""
    simulation = on_a_plane()
    simulation.effects['friction'].begin(None, simulation.state)
    state, substep = simulation.state, Substep(0.01, 0.0, 1.0)
    contact, friction = (simulation.effects[name].data for name in ('contact', 'friction'))
    state.x[:, 0] = (0.05, 0.0, R - 0.02)
    run_stage(stages.prepare, contact, state, substep)
    run_stage(stages.project_inequalities, contact, state, substep)
    run_stage(stages.project_inequalities, friction, state, substep)
    np.testing.assert_allclose(state.x[:, 0], [0.05 - MU * 0.02, 0.0, R], rtol=1e-12)
    state.x[2, 0] += 0.1
    run_stage(stages.project_inequalities, contact, state, substep)
    run_stage(stages.project_inequalities, friction, state, substep)
    np.testing.assert_allclose(state.x[:, 0], [0.05, 0.0, R + 0.08], rtol=1e-12)


def test_what_only_undoes_an_old_overlap_presses_on_nothing():
    """Else a collider that was put into the cloth would brake it."""
    simulation = on_a_plane(gravity=(0, 0, 0))
    simulation.state.x[2, 0] = -0.1
    simulation.state.v[:, 0] = (0.3, 0.0, 0.0)
    np.testing.assert_allclose(run(simulation, 4).v[0], [0.3, 0.0, 0.0], atol=1e-12)


def held(degrees, *, static, speed=0.0, **options):
    """Return a particle on a slope with μ_k = MU and another μ_s, and the frame after a second."""
    simulation = on_a_plane(degrees, pairs={'c': {'table': {
        'friction': MU, 'static_friction': static}}}, **options)
    angle = np.radians(degrees)
    simulation.state.v[:, 0] = speed * np.array([np.cos(angle), 0.0, -np.sin(angle)])
    return simulation, run(simulation, 60)


@pytest.mark.parametrize('substeps, iterations', [(1, 1), (4, 1), (3, 5)])
def test_what_sticks_holds_more_than_what_slides(substeps, iterations):
    """V14 with two coefficients: atan 0.6 = 30.96°."""
    options = {'static': 0.6, 'substeps': substeps, 'iterations': iterations}
    simulation, frame = held(30.9, **options)
    np.testing.assert_allclose(frame.x[0], simulation.natural(simulation._start)[0], atol=1e-12)
    for degrees, speed in ((31.1, 0.0), (30.0, 0.5)):
        _, frame = held(degrees, speed=speed, **options)
        angle = np.radians(degrees)
        expected = speed + GRAVITY * (np.sin(angle) - MU * np.cos(angle))
        assert np.linalg.norm(frame.v[0]) == pytest.approx(expected, rel=1e-6)


def test_a_pair_has_the_mean_of_both_static_frictions():
    simulation = simulate(
        (1, 1), friction=0.9, pose={'position': [0.0, 0.0, R]}, colliders={
            'a': {'plane': {}, 'friction': 0.1, 'static_friction': 0.4},
            'b': {'plane': {}, 'friction': 0.4}},
        scene_effects={'pin': {}, 'contact': {'thickness': R},
                       'friction': {'pairs': {'c': {'b': 0.7}}}})
    simulation.step()
    data = simulation.effects['friction'].data
    np.testing.assert_allclose(data.coefficient[0, :2], [0.3, 0.7], rtol=1e-15)
    np.testing.assert_allclose(data.static[0, :2], [0.6, 0.7], rtol=1e-15)
    simulation.step([SetKey('colliders.a.static_friction', 0.9)])
    assert simulation.effects['friction'].data.static[0, 0] == pytest.approx(0.9)
    frame = simulation.step([SetKey('colliders.a.friction', 1.0)])
    assert 'static_friction: must be at least friction (1) (got 0.9)' in frame.refused[0][1]


def test_without_a_static_coefficient_there_is_no_array_of_them():
    assert on_a_plane().effects['friction'].data.static is None


@pytest.mark.parametrize('mu', [0.0, 0.2, 0.5])
def test_a_strip_on_a_cylinder_obeys_the_capstan_equation(mu):
    """V16, the capstan: T2 / T1 = exp(μ φ) with φ = 90°, here without inertia to speak of."""
    n, radius, thickness = 61, 0.1, 0.002
    bend = radius + thickness
    simulation = simulate(
        (n, 1), (0.6, 0.1), effects={'stretch': {'warp': 200.0, 'weft': 200.0}}, friction=mu,
        density=0.05, gravity=(0, 0, 0), substeps=40, pose={'position': [-0.45, 0.0, bend]},
        scene_effects={'contact': {'thickness': thickness}, 'friction': {},
                       'damping': {'rate': 40.0}},
        colliders={'drum': {'cylinder': {'radius': radius, 'length': 0.5}, 'friction': mu,
                            'orientation': [0.5**0.5, 0.0, 0.0, 0.5**0.5]}},
        pins={'back': {'cloth': 'c', 'at': [0]},
              'front': {'cloth': 'c', 'at': [n - 1], 'motion': [
                  [0.0, 0.15, 0.0, bend], [0.6, bend, 0.0, -0.1], [2.0, bend, 0.0, -0.2]]}})
    pulls = []
    for k in range(120):
        frame = simulation.step()
        if k >= 100:
            pulls.append([np.linalg.norm(frame.pins[name].force) for name in ('front', 'back')])
    front, back = np.mean(pulls, 0)
    assert back > 0.3
    assert front / back == pytest.approx(np.exp(0.5 * np.pi * mu), rel=0.04)


@pytest.mark.slow
@pytest.mark.parametrize('method, integrator', [('line', 'bdf2'), ('explicit', 'leapfrog')])
def test_cloth_that_touches_only_itself_rubs_without_colliders(method, integrator):
    sheet = simulate((6, 6), effects={'stretch': {'warp': 60.0, 'weft': 40.0}}, method=method,
                     integrator=integrator, substeps=40, scene_effects={
                         'self_collision': {'thickness': 0.003}, 'friction': {}})
    assert np.isfinite(run(sheet, 3).x).all()
