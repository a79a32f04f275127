"""``~/set_state``: a cloth starts where a cloud saw it; fields of clouds; the log's path."""

from math import inf, nan

import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import String

from support.logs import recorded_inputs, state_hashes
from support.meshes import disc, obj_text
from support.node import Cloth, LATCHED, pin, TOWEL
from support.repeated import repeated
from support.scenes import run
from xpbd_ros.errors import InputError
from xpbd_ros.ros.clouds import points_of
from xpbd_ros.ros.set_state import CloudStates, filled, registered, rigidly_moved
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_text
from xpbd_ros.sim.commands import Grasp, MovePin, Pose, Release, SetState
from xpbd_ros.sim.measure import normals, strains

TOPIC = '/cloth/set_state'
FIELDS = 'velocity normal strain pinned id'


def cloud(points, *, frame_id: str = 'world', dtype='<f4', dense: bool = True,
          names: str = 'x y z', padding: int = 0, row_padding: int = 0) -> PointCloud2:
    """Return a cloud of points, shape (rows, columns, 3)."""
    points = np.asarray(points, float)
    size = np.dtype(dtype).itemsize
    message = PointCloud2(height=points.shape[0], width=points.shape[1], is_dense=dense,
                          is_bigendian=dtype.startswith('>'))
    message.header.frame_id = frame_id
    message.fields = [PointField(
        name=name, offset=padding + size * k, count=1,
        datatype=PointField.FLOAT32 if size == 4 else PointField.FLOAT64)
        for k, name in enumerate(names.split())]
    message.point_step = padding + 3 * size + padding
    message.row_step = message.point_step * message.width + row_padding
    data = np.zeros((message.height, message.row_step), np.uint8)
    for row, line in zip(data, points):
        part = row[:message.point_step * message.width].reshape(-1, message.point_step)
        part[:, padding:padding + 3 * size] = line.astype(dtype).view(np.uint8).reshape(
            len(line), -1)
    message.data.frombytes(data.tobytes())
    return message


def simulation():
    """Return the towel's simulation, without a node."""
    return compile_scene(scene_from_text(TOWEL, where='towel', name='towel'))


def corner_at(*place: float) -> np.ndarray:
    """Return the towel a second after a corner went somewhere [m], shape (9, 9, 3)."""
    towel = simulation()
    towel.step([Grasp('hand', Pose((-0.2, -0.2, 0.004)), 0.01)])
    run(towel, 60, [MovePin('hand', Pose(place))])
    return towel.frame().x.reshape(9, 9, 3)


@pytest.fixture(scope='module')
def lifted() -> np.ndarray:
    """Return the towel with a corner lifted by 10 cm and carried inward, shape (9, 9, 3)."""
    return corner_at(-0.12, -0.12, 0.1)


def sampled(grid: np.ndarray, *, shift=(0.0, 0.0, 0.0), noise: float = 0.0) -> np.ndarray:
    """Return points between those of a grid, in any order, shape (1, n, 3)."""
    random = np.random.default_rng(5)
    at = random.uniform(0.0, 8.0, (6000, 2))
    at[:400, 0], at[400:800, 1] = random.choice([0.0, 8.0], (2, 400))    # a seen edge is sharp
    cell = np.minimum(at.astype(int), 7)
    s, t = (at - cell).T[:, :, None]
    (r, c) = cell.T
    found = ((1 - s) * ((1 - t) * grid[r, c] + t * grid[r, c + 1])
             + s * ((1 - t) * grid[r + 1, c] + t * grid[r + 1, c + 1]))
    return (found + shift + random.normal(0.0, noise, found.shape))[None] if noise else (
        found + shift)[None]


@pytest.fixture(scope='module')
def node(start, peer, towel):
    """Return a node in mode lockstep whose clouds have all fields there are."""
    cloth = Cloth(peer, start(scene=towel, mode='lockstep', publish_clock='true',
                              particle_fields=f'"{FIELDS}"', marker_color='strain'))
    cloth.meet()
    peer.say(TOPIC, cloud(np.zeros((1, 1, 3))))
    cloth.node.wait_for(f'{TOPIC}: refused: ')
    return cloth


@pytest.fixture
def cloth(node):
    """Return it at the start of its scene."""
    assert node.trigger('reset')[0]
    return node


def last(cloth) -> dict[str, np.ndarray]:
    """Return the fields of the next frame's cloud."""
    frame = cloth.step()
    message = cloth._of_frame(cloth.clouds, frame)
    kinds = {PointField.FLOAT32: '<f4', PointField.UINT8: 'u1', PointField.UINT32: '<u4'}
    kind = np.dtype({'names': [f.name for f in message.fields], 'itemsize': message.point_step,
                     'formats': [kinds[f.datatype] for f in message.fields],
                     'offsets': [f.offset for f in message.fields]})
    table = np.frombuffer(message.data, kind).reshape(message.height, message.width)
    return {name: table[name] for name in kind.names}


def xyz(fields) -> np.ndarray:
    """Return positions, shape (rows, columns, 3)."""
    return np.stack([fields[name] for name in 'xyz'], axis=-1)


def test_an_organized_cloud_maps_one_to_one(cloth, lifted):
    cloth.peer.say(TOPIC, cloud(lifted))
    found = last(cloth)
    # a frame of free fall from rest, less in contact with the table
    assert np.abs(xyz(found) - lifted)[..., :2].max() < 2e-3
    assert np.abs(xyz(found) - lifted)[..., 2].max() < 4e-3
    assert np.abs(found['vz']).max() < 0.3, 'from rest'
    cloth.node.wait_for(f"{TOPIC}: 'towel' is at 81 points, one to one")


def test_missing_points_come_from_their_neighbours(cloth, lifted):
    seen = lifted.copy()
    seen[3, 3] = seen[4, 3] = seen[8, 8] = nan
    cloth.peer.say(TOPIC, cloud(seen, dense=False))
    found = xyz(last(cloth))
    assert np.isfinite(found).all()
    assert np.linalg.norm(found - lifted, axis=-1).max() < 0.06
    cloth.node.wait_for(f"{TOPIC}: 'towel' is at 81 points, one to one, 3 of them from their")
    assert cloth.status(lambda s: 'set_state_filled' in s)['set_state_filled'] == '3'


def test_any_other_cloud_is_registered_and_the_residual_is_told(cloth):
    """A cloth that lies elsewhere is found as it lies."""
    flat = simulation().frame().x.reshape(9, 9, 3)
    shift = np.array([0.03, -0.02, 0.0])
    cloth.peer.say(TOPIC, cloud(sampled(flat, shift=shift, noise=5e-4)))
    found = xyz(last(cloth))
    assert np.linalg.norm(found - flat - shift, axis=-1).max() < 0.01
    said = cloth.node.wait_for(f"{TOPIC}: 'towel' is registered to 6000 points: 81 of 81")
    status = cloth.status(lambda s: 'set_state_residual_m' in s)
    residual = float(status['set_state_residual_m'])
    assert 0.0 < residual < 0.003
    assert f'residual {residual:.3g} m RMS' in said
    assert residual <= float(status['set_state_residual_max_m']) < 0.01


def test_a_registered_cloth_takes_the_shape_of_the_cloud(cloth):
    seen = corner_at(-0.17, -0.17, 0.05)
    cloth.peer.say(TOPIC, cloud(sampled(seen, noise=5e-4)))
    found = xyz(last(cloth))
    assert np.linalg.norm(found - seen, axis=-1).max() < 0.015
    cloth.node.wait_for('; 0 points further than 0.05 m from the cloth')


def test_what_a_registration_did_not_find_is_told(cloth, lifted):
    """The corner is further from its place in the cloud than the radius."""
    cloth.peer.say(TOPIC, cloud(sampled(lifted, noise=5e-4)))
    found = xyz(last(cloth))
    assert found[0, 0, 2] < 0.02
    status = cloth.status(lambda s: int(s.get('set_state_points_left', 0)) > 0)
    cloth.node.wait_for(f'; {status["set_state_points_left"]} points further than')
    edges = np.linalg.norm(np.diff(found, axis=1), axis=-1)
    assert edges == pytest.approx(0.05, rel=0.05), 'but nothing is torn'


def test_pinned_particles_stay_at_their_pins(cloth, lifted):
    cloth.mark(pin('hand', (0.2, 0.2, 0.004)))
    cloth.step()
    cloth.peer.say(TOPIC, cloud(lifted + [0.0, 0.0, 0.05]))
    found = xyz(last(cloth))
    assert found[8, 8] == pytest.approx([0.2, 0.2, 0.004], abs=1e-6)
    assert found[0, 0, 2] > 0.13


def bad(lifted) -> dict[str, tuple]:
    """Return clouds that are refused, by the reason."""
    hole, far = lifted.copy(), lifted.copy()
    hole[0, 0] = nan
    far[2, 2, 1] = inf
    gone = np.where(np.arange(9)[:, None, None] < 6, nan, lifted)
    cut = cloud(lifted)
    cut.data = cut.data[:-1]
    whole = cloud(lifted)
    for field in whole.fields:
        field.datatype = PointField.INT32
    return {
        "header: TF frame 'camera' is not the scene's 'world'": cloud(lifted, frame_id='camera'),
        'fields: no y, z (there are: x, v, w)': cloud(lifted, names='x v w'),
        'fields: x must be one float32 or float64': whole,
        'a point is infinite, or further than': cloud(far),
        'NaN in 1 point, and the cloud says is_dense': cloud(hole),
        '54 of 81 points are missing: too many to fill': cloud(gone, dense=False),
        "80 points, and 'towel' has 81 particles: too few": cloud(lifted.reshape(1, -1, 3)[
            :, :80]),
        "particles of 'towel' have a point within 0.05 m: too few": cloud(
            sampled(lifted, shift=(3.0, 0.0, 0.0))),
        '9 rows of 9 points of 12 bytes, row_step 108: and there are 971 bytes': cut,
    }


def test_clouds_that_cannot_be_are_refused_with_the_reason(lifted):
    towel, said = simulation(), []
    states = CloudStates(towel.save, lambda: 0.05, said.append)
    for reason, message in bad(lifted).items():
        with pytest.raises(InputError) as error:
            states.read(message, 'world', towel.cloths[0])
        assert reason in str(error.value)
        assert '\n' not in str(error.value)
    assert (said, states.values) == ([], {})


def test_a_run_with_clouds_is_repeated_from_its_log(node, lifted, tmp_path):
    """And the log's path is told while there is one."""
    heard = node.peer.hear(String, '/cloth/recording', LATCHED)
    run_to = tmp_path / 'run'
    node.restart(mode='lockstep', record__path=str(run_to))
    node.peer.until(lambda: heard and heard[-1].data == str(run_to), 'the path')
    assert node.trigger('save_state')[0]
    node.step(3)
    node.peer.say(TOPIC, cloud(lifted))
    node.step(5)
    node.mark(pin('hand', tuple(lifted[8, 8])))
    node.step(2)
    node.peer.say(TOPIC, cloud(sampled(lifted, shift=(0.01, 0.0, 0.02), noise=1e-3)))
    node.step(5)
    assert node.trigger('load_state')[0]
    node.step(5)
    assert node.record(False) == (True, str(run_to))
    node.peer.until(lambda: heard[-1].data == '', 'its end')
    inputs = [topic for _, topic in recorded_inputs(run_to)]
    assert inputs == ['saved_states', 'set_state', 'pins', 'set_state', 'saved_states']
    hashes = state_hashes(run_to)
    assert repeated(run_to, tmp_path) == hashes
    assert len(set(hashes.values())) > 18
    good, path = node.record(True)
    assert good
    node.peer.until(lambda: heard[-1].data == path, 'the path')
    assert node.record(False) == (True, path)


def test_fields_of_the_cloud_on_request(cloth, lifted):
    cloth.mark(pin('hand', (-0.2, -0.2, 0.004)))
    cloth.step()
    cloth.aim(hand=(-0.2, -0.2, 0.104))
    towel = simulation()
    towel.step()
    cloth.step(3)
    found = last(cloth)
    assert list(found) == [*'xyz', 'vx', 'vy', 'vz', 'normal_x', 'normal_y', 'normal_z',
                           'strain', 'pinned', 'id']
    assert (found['id'] == np.arange(81).reshape(9, 9)).all()
    assert found['pinned'].sum() == found['pinned'][0, 0] == 1
    x = xyz(found).reshape(-1, 3).astype(float)
    here = towel.cloths[0]
    normal = np.stack([found[f'normal_{axis}'] for axis in 'xyz'], -1).reshape(-1, 3)
    assert normal == pytest.approx(normals(here, x), abs=1e-4)
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1.0, abs=1e-6)
    assert normal[40, 2] > 0.9, 'up'
    assert found['strain'].ravel() == pytest.approx(strains(here, x), abs=1e-5)
    assert found['strain'].max() > 0.0


# parts, without a node


@pytest.mark.parametrize('dtype', ['<f4', '>f4', '<f8', '>f8'])
@pytest.mark.parametrize(('padding', 'row_padding'), [(0, 0), (5, 7)])
def test_clouds_of_any_layout_are_read(dtype, padding, row_padding):
    points = np.random.default_rng(1).normal(size=(3, 4, 3)).astype(dtype).astype(float)
    message = cloud(points, dtype=dtype, padding=padding, row_padding=row_padding)
    assert (points_of(message) == points).all()


def test_holes_are_filled_ring_by_ring_from_the_four_neighbours():
    here = simulation().cloths[0]
    row, column = np.divmod(np.arange(81), 9)
    points = np.stack([column, row, row * 0], 1).astype(float)
    holes = points.copy()
    holes[[40, 0, 1, 9]] = nan
    found = filled(holes, here)
    assert found[40].tolist() == [4.0, 4.0, 0.0], 'the mean of four'
    assert found[1].tolist() == [1.5, 0.5, 0.0], 'of those that are there'
    assert found[9].tolist() == [0.5, 1.5, 0.0]
    assert found[0].tolist() == [1.0, 1.0, 0.0], 'the next ring'
    kept = np.isfinite(holes).all(1)
    assert (found[kept] == points[kept]).all()


def test_holes_in_a_mesh_are_filled_along_its_edges(tmp_path):
    vertices, triangles = disc(2)
    (tmp_path / 'disc.obj').write_text(obj_text(vertices, triangles))
    here = compile_scene(scene_from_text(
        f'cloths: {{c: {{density: 0.2, mesh: {{file: {tmp_path}/disc.obj}}}}}}', where='disc',
        name='disc')).cloths[0]
    holes = np.array(vertices, float)
    holes[0] = nan
    ring = [sum(edge) for edge in here.mesh.edges.tolist() if 0 in edge]
    assert filled(holes, here)[0] == pytest.approx(np.mean(np.array(vertices)[ring], axis=0))
    holes[1:11] = nan
    with pytest.raises(InputError, match='11 of 19 points are missing: too many to fill'):
        filled(holes, here)


def test_nothing_drives_the_cloth_while_it_is_registered():
    """Neither a pin on its way nor the speed that noise would give stiff cloth."""
    text = TOWEL.replace('resolution: [9, 9]', 'resolution: [33, 33]') + """
pins: {a: {cloth: towel, at: corner_00, motion: [[0, -0.2, -0.2, 0.004], [0.1, 0, 0, 1]]}}
"""
    towel = compile_scene(scene_from_text(text, where='towel', name='towel'))
    towel.step()
    flat = towel.frame().x
    noise = np.random.default_rng(3).normal(0.0, 0.003, (10 * len(flat), 3))
    found = registered(np.repeat(flat, 10, axis=0) + noise, towel.save().simulation(),
                       towel.cloths[0], 0.05)
    assert np.linalg.norm(found.x - flat, axis=1).max() < 0.015
    free = towel.save().simulation()
    frame = free.step([Release('a'), SetState('towel', tuple(found.x.ravel().tolist()))])
    assert np.abs(frame.v).max() < 1.0


def test_a_rigid_motion_is_found_again():
    random = np.random.default_rng(2)
    x = random.normal(size=(20, 3))
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    there = x @ turn.T + [1.0, 2.0, 3.0]
    assert rigidly_moved(x, x[:9], there[:9]) == pytest.approx(there)
    flat = x * [1.0, 1.0, 0.0]
    assert rigidly_moved(flat, flat, flat @ turn.T) == pytest.approx(flat @ turn.T), 'no mirror'
