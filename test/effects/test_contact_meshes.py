"""Contact with meshes from files and with ground, and what they take to store."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import yaml

from support.meshes import box_surface, file_of, octahedral_ball
from support.scenes import GRAVITY, run, simulate
from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.sim.commands import MoveCollider, PlaceCollider, Pose, SetKey
from xpbd_ros.sim.contact import distance_field

R = 0.01
FLAT = {'size': [1.0, 1.0], 'values': [[0.0, 0.0], [0.0, 0.0]]}


def write(file, surface):
    """Write an OBJ file."""
    vertices, faces = surface
    file.write_text('\n'.join([*(f'v {x!r} {y!r} {z!r}' for x, y, z in vertices.tolist()),
                               *(f'f {a} {b} {c}' for a, b, c in (faces + 1).tolist())]))
    return str(file)


def corners(surface):
    """Return a surface as ``PlaceCollider`` has it."""
    vertices, faces = surface
    return tuple(vertices[faces].ravel().tolist())


def particle(colliders, x, *, contact=None, friction=0.0, **options):
    """
    Return the simulation of one particle among colliders.

    A mesh comes with ground far below, and ground with a mesh far away: one step for both.
    """
    kinds = {kind for entry in colliders.values() for kind in entry}
    meshes = 'mesh' in kinds or 'mesh_nodes' in (contact or {})
    if meshes and 'heights' not in kinds:
        colliders = {**colliders, 'far': {'heights': FLAT, 'position': [0.0, 0.0, -1e3]}}
    if 'heights' in kinds and not meshes:
        colliders = {**colliders, 'far': {'mesh': {
            'file': file_of(*box_surface()), 'spacing': 0.05}, 'position': [1e3, 0.0, 0.0]}}
    return simulate((1, 1), friction=friction, colliders=colliders, pose={'position': list(x)},
                    scene_effects={'pin': {}, 'contact': {'thickness': R, **(contact or {})},
                                   'friction': {}}, **options)


def mesh(file, surface, **keys):
    """Return the entry of a mesh."""
    return {'mesh': {'file': write(file, surface), **keys}}


def test_a_particle_comes_to_rest_at_the_thickness_from_a_mesh(tmp_path):
    """In millimetres; turned and moved."""
    vertices, faces = box_surface()
    turn, place = Rotation.from_rotvec([2.0, 0.4, -1.0]), np.array([1.0, -2.0, 0.5])
    up = turn.apply([0.0, 0.0, 1.0])
    entry = mesh(tmp_path / 'box.obj', (1000.0 * vertices, faces), scale=0.001, spacing=0.02)
    simulation = particle({'s': {**entry, 'position': place.tolist(),
                                 'orientation': turn.as_quat().tolist()}},
                          place + 0.3 * up, gravity=(-GRAVITY * up).tolist(), substeps=4)
    frame = run(simulation, 60)
    np.testing.assert_allclose(frame.x[0], place + (0.2 + R) * up, atol=1e-6)
    np.testing.assert_allclose(frame.v, 0.0, atol=1e-6)
    grids = simulation.effects['contact'].colliders.grids
    assert simulation.stats()['collider_grid_bytes'] == 4 * grids.nodes[0].prod() > 1e4


@pytest.mark.slow
def test_cloth_hangs_over_a_ball_of_triangles_as_over_a_sphere(tmp_path):
    """The ball has 8192 faces and a spacing of a fifth of its thickness."""
    shapes = {'mesh': {**mesh(tmp_path / 'ball.obj', octahedral_ball(0.15), spacing=0.005)},
              'sphere': {'sphere': {'radius': 0.15}}}
    ends = {}
    for name, entry in shapes.items():
        simulation = simulate(
            (13, 13), (0.4, 0.4), effects={'stretch': {'warp': 500.0, 'weft': 500.0}}, substeps=8,
            pose={'position': [-0.2, -0.2, 0.17]}, density=0.2, friction=0.6,
            colliders={'s': entry},
            scene_effects={'contact': {'thickness': R}, 'friction': {}, 'damping': {'rate': 3.0}})
        frame = run(simulation, 60)
        ends[name] = frame.x.copy()
        assert np.linalg.norm(frame.x, axis=1).min() > 0.15 + R - 4e-4
    # chords of the ball lie up to 0.2 mm inside it, and cloth amplifies
    touching = np.linalg.norm(ends['sphere'], axis=1) < 0.165
    assert touching.sum() > 10
    np.testing.assert_allclose(ends['mesh'][touching], ends['sphere'][touching], atol=2e-3)


@pytest.mark.parametrize('speed', [50.0, 400.0])
@pytest.mark.parametrize('substeps', [1, 7])
def test_a_bullet_does_not_pass_a_thin_mesh(tmp_path, speed, substeps):
    """H18: a plate of 4 mm, on a grid of 2 mm."""
    entry = mesh(tmp_path / 'plate.obj', box_surface(0.03, 0.04, 0.002), spacing=0.002)
    for side, off in ((1.0, 0.0), (-1.0, 0.011)):
        simulation = particle({'s': entry}, (off, 0.3 * off, side * 0.77), gravity=(0, 0, 0),
                              substeps=substeps, contact={'thickness': 0.003})
        simulation.state.v[2, 0] = -side * speed
        for _ in range(6):
            assert side * simulation.step().x[0, 2] > 0.0


def fallen(entry, turn, speed, thickness):
    """Return how many of 121 particles that meet a plate along its normal end behind it."""
    up = turn.apply([0.0, 0.0, 1.0])
    simulation = simulate(
        (11, 11), (0.08, 0.08), colliders={'s': {**entry, 'friction': 10.0}, 'far': {
            'heights': FLAT, 'position': (-1e3 * up).tolist(),
            'orientation': turn.as_quat().tolist()}},
        scene_effects={'pin': {}, 'contact': {'thickness': thickness}, 'friction': {}}, substeps=4,
        gravity=(-GRAVITY * up).tolist(), pose={
            'position': turn.apply([-0.041, -0.039, 0.05]).tolist(),
            'orientation': turn.as_quat().tolist()})
    simulation.state.v[:, simulation.slot] = -speed * up[:, None]
    return int((run(simulation, 30).x @ up < 0.0).sum())


@pytest.mark.parametrize(('plate', 'turn', 'speed'), [
    (0.001, (0.0, 0.0, 0.0), 0.0), slow(0.002, (0.0, 0.0, 0.5), 30.0),
    (0.004, (1.0, 2.0, 0.3), 0.0), slow(0.004, (-2.0, 0.1, 1.0), 3.0)])
def test_nothing_passes_a_plate_thinner_than_the_usual_grid(tmp_path, plate, turn, speed):
    """That is a 96th of the longest side, up to 6.25 mm."""
    turn = Rotation.from_rotvec(turn)
    vertices, faces = box_surface(0.3, 0.05, 0.5 * plate)
    entry = mesh(tmp_path / 'plate.obj', (turn.apply(vertices), faces))
    assert fallen(entry, turn, speed, 0.002) == 0


@pytest.mark.parametrize('plate', [0.0005, 0.005, 0.012])
def test_a_plate_too_thin_for_its_grid_is_refused(tmp_path, plate):
    """Each on the coarsest grid that will do, where there is one, nothing passes."""
    def entry(spacing):
        return mesh(tmp_path / 'plate.obj', box_surface(0.05, 0.05, 0.5 * plate), spacing=spacing)
    with pytest.raises(InputError) as error:
        particle({'s': entry(0.0125)}, (0, 0, 0))
    text = (f'small.yaml: colliders.s.mesh: {tmp_path}/plate.obj: is so thin in places that '
            'particles pass it on a grid of ')
    if plate < 0.001:
        assert str(error.value) == text + ('0.000781 m, and a finer one takes more than 16000000 '
                                           'nodes; make it thicker, or of boxes')
        return
    start, _, out = str(error.value).partition('0.0125 m; use a spacing of ')
    assert start == text
    spacing, _, end = out.partition(' m, ')
    assert end == 'or leave it out'
    assert plate / 4.0 < float(spacing) < plate
    assert fallen(entry(float(spacing)), Rotation.identity(), 10.0, R) == 0


def test_a_mesh_that_comes_while_it_runs_and_room_for_it():
    """TRIANGLE_LIST; its grid has the place that the scene keeps for such."""
    crate = PlaceCollider('crate', 'mesh', corners(box_surface()), Pose((0.0, 0.0, -0.2)))
    simulation = particle({}, (0.0, 0.0, 0.2), contact={'mesh_nodes': 400_000}, substeps=4)
    frame = run(simulation, 60, [crate])
    np.testing.assert_allclose(frame.x[0], [0.0, 0.0, R], atol=1e-6)
    distances = simulation.effects['contact'].placed['crate'].field
    up = PlaceCollider('crate', 'mesh', crate.size, Pose((0.0, 0.0, -0.1)))
    frame = run(simulation, 100, [up])
    np.testing.assert_allclose(frame.x[0], [0.0, 0.0, 0.1 + R], atol=1e-6)
    assert simulation.effects['contact'].placed['crate'].field is distances, 'not built again'
    other = PlaceCollider('other', 'mesh', crate.size, Pose())
    frame = simulation.step([other])
    assert frame.refused[0][1].startswith("collider 'other': its grid has ")
    assert 'and there is room for ' in frame.refused[0][1]
    sheet = PlaceCollider('other', 'mesh', crate.size[:9], Pose())
    assert simulation.step([sheet]).refused[0][1] == (
        "collider 'other': is not closed (3 open edges), so it has no inside; close it, or use a "
        'box')
    frame = simulation.step([PlaceCollider('crate', 'box', (1.0, 1.0, 0.2), Pose()), other])
    assert not frame.refused
    frame = particle({}, (0.0, 0.0, 0.2)).step([crate])
    nodes = distances.values.size
    assert frame.refused[0][1] == (f"collider 'crate': its grid has {nodes} nodes, and there is "
                                   f'room for 0; raise effects.contact.mesh_nodes by {nodes}')


def test_a_mesh_that_is_replaced_and_put_back_in_one_frame_has_its_own_distances():
    simulation = particle({}, (0.0, 0.0, 0.2), contact={'mesh_nodes': 400_000}, substeps=4)
    tall, flat = (PlaceCollider('crate', 'mesh', corners(box_surface(0.3, 0.2, half)), Pose())
                  for half in (0.15, 0.05))
    simulation.step([tall])
    frame = run(simulation, 60, [(flat, tall)])
    np.testing.assert_allclose(frame.x[0], [0.0, 0.0, 0.15 + R], atol=1e-6)


def test_a_mesh_without_room_is_refused_before_any_distances(monkeypatch):
    monkeypatch.setattr(distance_field, '_stamp', None)
    simulation = particle({}, (0.0, 0.0, 0.2), contact={'mesh_nodes': 1000})
    crate = PlaceCollider('crate', 'mesh', corners(box_surface()), Pose())
    (_, why), = simulation.step([crate]).refused
    assert 'and there is room for 1000; raise effects.contact.mesh_nodes by ' in why


def test_a_refused_thin_mesh_says_how_many_nodes_it_needs():
    simulation = particle({}, (0.0, 0.0, 0.2), contact={'mesh_nodes': 10_000})
    plate = PlaceCollider('plate', 'mesh', corners(box_surface(0.04, 0.04, 0.003)), Pose())
    (_, why), = simulation.step([plate]).refused
    start, _, more = why.partition(', and there is room for 10000; raise effects.contact.')
    assert start.startswith("collider 'plate': its grid has ")
    more = int(more.removeprefix('mesh_nodes by '))
    simulation = particle({}, (0.0, 0.0, 0.2), contact={'mesh_nodes': 10_000 + more})
    assert not simulation.step([plate]).refused
    placed = simulation.effects['contact'].placed['plate'].field
    assert placed.values.size == 10_000 + more
    assert placed.values.min() < -0.5 * placed.spacing


def test_a_live_key_does_not_reload_the_file_of_a_mesh(tmp_path):
    entry = mesh(tmp_path / 'box.obj', box_surface(), spacing=0.05)
    simulation = particle({'s': entry}, (0.0, 0.0, 0.2 + R), friction=0.5, substeps=4)
    simulation.step([MoveCollider('s', Pose((0.0, 0.0, -0.1)))])
    (tmp_path / 'box.obj').unlink()
    assert not simulation.step([SetKey('colliders.s.friction', 0.1)]).refused
    frame = run(simulation, 60)
    np.testing.assert_allclose(frame.x[0], [0.0, 0.0, 0.1 + R], atol=1e-6)


@pytest.mark.parametrize('comes', ['with the scene', 'while it runs'])
def test_a_thickness_set_live_acts_as_one_given(tmp_path, comes):
    """A particle falls past a box, 0.11 m from its edge, one onto it; with the file gone too."""
    def falling(thickness, x):
        if comes == 'with the scene':
            simulation = particle({'s': mesh(tmp_path / 'box.obj', box_surface(), spacing=0.02)},
                                  x, contact={'thickness': thickness}, substeps=4)
            (tmp_path / 'box.obj').unlink()
            return simulation
        simulation = particle({}, x, contact={'thickness': thickness, 'mesh_nodes': 400_000},
                              substeps=4)
        simulation.step([PlaceCollider('s', 'mesh', corners(box_surface()), Pose())])
        return simulation

    half = box_surface()[0].max(0)
    for x in (half + [0.08, 0.08, 0.2], half * [0.1, 0.2, 1.0] + [0.0, 0.0, 0.2]):
        given, live = falling(0.1, x), falling(R, x)
        for k in range(40):
            expected = given.step()
            frame = live.step([SetKey('effects.contact.thickness', 0.1)] if k == 0 else ())
            np.testing.assert_array_equal(frame.x, expected.x)
        if x[0] > half[0]:
            np.testing.assert_array_equal(frame.x[0, :2], x[:2])
        else:
            assert frame.x[0, 2] == pytest.approx(half[2] + 0.1, abs=1e-6)


def test_a_live_thickness_without_room_for_its_grids_is_refused():
    simulation = particle({}, (0.0, 0.0, 0.9), contact={'thickness': 0.03, 'mesh_nodes': 60_000})
    crate = PlaceCollider('crate', 'mesh', corners(box_surface()), Pose())
    assert not simulation.step([crate]).refused
    (_, why), = simulation.step([SetKey('effects.contact.thickness', 0.001)]).refused
    start, _, missing = why.rpartition(' ')
    assert start == ('effects.contact.thickness: the grids of meshes for 0.001 m have no room; '
                     'raise effects.contact.mesh_nodes by')
    room = {'thickness': 0.03, 'mesh_nodes': 60_000 + int(missing)}
    simulation = particle({}, (0.0, 0.0, 0.9), contact=room)
    assert not simulation.step([crate]).refused
    assert not simulation.step([SetKey('effects.contact.thickness', 0.001)]).refused


def test_what_lies_on_ground_that_slopes_slides_with_g_sin():
    """A ramp of 3 in 4, its middle at the position."""
    ramp = {'heights': {'size': [4.0, 2.0], 'values': [[1.5, 0.0, -1.5]] * 2},
            'position': [0.0, 0.0, 2.0]}
    normal = np.array([0.6, 0.0, 0.8])
    simulation = particle({'s': ramp}, np.array([-1.2, 0.4, 2.9]) + R * normal, substeps=2)
    frame = run(simulation, 30)
    np.testing.assert_allclose(frame.v[0], 0.6 * GRAVITY * 0.5 * np.array([0.8, 0.0, -0.6]),
                               rtol=1e-9, atol=1e-12)
    assert (frame.x[0] - [0.0, 0.0, 2.0]) @ normal == pytest.approx(R, abs=1e-12)


def test_ground_is_where_its_table_says_with_rows_along_y(tmp_path):
    """From a file, in centimetres; the rim goes on."""
    table = np.array([[0.0, 10.0, 20.0], [30.0, 40.0, 50.0]])
    np.save(tmp_path / 'ground.npy', table)
    (tmp_path / 'ground.csv').write_text('0, 10, 20\n30, 40, 50\n')
    for file in ('ground.npy', 'ground.csv'):
        keys = {'size': [2.0, 1.0], 'file': str(tmp_path / file), 'scale': 0.01}
        for x, y, height in ((-1.0, -0.5, 0.0), (1.0, -0.5, 0.2), (0.5, 0.5, 0.45),
                             (0.0, 0.0, 0.25), (3.0, 2.0, 0.5)):
            simulation = particle({'s': {'heights': keys}}, (x, y, height + 0.5), substeps=8)
            for _ in range(60):
                frame = simulation.step()
                if frame.v[0, 2] > -1.0 and simulation.index > 10:
                    break
            assert frame.x[0, 2] == pytest.approx(height, abs=0.1)
            assert np.abs(frame.x[0, :2] - [x, y]).max() < 0.1


def test_a_bullet_does_not_pass_a_ridge():
    """From the side, at 100 m/s; the ridge is 0.2 m wide at its foot."""
    rows = [[0.0] * 20 + [1.0] + [0.0] * 20] * 2
    simulation = particle({'s': {'heights': {'size': [4.0, 4.0], 'values': rows}}},
                          (-1.0, 0.1, 0.3), gravity=(0, 0, 0))
    simulation.state.v[0, 0] = 100.0
    for _ in range(3):
        frame = simulation.step()
        assert frame.x[0, 0] < 0.0 or frame.x[0, 2] > 1.0


@pytest.mark.parametrize('speed', [1e13, 1e160, 1e300, np.inf, np.nan])
def test_a_particle_that_leaves_the_world_holds_nothing_up(tmp_path, speed):
    """Its way meets ground at 1e12 cells, or nowhere: the frame ends, and is taken back."""
    simulation = simulate((5, 1), (0.2, 0.2), pose={'position': [0.0, 0.0, R]}, colliders={
        'ground': {'heights': {'size': [2.0, 2.0], 'values': [[0.0] * 20] * 20}},
        'ball': {'sphere': {'radius': 0.5}, 'position': [0.1, 0.0, -0.5]},
        'crate': mesh(tmp_path / 'box.obj', box_surface(0.5, 0.5, 0.5), spacing=0.1)},
        scene_effects={'pin': {}, 'contact': {'thickness': R}, 'friction': {}})
    for k in range(3):
        simulation.state.v[k, simulation.slot[2]] = speed
        simulation.step()
        assert simulation.stats()['frames_taken_back'] == k + 1
        assert np.isfinite(simulation.frame().x).all()


def test_files_are_found_beside_the_scene(tmp_path):
    write(tmp_path / 'box.obj', box_surface())
    (tmp_path / 'ground.csv').write_text('0 0\n0 0\n')
    (tmp_path / 'scene.yaml').write_text(yaml.safe_dump({
        'cloths': {'c': {'grid': {'size': [1, 1], 'resolution': [2, 2]}, 'density': 1}},
        'colliders': {'a': {'mesh': {'file': 'box.obj', 'spacing': 0.1}},
                      'b': {'heights': {'file': 'ground.csv', 'size': [1, 1]}}},
        'effects': {'contact': {'thickness': R}}}))
    scene = load_scene(str(tmp_path / 'scene.yaml'))
    assert scene.raw['colliders']['a']['mesh']['file'] == str(tmp_path / 'box.obj')
    assert compile_scene(scene).effects['contact'].placed['b'].heights.shape == (2, 2)


def test_shapes_that_a_scene_lacks_have_no_arrays():
    colliders = particle({'s': {'plane': {}}}, (0, 0, 1)).effects['contact'].colliders
    assert (colliders.grids, colliders.heights) == (None, None)


@pytest.mark.parametrize('entry, text', [
    ({'mesh': {'file': '/no/such.obj'}}, 'mesh: no such file: /no/such.obj; restore it, or '
     'correct the path'),
    ({'mesh': {'file': 'OPEN'}}, 'mesh: FILE: is not closed (3 open edges), so it has no inside; '
     'close it, or use a box'),
    ({'mesh': {'file': 'OPEN', 'spacing': 0.0}}, 'mesh.spacing: must be > 0 m (got 0.0)'),
    ({'heights': {'size': [1, 1], 'values': [[1, 2], [1]]}},
     'heights: values: must be rows of equal length'),
    ({'heights': {'size': [1, 1], 'values': [[1, 2]]}},
     'heights: must be at least 2 rows of 2 heights (got (1, 2))'),
    ({'heights': {'size': [1, 1]}}, "heights: needs either 'values' or 'file', and only one of "
     'them')])
def test_a_shape_without_sense_is_refused(tmp_path, entry, text):
    file = write(tmp_path / 'open.obj', (box_surface()[0], box_surface()[1][1:]))
    for keys in entry.values():
        if keys.get('file') == 'OPEN':
            keys['file'] = file
    with pytest.raises(InputError) as error:
        particle({'s': entry}, (0, 0, 0))
    assert str(error.value) == f'small.yaml: colliders.s.{text.replace("FILE", file)}'
