"""From a scene to a simulation: places, masses, and that what is shipped runs."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.scenes import run, simulate
from support.shipped_scenes import each_scene
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping, scene_from_text
from xpbd_ros.scene.save import scene_text
from xpbd_ros.sim.measure import largest_strain

EACH = each_scene(slow=('arch', 'bag', 'balloon', 'curtain', 'drape', 'drum', 'flag', 'fold',
                        'fold_towel', 'grip', 'shirt', 'softbox'))
"""slow: those that take long to compile, of effects that have quick tests of their own"""


@EACH
def test_a_shipped_scene_runs(name):
    simulation = compile_scene(load_scene(name))
    for _ in range(30):
        frame = simulation.step()
        assert np.isfinite(frame.x).all()
        assert np.isfinite(frame.v).all()
    assert largest_strain(simulation) < 0.5
    assert np.abs(frame.v).max() < 20.0
    for pin in frame.pins.values():
        assert np.isfinite(pin.force).all()


@EACH
def test_what_is_saved_runs_with_the_same_bits(name):
    scene = load_scene(name, {'solver.iterations': 2, 'gravity': [0.1, 0.2, -9.0]})
    simulation = compile_scene(scene)
    again = compile_scene(scene_from_text(scene_text(scene, simulation.solver), where='log',
                                          name='log'))
    assert again.solver.reason.endswith(f'{simulation.solver.substeps} substeps as given')
    run(simulation, 5)
    run(again, 5)
    assert simulation.hash() == again.hash()


def test_a_cloth_has_the_pose_and_density_of_its_scene():
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    simulation = simulate((4, 3), (0.6, 0.5), density=0.3, pose={
        'position': [1.0, 2.0, 3.0], 'orientation': turn.as_quat().tolist()})
    rows, columns = np.mgrid[0:3, 0:4]
    flat = np.stack([columns * 0.2, rows * 0.25, np.zeros((3, 4))], -1).reshape(-1, 3)
    np.testing.assert_allclose(simulation.frame().x, turn.apply(flat) + [1.0, 2.0, 3.0],
                               atol=1e-14)
    assert simulation.state.mass.sum() == pytest.approx(0.3 * 0.6 * 0.5, rel=1e-14)
    np.testing.assert_array_equal(simulation.frame().inv_mass,
                                  1.0 / simulation.state.mass[simulation.slot])
    np.testing.assert_array_equal(simulation.state.v, 0.0)


@pytest.mark.parametrize('size, weight', [(1e300, 'inf'), (1e-300, '0')])
def test_a_cloth_too_heavy_or_too_light_for_numbers_is_refused(size, weight):
    with np.errstate(over='ignore'), pytest.raises(InputError) as error:
        simulate((2, 2), (size, size))
    assert str(error.value) == (f'small.yaml: cloths: a particle would weigh {weight} kg; correct '
                                'size, density or resolution')


@pytest.mark.parametrize('keys', [
    {'grid': {'size': [3e9, 1.0], 'resolution': [11, 11]}, 'density': 1e-9},
    {'grid': {'size': [1.0, 1.0], 'resolution': [11, 11]}, 'density': 0.2,
     'pose': {'position': [0.0, 3e9, 0.0]}}])
def test_a_cloth_too_far_away_to_compute_with_is_refused(keys):
    with pytest.raises(InputError, match=r'far.yaml: cloths.c: a particle would be .+e\+09 m '
                                         r'away, and 1e\+09 m is the most; correct size, scale'):
        compile_scene(scene_from_mapping({'cloths': {'c': keys}}, where='far.yaml', name='far'))


def test_what_is_wrong_with_a_pin_is_told_with_the_file():
    """Found only when the cloths are laid out."""
    with pytest.raises(InputError) as error:
        simulate(pins={'a': {'cloth': 'towel', 'at': 'corner_00'}})
    assert str(error.value) == "small.yaml: pins.a.cloth: unknown cloth 'towel' (known: c)"


@pytest.mark.parametrize(('precision', 'far', 'told'), [
    ('float32', 1e4, True), ('float32', 1.0, False), ('float64', 1e4, False)])
def test_float32_far_from_the_origin_is_said(precision, far, told):
    notes = compile_scene(scene_from_mapping({
        'solver': {'precision': precision},
        'cloths': {'c': {'grid': {'size': [1.0, 1.0], 'resolution': [11, 11]}, 'density': 0.2,
                         'pose': {'position': [far, 0.0, 0.0]}}},
    }, where='far.yaml', name='far')).notes
    assert any('neighbours are' in note for note in notes) == told


@pytest.mark.parametrize(('precision', 'substeps', 'told'), [
    ('float32', 20, False), ('float32', 2000, True), ('float64', 2000, False)])
def test_steps_that_float32_cannot_tell_are_said(precision, substeps, told):
    notes = simulate(gravity=(0, 0, -9.8), substeps=substeps, precision=precision).notes
    assert any('forces get lost' in note for note in notes) == told


@pytest.mark.parametrize(('method', 'integrator', 'substeps', 'told'), [
    ('gauss_seidel', 'ndf2', 8, True), ('gauss_seidel', 'ndf2', 80, False),
    ('gauss_seidel', 'bdf2', 8, False), ('gauss_seidel_symmetric', 'ndf2', 8, False)])
def test_a_one_way_sweep_with_ndf2_that_is_under_resolved_is_said(method, integrator, substeps,
                                                                  told):
    notes = simulate((6, 5), method=method, integrator=integrator, substeps=substeps, density=0.2,
                     effects={'stretch': {'warp': 5000.0, 'weft': 5000.0}}).notes
    assert any('ndf2 may be unstable with gauss_seidel' in note for note in notes) == told
