"""Cloth and bodies from files: found, laid out, held, and run like a grid."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import yaml

from support.meshes import arch, ball, box, disc, obj_text, vtk_text
from support.scenes import run
from support.shirt import shirt
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_text
from xpbd_ros.scene.save import scene_text
from xpbd_ros.share import share_folder
from xpbd_ros.sim.measure import largest_strain

EFFECTS = {'contact': {'thickness': 0.01}, 'friction': {}, 'damping': {'rate': 0.5}}
PIN = {'a': {'cloth': 'c', 'at': [0]}}
TABLE = {'table': {'plane': {}, 'position': [0.0, 0.0, -0.2]}}


@pytest.fixture
def scene(tmp_path):
    """Return a function that writes a scene with a disc, beside its mesh, and loads it."""
    (tmp_path / 'disc.obj').write_text(obj_text(*disc()))

    def load(mesh=None, overrides=None, **keys):
        pins, cloth = keys.pop('pins', None), {'density': 0.2, **keys.pop('cloth', {})}
        raw = {'solver': {'substeps': 4}, 'cloths': {'c': {
            'mesh': {'file': 'disc.obj', **(mesh or {})}, **cloth}}, **keys}
        if pins:
            raw['pins'] = pins
        (tmp_path / 'scene.yaml').write_text(yaml.safe_dump(raw))
        return load_scene(str(tmp_path / 'scene.yaml'), overrides)
    return load


def refusal(make) -> str:
    with pytest.raises(InputError) as error:
        make()
    return str(error.value)


def test_a_mesh_has_its_scale_pose_and_file_order(scene):
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    simulation = compile_scene(scene({'scale': 0.5}, cloth={'pose': {
        'position': [1.0, 2.0, 3.0], 'orientation': turn.as_quat().tolist()}}))
    vertices, triangles = disc()
    np.testing.assert_allclose(simulation.frame().x, turn.apply(0.5 * vertices) + [1, 2, 3],
                               atol=1e-14)
    assert simulation.state.mass.sum() == pytest.approx(
        0.2 * simulation.cloths[0].mesh.area.sum(), rel=1e-14)
    np.testing.assert_array_equal(simulation.cloths[0].mesh.triangles, triangles)
    assert simulation.notes == ()


def test_grids_and_meshes_lie_one_after_another(scene):
    disc = {'mesh': {'file': 'disc.obj'}, 'density': 1.0}
    simulation = compile_scene(scene(overrides={'cloths': {
        'c': disc, 'a': {'grid': {'size': [1, 1], 'resolution': [3, 2]}, 'density': 1.0},
        'z': disc}}))
    assert [len(cloth.slots) for cloth in simulation.cloths] == [61, 6, 61]
    assert len(np.unique(simulation.slot)) == 128
    assert simulation.state.x.shape[1] > simulation.slot.max()
    for cloth in simulation.cloths:
        np.testing.assert_array_equal(simulation.slot[cloth.particles], cloth.slots)
        np.testing.assert_allclose(simulation.frame().x[cloth.particles], cloth.mesh.positions,
                                   atol=1e-15)


def test_a_mesh_falls_on_a_table_and_is_held_by_pins(scene):
    simulation = compile_scene(scene(
        effects=EFFECTS, colliders=TABLE,
        pins={'near': {'cloth': 'c', 'near': [0.5, 0.0, 0.0], 'radius': 0.05},
              'list': {'cloth': 'c', 'at': [0, 60, 3]}}))
    frame = run(simulation, 60)
    held = [37, 0, 3, 60]
    assert frame.pins['near'].particles.tolist() == [37]
    assert sorted(frame.pins['list'].particles) == [0, 3, 60]
    vertices = disc()[0]
    np.testing.assert_allclose(frame.x[held], vertices[held], atol=1e-6)
    free = np.setdiff1d(np.arange(61), held)
    np.testing.assert_allclose(frame.x[free, 2], -0.19, atol=1e-6)
    assert frame.pins['near'].force[2] == pytest.approx(
        -9.80665 * 0.2 * simulation.cloths[0].mesh.area[37], rel=1e-4)
    assert largest_strain(simulation) > 0.1
    padding = np.setdiff1d(np.arange(simulation.state.x.shape[1]), simulation.slot)
    assert (simulation.state.x[:, padding] == 0.0).all()


def test_a_body_falls_like_a_cloth(scene, tmp_path, meshio):
    vertices, tetrahedra = box()
    meshio.write_points_cells(tmp_path / 'box.vtk', vertices, [('tetra', tetrahedra)])
    simulation = compile_scene(scene({'file': 'box.vtk'}, effects=EFFECTS, colliders=TABLE,
                                     pins=PIN))
    assert simulation.state.mass.sum() == pytest.approx(0.2 * 0.2 * 0.2 * 0.3, rel=1e-6)
    frame = run(simulation, 60)
    assert frame.x[1:, 2] == pytest.approx(-0.19, abs=1e-6)
    assert frame.x[0].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize('place', ['corner_00', 'edge_x1'])
def test_places_of_a_grid_are_refused_on_a_mesh(scene, place):
    assert refusal(lambda: compile_scene(scene(
        pins={'a': {'cloth': 'c', 'at': place}}))).endswith(
        f"scene.yaml: pins.a.at: {place} is a place on a grid, and 'c' is a mesh; use near and "
        'radius (m), or a list of particle numbers')


def test_what_a_log_keeps_runs_from_anywhere_with_the_same_bits(scene, monkeypatch, tmp_path):
    first = scene({'scale': 2.0}, effects=EFFECTS, colliders=TABLE, pins=PIN)
    simulation = compile_scene(first)
    text = scene_text(first, simulation.solver)
    assert str(tmp_path / 'disc.obj') in text
    (tmp_path / 'elsewhere').mkdir()
    monkeypatch.chdir(tmp_path / 'elsewhere')
    again = compile_scene(scene_from_text(text, where='log', name='log'))
    run(simulation, 20)
    run(again, 20)
    assert simulation.hash() == again.hash()
    (tmp_path / 'disc.obj').unlink()
    assert refusal(lambda: compile_scene(scene_from_text(text, where='log', name='log'))) == (
        f"log: cloths.c.mesh.file: no such file: {tmp_path / 'disc.obj'}; restore it, or correct "
        'the path')


def test_a_relative_scene_path_finds_the_mesh_too(scene, monkeypatch, tmp_path):
    scene()
    (tmp_path / 'beside').mkdir()
    monkeypatch.chdir(tmp_path / 'beside')
    found = load_scene('../scene.yaml')
    assert found.cloths['c'].mesh.file.startswith('/')
    assert len(compile_scene(found).slot) == 61


def test_what_was_mended_is_told_by_the_simulation(scene, tmp_path):
    with open(tmp_path / 'disc.obj', 'a') as file:
        file.write('v 9 9 9\nf 1 2 2\n')
    assert compile_scene(scene()).notes == (
        'cloths.c.mesh: 1 triangle with an edge of length zero; left out',
        'cloths.c.mesh: 1 vertex that no triangle uses; left out',
        'cloths.c.mesh: particles are numbered without what is left out')


@pytest.mark.parametrize('mesh, cloth, reason', [
    ({'scale': 0}, {}, 'cloths.c.mesh.scale: must be > 0 (got 0)'),
    ({'warp': [0, 0, 0]}, {}, 'cloths.c.mesh: warp: must not be zero'),
    ({'warp': [0, 0, 2]}, {'effects': {'stretch': {'warp': 9, 'weft': 1}}},
     'cloths.c.mesh.warp: must lie in the mesh, for effects.stretch (got [0.0, 0.0, 2.0], which '
     'is normal to it); take a direction along x, or values for stretch that do not depend on '
     'one'),
    ({'warp': [0, 0, 1]}, {'effects': {'hinge': {'warp': 9, 'weft': 1}}},
     'cloths.c.mesh.warp: must lie in the mesh, for effects.hinge'),
    ({'fiel': 'x'}, {}, "cloths.c.mesh.fiel: unknown key; did you mean 'file'?"),
    ({'file': 3}, {}, 'cloths.c.mesh.file: must be text (got 3)'),
    ({'scale': 1e200}, {}, 'cloths: a particle would weigh inf kg; correct'),
    ({}, {'grid': {'size': [1, 1], 'resolution': [2, 2]}},
     "cloths.c: needs either 'grid' or 'mesh', and only one of them"),
    ({}, {'effects': {'shear': {'stiffness': 1.0}}},
     'cloths.c.effects.shear: a mesh has no diagonals')])
def test_a_mistake_is_told_with_file_and_key(scene, tmp_path, mesh, cloth, reason):
    assert refusal(lambda: compile_scene(scene(mesh, cloth=cloth))).startswith(
        f'{tmp_path}/scene.yaml: {reason}')


def test_a_warp_normal_to_the_mesh_is_refused_once_it_makes_a_difference(scene):
    simulation = compile_scene(scene({'warp': [0, 0, 1]}, cloth={
        'effects': {'stretch': {'warp': 9.0, 'weft': 9.0}}}))
    assert 'normal to it' in refusal(
        lambda: simulation.check({'cloths.c.effects.stretch.weft': 1.0}))


def test_a_mesh_that_is_refused_is_named_with_its_file(scene, tmp_path):
    (tmp_path / 'flat.obj').write_text('v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n')
    assert refusal(lambda: compile_scene(scene({'file': 'flat.obj'}))) == (
        f'{tmp_path}/scene.yaml: cloths.c.mesh: {tmp_path}/flat.obj: triangle 0 is degenerate: '
        'its corners lie in line (1 triangle so); remove or remesh such cells in the program '
        'that made the file')


def test_the_shipped_meshes_are_what_is_written_here():
    """One source for each: write it anew from here when it changes."""
    folder = share_folder() / 'scenes' / 'meshes'
    assert {file.name: file.read_text() for file in folder.iterdir()} == {
        'arch.obj': obj_text(*arch()), 'ball.obj': obj_text(*ball(2, 0.15)),
        'box.vtk': vtk_text(*box((4, 4, 4), 0.05)), 'shirt.obj': obj_text(*shirt())}
