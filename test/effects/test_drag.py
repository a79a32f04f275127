"""Drag and wind: terminal speed, the force's law, storms, and a wind that changes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.scenes import GRAVITY, run, run_until_still, simulate
from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.commands import Reset, SetKey, SetWind
from xpbd_ros.sim.particles.history import NONE

AIR, NORMAL, SKIN = 1.2, 1.2, 0.01
STILL = (0.0, 0.0, 0.0)
METHOD = {'backward_euler': 'gauss_seidel', 'bdf2': 'gauss_seidel_symmetric', 'ndf2': 'line',
          'leapfrog': 'explicit'}


def sheet(wind=None, *, drag=None, gravity=STILL, density=0.1, grid=(4, 3), **options):
    """Return a flat sheet without any elasticity, in wind or in still air."""
    scene_effects = {**options.pop('scene_effects', {}), **({'drag': drag} if drag else {})}
    if wind is not None:
        scene_effects['wind'] = {'velocity': list(wind), **options.pop('gust', {})}
    return simulate(grid, (0.6, 0.4), scene_effects=scene_effects, gravity=gravity,
                    density=density, **options)


@pytest.mark.parametrize('integrator, order', [
    ('backward_euler', 1.0), slow('bdf2', 2.0), ('ndf2', 2.0), ('leapfrog', 2.0)])
def test_a_flat_sheet_falls_as_tanh_to_its_terminal_speed(integrator, order):
    """V17: v = v_t tanh(g t / v_t), v_t = √(2 ρ g / (ρ_a C))."""
    terminal = np.sqrt(2.0 * 0.1 * GRAVITY / (AIR * NORMAL))
    assert terminal == pytest.approx(1.167, abs=1e-3)
    errors = []
    for substeps in (4, 8, 16):
        simulation = sheet(drag={'density': AIR}, gravity=(0, 0, -GRAVITY), substeps=substeps,
                           integrator=integrator, method=METHOD[integrator])
        frame = run(simulation, 6)
        exact = -terminal * np.tanh(GRAVITY * 0.1 / terminal)
        assert np.ptp(frame.v, 0).max() < 1e-12
        errors.append(abs(frame.v[0, 2] - exact))
    np.testing.assert_allclose(np.log2(errors[:-1]) - np.log2(errors[1:]), order, atol=0.1)
    assert run(simulation, 120).v[:, 2] == pytest.approx(-terminal, rel=2e-3)


def test_frames_of_one_substep_have_the_order_of_the_leapfrog():
    """At both ends of a frame the force is that of the frame's v, half a substep further on."""
    terminal, errors = np.sqrt(2.0 * 0.1 * GRAVITY / (AIR * NORMAL)), []
    for rate in (240.0, 480.0, 960.0):
        simulation = sheet(drag={'density': AIR}, gravity=(0, 0, -GRAVITY), rate=rate,
                           integrator='leapfrog', method=METHOD['leapfrog'])
        frame = run(simulation, round(0.1 * rate))
        errors.append(abs(frame.v[0, 2] + terminal * np.tanh(GRAVITY * 0.1 / terminal)))
    np.testing.assert_allclose(np.log2(errors[:-1]) - np.log2(errors[1:]), 2.0, atol=0.1)


@pytest.mark.slow
def test_a_flag_in_a_gust_has_the_order_of_the_leapfrog():
    """Second order: a lag of the normals, the velocities or the wind would make it first order."""
    at = []
    for substeps in (64, 128, 256):
        flag = sheet((0.0, 1.0, 4.0), gust={'gust': [0.5, 0.0, -1.0], 'period': 0.4},
                     pins={'a': {'cloth': 'c', 'at': 'edge_x0'}}, gravity=(0, 0, -GRAVITY),
                     substeps=substeps, method='explicit', integrator='leapfrog',
                     effects={'stretch': {'warp': 20.0, 'weft': 20.0}})
        at.append(run(flag, 6).x)
    coarse, fine = (np.abs(a - b).max() for a, b in zip(at, at[1:]))
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)


def test_a_sheet_in_a_gust_has_the_order_of_bdf2():
    """The wind is that of the substep's end; one substep earlier or later is of first order."""
    at = []
    for substeps in (8, 16, 32):
        free = sheet((0.0, 0.0, 1.0), gust={'gust': [0.0, 0.0, 1.0], 'period': 0.4},
                     substeps=substeps, method=METHOD['bdf2'], integrator='bdf2',
                     effects={'stretch': {'warp': 20.0, 'weft': 20.0}})
        at.append(run(free, 6).x)
    coarse, fine = (np.abs(a - b).max() for a, b in zip(at, at[1:]))
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize('precision', ['float64', slow('float32')])
@pytest.mark.parametrize('turn', [[0.0, 0.0, 0.0], [0.5, -0.7, 0.3]])
def test_the_force_on_a_pinned_sheet_is_that_of_the_formula(precision, turn):
    """A wind at an angle; all particles are pinned, and each takes the part of its own area."""
    turn, wind = Rotation.from_rotvec(turn), np.array([3.0, 1.0, -2.0])
    frame = run(sheet(turn.apply(wind).tolist(), precision=precision,
                      pose={'orientation': turn.as_quat().tolist()},
                      pins={'a': {'cloth': 'c', 'at': [0]},
                            'b': {'cloth': 'c', 'at': list(range(1, 12))}}), 2)
    area, along = 0.6 * 0.4, np.array([3.0, 1.0, 0.0])
    expected = turn.apply(0.5 * AIR * area * (NORMAL * 2.0 * np.array([0.0, 0.0, -2.0])
                                              + 2.0 * SKIN * np.linalg.norm(along) * along))
    np.testing.assert_allclose(frame.pins['a'].force, expected / 24.0, rtol=1e-5)
    np.testing.assert_allclose(frame.pins['b'].force, expected * 23.0 / 24.0, rtol=1e-5)


def test_drag_follows_the_velocity_relative_to_the_wind():
    for wind, change in (((0.0, 0.0, 1.0), 0.0), ((0.0, 0.0, 0.5), -1.0)):
        simulation = sheet(wind)
        simulation.state.v[2, simulation.slot] = 1.0
        assert np.sign(simulation.step().v[:, 2] - 1.0) == pytest.approx(change)


@pytest.mark.slow
@pytest.mark.parametrize('method', ['line', 'jacobi', 'explicit'])
def test_light_cloth_in_a_sudden_storm_never_outruns_it(method):
    """H28: 30 m/s on 50 g/m² in a step of 1/60 s, 9 times too long for an explicit force."""
    simulation = sheet((30.0, 0.0, 0.0), density=0.05, pose={'orientation': [0.3, 0.5, 0.1, 0.8]},
                       effects={'stretch': {'warp': 50.0, 'weft': 50.0}}, method=method,
                       substeps=400 if method == 'explicit' else 1,
                       integrator='leapfrog' if method == 'explicit' else 'backward_euler')
    for _ in range(60):
        frame = simulation.step()
        momentum = simulation.state.mass[simulation.slot] @ frame.v
        assert np.isfinite(frame.x).all()
        assert np.linalg.norm(momentum) <= 30.0 * simulation.state.mass.sum() * (1 + 1e-9)
    assert np.linalg.norm(momentum) > 3.0 * simulation.state.mass.sum()


@pytest.mark.parametrize('integrator', ['backward_euler', slow('bdf2')])
def test_a_free_sheet_across_a_storm_is_monotone(integrator):
    simulation = sheet((0.0, 0.0, 30.0), density=0.05, integrator=integrator)
    speeds = [simulation.step().v[:, 2].mean() for _ in range(30)]
    assert (np.diff([0.0, *speeds]) > -1e-9).all()
    assert 25.0 < speeds[-1] <= 30.0


@pytest.mark.parametrize('integrator', ['bdf2', slow('ndf2')])
def test_where_drag_is_too_fast_a_particle_takes_a_step_of_backward_euler(integrator):
    """Along a flat sheet, where the wind has no force, it moves as one without a history."""
    found = []
    for storm in (0.0, 60.0):
        simulation = sheet(STILL, drag={'tangential': 0.0}, integrator=integrator,
                           method=METHOD[integrator], rate=240.0, gravity=(2.0, 1.0, 0.0),
                           effects={'stretch': {'warp': 20.0, 'weft': 20.0}})
        state = simulation.state
        state.x[:2] *= 1.1
        run(simulation, 5)
        assert (state.history.fresh[simulation.slot] < NONE).all()
        if not storm:
            state.history.fresh[simulation.slot] = NONE
        found.append(simulation.step([SetWind((0.0, 0.0, storm))]))
    still, blown = found
    assert blown.v[:, 2].min() > 1.0
    np.testing.assert_allclose(blown.v[:, :2], still.v[:, :2], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(blown.x[:, :2], still.x[:, :2], rtol=0.0, atol=1e-14)


def held(density, solver=None):
    """Return a sheet across 25 m/s, held at both edges, and its frame when it is at rest."""
    simulation = compile_scene(scene_from_mapping({
        'gravity': [0, 0, 0], 'solver': solver or {}, 'cloths': {'c': {
            'grid': {'size': [0.6, 0.4], 'resolution': [10, 7]}, 'density': density,
            'effects': {'stretch': {'warp': 2000.0, 'weft': 2000.0}}}},
        'pins': {'a': {'cloth': 'c', 'at': 'edge_0x'}, 'b': {'cloth': 'c', 'at': 'edge_1x'}},
        'effects': {'wind': {'velocity': [0, 0, 25.0]}, 'damping': {'rate': 20.0}}},
        where='x', name='x'))
    return simulation, run_until_still(simulation, speed=1e-9)


@pytest.mark.slow
def test_a_held_sheet_feels_the_whole_wind_however_light_it_is():
    """The supporting force and the bulge do not depend on the weight of the sheet."""
    far = held(0.05, {'substeps': 120})[1].x[:, 2].max()
    for density in (0.05, 0.1, 0.5):
        simulation, frame = held(density)
        assert frame.x[:, 2].max() == pytest.approx(far, rel=0.01)
        drag, state = simulation.effects['drag'].data, simulation.state
        d, u, slots = drag.along, drag.u, simulation.slot
        force = drag.share * (d[:, 2] * u[:, 2] + drag.across[:, 0] * u[:, 1]
                              + drag.across[:, 1] * u[:, 0])
        z = drag.share * d[:, :3].sum(1) * state.inv_mass * simulation.frame_dt
        assert z[slots].max() / simulation.solver.substeps < 1.0    # so all of it is felt
        assert force[slots].sum() == pytest.approx(_wind_on(frame, simulation), rel=1e-6)


def _wind_on(frame, simulation):
    """Return what the formula says for a sheet at rest across 25 m/s [N]."""
    a, b, c = (frame.x[simulation.cloths[0].mesh.triangles[:, k]] for k in range(3))
    twice = np.cross(b - a, c - a)
    area = np.linalg.norm(twice, axis=1)
    normal = twice / area[:, None]
    across = 25.0 * normal[:, 2]
    along = np.array([0.0, 0.0, 25.0]) - across[:, None] * normal
    return (0.25 * AIR * area @ (NORMAL * (np.abs(across) * across)[:, None] * normal
            + 2.0 * SKIN * np.linalg.norm(along, axis=1)[:, None] * along))[2]


def test_drag_alone_is_still_air_and_wind_brings_drag():
    assert set(sheet((1.0, 0.0, 0.0)).effects) == {'wind', 'drag'}
    still, windless = sheet(drag={'density': AIR}), sheet(STILL)
    assert still.effects['drag'].data.wind is None
    for simulation in (still, windless):
        simulation.state.v[2, simulation.slot] = -1.0
        run(simulation, 10)
    assert still.hash() == windless.hash()


def test_the_wind_can_be_set_and_a_reset_brings_back_the_scenes():
    simulation = sheet(STILL)
    assert not run(simulation, 3).v.any()
    frame = simulation.step([SetWind((0.0, 0.0, 2.0))])
    assert frame.applied == (SetWind((0.0, 0.0, 2.0)),)
    assert (frame.v[:, 2] > 0.0).all()
    frame = simulation.step([SetKey('effects.drag.normal', 0.0), SetKey('gravity', STILL)])
    assert simulation.effects['wind'].velocity[2] == 2.0    # other keys leave it as it is
    simulation.step([SetKey('effects.wind.velocity', (1.0, 0.0, 0.0))])
    assert tuple(simulation.effects['wind'].velocity) == (1.0, 0.0, 0.0)
    assert not simulation.step([SetWind((0.0, 3.0, 0.0)), SetKey('effects.wind.velocity', STILL),
                                Reset()]).v.any()
    assert simulation.step([SetWind((0.0, 2e4, 0.0))]).refused[0][1].startswith('wind: ')


def test_gusts_swell_about_the_mean_and_begin_anew_at_a_reset():
    simulation = sheet((1.0, 0.0, 0.0), gust={'gust': [0.5, 0.0, 0.0], 'period': 0.5})

    def velocities(frames=30):
        return [float(simulation.effects['wind'].data.now[0]) for _ in range(frames)
                if simulation.step() is not None]
    first = velocities()
    np.testing.assert_allclose(first, 1.0 + 0.5 * np.sin(4.0 * np.pi * np.arange(1, 31) / 60.0),
                               atol=1e-8)    # a frame is whole nanoseconds
    assert np.mean(first) == pytest.approx(1.0, abs=1e-9)
    assert max(first) == pytest.approx(1.5, abs=0.01) and min(first) == pytest.approx(0.5, abs=.01)
    velocities(7)
    simulation.step([Reset()])
    assert velocities(29) == first[1:]


def test_a_wind_that_makes_no_sense_is_refused():
    with pytest.raises(InputError, match=r'effects.wind.velocity\[0\]: must be finite m/s'):
        sheet((float('nan'), 0.0, 0.0))
    with pytest.raises(InputError, match=r'effects.wind.velocity: missing \(m/s\)'):
        simulate(scene_effects={'wind': {}})
