"""The wrench on pins closes Newton's law: what the cloth gains is what pins and weight gave it."""

import numpy as np
import pytest

from support.meshes import ball, obj_text
from support.scenes import GRAVITY, simulate
from support.tiers import quick_only, slow
from xpbd_ros.sim.commands import Grasp, MovePin, Pose, SetKey

LATTICE = {'stretch': {'warp': 300.0, 'weft': 200.0}, 'shear': {'stiffness': 10.0},
           'bend': {'stiffness': 1e-4}}
MEMBRANE = {'membrane': {'warp': 200.0, 'weft': 150.0, 'shear': 20.0, 'poisson': 0.2},
            'hinge': {'stiffness': 1e-4}}
MESH = {'stretch': {'warp': 300.0, 'weft': 200.0}, 'hinge': {'stiffness': 1e-3},
        'area': {'stiffness': 50.0}, 'tether': {'slack': 0.02}}
CORNERS = {'left': {'cloth': 'c', 'at': 'corner_00'}, 'right': {'cloth': 'c', 'at': 'corner_01'}}
SPOTS = {'left': {'cloth': 'c', 'near': [-0.5, 0.0, 0.0], 'radius': 0.2},
         'right': {'cloth': 'c', 'near': [0.5, 0.0, 0.0], 'radius': 0.2}}
BALL = {'stretch': {'warp': 300.0, 'weft': 300.0}, 'pressure': {'outside': 500.0}}


def write(folder, vertices, cells) -> str:
    """Write a mesh, and return the name of its file."""
    file = folder / 'shape.obj'
    file.write_text(obj_text(vertices, cells))
    return str(file)


SOFT = {'stretch': {'warp': 20.0, 'weft': 20.0}, 'strain_limit': {'max': 0.03}}
CASES = {
    'lattice': {'effects': LATTICE, 'pins': CORNERS, 'grid': (11, 9)},    # of square cells
    'lattice-gauss_seidel': {'effects': LATTICE, 'pins': CORNERS, 'method': 'gauss_seidel',
                             'substeps': 8, 'iterations': 2},
    'lattice-explicit': {'effects': LATTICE, 'pins': CORNERS, 'method': 'explicit',
                         'integrator': 'leapfrog'},
    'membrane': {'effects': MEMBRANE, 'pins': CORNERS},
    'mesh': {'effects': MESH, 'pins': SPOTS, 'mesh': True},
    'limit': {'effects': {**SOFT, 'shear': {'stiffness': 5.0}}, 'pins': CORNERS,
              'integrator': 'backward_euler'},
    'mesh-limit': {'effects': SOFT, 'pins': SPOTS, 'mesh': True,
                   'integrator': 'backward_euler'},
    'lattice-jacobi': {'effects': LATTICE, 'pins': CORNERS, 'method': 'jacobi', 'substeps': 16},
    'limit-jacobi': {'effects': SOFT, 'pins': CORNERS, 'method': 'jacobi', 'substeps': 16},
    'membrane-jacobi': {'effects': MEMBRANE, 'pins': CORNERS, 'method': 'jacobi', 'substeps': 16},
    'ball': {'effects': BALL, 'pins': SPOTS, 'mesh': lambda folder: write(folder, *ball(1))},
}
ALL = quick_only(CASES, 'lattice')


def make(name, tmp_path, **options):
    """Return the simulation of a case."""
    given = {'method': 'auto', 'integrator': None, 'substeps': None, 'density': 0.2,
             **CASES[name], **options}
    if callable(given.get('mesh')):
        given['mesh'] = given['mesh'](tmp_path)
    return simulate(given.pop('grid', (13, 17)), (1.0, 0.8), **given)


@pytest.mark.parametrize('compliance', [0.0, 1e-5])
def test_a_radial_force_has_no_torque_about_the_axis(compliance):
    """A particle on a pin's arm that turns evenly: within half a substep's turn."""
    speed, arm, substeps = 6.0, 0.3, 16
    simulation = simulate((2, 1), effects={'stretch': {'compliance': 1e300}}, density=2.0,
                          gravity=(0.0, 0.0, 0.0), substeps=substeps,
                          scene_effects={'pin': {'compliance': compliance}})
    simulation.step([Grasp('hand', Pose((-arm, 0.0, 0.0)), arm + 0.01)])
    for k in range(60):
        half = 0.5 * speed * (k + 1) * simulation.frame_dt
        pose = Pose((-arm, 0.0, 0.0), (0.0, 0.0, np.sin(half), np.cos(half)))
        hand = simulation.step([MovePin('hand', pose)]).pins['hand']
        if k > 30:
            pull = np.linalg.norm(hand.force)
            assert pull == pytest.approx(speed**2 * arm, rel=0.1)    # of 1 kg
            turn = speed * simulation.frame_dt / substeps
            assert abs(hand.torque[2]) < 0.6 * turn * arm * pull


def pulls(frame):
    """Return the force of the cloth on all pins together [N]."""
    return sum(pin.force for pin in frame.pins.values())


@pytest.mark.parametrize('name', ALL)
def test_pins_at_rest_carry_the_weight(name, tmp_path):
    """Σ F = M g within 1e-6 of it. Single sweeps of ``line`` let v alternate (numerics 3.2)."""
    simulation = make(name, tmp_path, scene_effects={'pin': {}, 'damping': {'rate': 8.0}})
    for _ in range(899):
        before = simulation.step().x
    frame = simulation.step()
    assert np.abs(frame.x - before).max() < 1e-6
    weight = simulation.state.mass.sum() * GRAVITY
    np.testing.assert_allclose(pulls(frame), [0.0, 0.0, -weight], rtol=1e-6, atol=1e-6 * weight)


@pytest.mark.parametrize('compliance', [0.0, slow(0.001)])
@pytest.mark.parametrize('name', quick_only(('lattice', 'lattice-explicit'), 'lattice'))
def test_pins_feel_the_damping_of_all_particles(name, compliance, tmp_path):
    """
    Σ F = M g - d/dt Σ m v - rate Σ m Δx / Δt in each frame, held particles included.

    The rate doubles half way.
    """
    rate = 3.0
    simulation = make(name, tmp_path, scene_effects={
        'pin': {'compliance': compliance}, 'damping': {'rate': rate}})
    mass, frame = simulation.state.mass[simulation.slot], simulation.frame()
    places = {pin: np.array(state.pose.position) for pin, state in frame.pins.items()}
    for k in range(30):
        before, start = mass @ frame.v, mass @ frame.x
        commands = [MovePin(pin, Pose(tuple(place + [0.0, 0.02 * k, 0.01 * k])))
                    for pin, place in places.items()]
        if k == 15:
            rate *= 2.0
            commands.append(SetKey('effects.damping.rate', rate))
        frame = simulation.step(commands)
        change = mass @ frame.v - before + rate * (mass @ frame.x - start)
        expected = mass.sum() * np.array([0.0, 0.0, -GRAVITY]) - change / simulation.frame_dt
        np.testing.assert_allclose(pulls(frame), expected, atol=1e-9)


@pytest.mark.parametrize('name', ALL)
def test_shaken_pins_give_the_cloth_its_momentum(name, tmp_path):
    """∫ (M g - F) dt = Δ Σ m v within 1e-3 of ∫ |F| dt, however rough it is."""
    simulation = make(name, tmp_path, scene_effects={'pin': {}, 'damping': {'rate': 0.0}})
    mass = simulation.state.mass[simulation.slot]
    places = {pin: np.array(state.pose.position)
              for pin, state in simulation.frame().pins.items()}
    impulse, size, frame = np.zeros(3), 0.0, simulation.frame()
    before = mass @ frame.v
    for k in range(60):
        swing = 0.1 * np.sin(2.0 * np.pi * 3.0 * (k + 1) / 60.0)
        way = [0.3 * swing, swing, 0.7 * swing]
        frame = simulation.step([MovePin(pin, Pose(tuple(place + way)))
                                 for pin, place in places.items()])
        force = pulls(frame)
        impulse += simulation.frame_dt * (mass.sum() * np.array([0.0, 0.0, -GRAVITY]) - force)
        size += simulation.frame_dt * np.linalg.norm(force)
    gained = mass @ frame.v - before
    assert np.linalg.norm(impulse - gained) < 1e-3 * size
