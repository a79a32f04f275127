"""What the node publishes: layout, stamps, quality of service, topics where called for."""

import time

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import pytest
import rclpy
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import MultiDOFJointState, PointCloud2, PointField
from shape_msgs.msg import Mesh
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from support.meshes import disc, obj_text
from support.node import Cloth, LATCHED, pin, points, stamp_ns, time_ns, TOWEL
from support.scenes import simulate
from xpbd_ros.log.reader import LogReader
from xpbd_ros.node_stress.node import TIMEOUT
from xpbd_ros.ros.cloth_node import ClothNode
from xpbd_ros.ros.outputs import Outputs
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_text
from xpbd_ros.sim.commands import Release

SHEET = """
cloths:
  sheet:
    grid: {size: [0.6, 0.2], resolution: [7, 5]}
    density: 0.2
    effects:
      stretch: {warp: 300.0, weft: 300.0}
solver: {method: gauss_seidel, integrator: backward_euler, substeps: 8}
"""
"""nothing but cloth, in free fall; seven particles along warp, five along weft"""


@pytest.fixture(scope='module')
def use(lockstep, tmp_path_factory):
    """Return a function that gives the node another scene."""
    folder = tmp_path_factory.mktemp('scenes')

    def use(text: str, **parameters) -> Cloth:
        file = folder / f'scene{len(list(folder.iterdir()))}.yaml'
        file.write_text(text)
        lockstep.restart(scene=str(file), **parameters)
        return lockstep
    return use


def first(cloth, kind, topic: str, qos=LATCHED):
    """Return the first message that a new subscriber gets."""
    heard = cloth.peer.hear(kind, topic, qos)
    cloth.peer.until(lambda: heard, topic)
    return heard[0]


def simulated(text: str, frames: int) -> np.ndarray:
    """Return the positions that a scene comes to, shape (particles, 3)."""
    simulation = compile_scene(scene_from_text(text, where='here', name='here'))
    for _ in range(frames):
        simulation.step()
    return simulation.frame().x.astype(np.float32)


def test_a_cloud_has_rows_along_weft_and_columns_along_warp(use):
    cloth = use(SHEET)
    cloth.peer.until(lambda: cloth.trigger('step')[0] and cloth.clouds, 'a cloud')
    cloud = cloth.clouds[-1]
    assert cloud.header.frame_id == 'world'
    assert (cloud.height, cloud.width) == (5, 7)
    assert cloud.fields == [PointField(name=name, offset=offset, datatype=PointField.FLOAT32,
                                       count=1) for name, offset in zip('xyz', (0, 4, 8))]
    assert (cloud.point_step, cloud.row_step, len(cloud.data)) == (12, 84, 420)
    assert (cloud.is_dense, cloud.is_bigendian) == (True, False)
    place = points(cloud)
    assert place[..., 0] == pytest.approx(np.tile(np.linspace(0.0, 0.6, 7), (5, 1)), abs=1e-6)
    assert place[..., 1] == pytest.approx(np.tile(np.linspace(0.0, 0.2, 5)[:, None], (1, 7)),
                                          abs=1e-6)


PINS = 'effects: {pin: {}}\n'
CORNER = 'pins: {a: {cloth: sheet, at: corner_00}}\n'
CONTACT = 'effects: {contact: {thickness: 0.004}}\n'
BALL = 'colliders: {ball: {sphere: {radius: 0.1}, position: [9, 0, 0]}}\n'
ONE = {'/cloth/markers', '/cloth/scene', '/cloth/recording', '/cloth/particles', '/cloth/mesh'}
OF_PINS = {'/cloth/pins', '/cloth/pin_targets', '/cloth/clicked_point'}
OF_A = {'/cloth/pin_states', '/cloth/pin/a/wrench'}
OF_COLLIDERS = {'/cloth/colliders', '/cloth/collider_states', '/cloth/collider/ball/pose'}


@pytest.mark.parametrize(('text', 'publishes', 'listens'), [
    (SHEET, ONE, set()),
    (SHEET + PINS, ONE | {'/cloth/pin_states'}, OF_PINS),
    (SHEET + CORNER, ONE | OF_A, OF_PINS | {'/cloth/pin/a/target'}),
    (SHEET + CONTACT, ONE | {'/cloth/collider_wrenches'},
     {'/cloth/colliders', '/cloth/collider_states'}),
    (SHEET + BALL + CONTACT, ONE | {'/cloth/collider_wrenches'}, OF_COLLIDERS),
    (SHEET + 'effects: {wind: {velocity: [1, 0, 0]}}\n', ONE, {'/cloth/wind'}),
], ids=['nothing', 'effects.pin', 'pins', 'effects.contact', 'colliders', 'effects.wind'])
def test_topics_follow_the_scene(use, text, publishes, listens):
    cloth = use(text)
    listens = {*listens, '/cloth/set_state'}
    cloth.peer.until(lambda: cloth.topics() == (publishes, listens), f'{publishes}, {listens}',
                     cloth.topics)


def test_several_cloths_have_topics_each(use):
    sheet, solver = SHEET.split('solver:')
    second = sheet.replace('cloths:\n', '').replace('sheet:', 'second:').replace(
        'density', 'pose: {position: [0, 0, 1]}\n    density').replace('[7, 5]', '[3, 4]')
    cloth = use(f'{sheet}{second}solver:{solver}')
    publishes = {'/cloth/markers', '/cloth/scene', '/cloth/recording', *(
        f'/cloth/cloth/{name}/{what}' for name in ('sheet', 'second')
        for what in ('particles', 'mesh'))}
    listens = {f'/cloth/cloth/{name}/set_state' for name in ('sheet', 'second')}
    cloth.peer.until(lambda: cloth.topics() == (publishes, listens), f'{publishes}',
                     cloth.topics)
    heard = {name: cloth.peer.hear(PointCloud2, f'/cloth/cloth/{name}/particles')
             for name in ('sheet', 'second')}
    cloth.peer.until(lambda: cloth.trigger('step')[0] and all(heard.values()), 'clouds')
    assert points(heard['sheet'][-1]).shape == (5, 7, 3)
    assert points(heard['second'][-1]).shape == (4, 3, 3)
    assert (points(heard['second'][-1])[..., 2] > 0.5).all()
    mesh = first(cloth, Mesh, '/cloth/cloth/second/mesh')
    assert len(mesh.vertices) == 12
    assert max(i for t in mesh.triangles for i in t.vertex_indices) == 11


def test_a_mesh_is_published_as_one_row_in_file_order(use, tmp_path):
    vertices, triangles = disc(2)
    (tmp_path / 'disc.obj').write_text(obj_text(vertices, triangles) + 'v 0 0 0\n')
    cloth = use(f'cloths: {{c: {{density: 0.2, mesh: {{file: {tmp_path}/disc.obj}}}}}}\n{PINS}')
    cloth.meet()
    cloth.mark(pin('hand', vertices[7]))
    frame = cloth.step(30)
    assert (cloth.clouds[-1].height, cloth.clouds[-1].width) == (1, 19)
    place = cloth.cloud(frame).reshape(-1, 3)
    assert place[7] == pytest.approx(vertices[7], abs=0.02), 'held, after a frame or two'
    assert place[:, :2] == pytest.approx(vertices[:, :2], abs=1e-6)
    assert (np.delete(place, 7, 0)[:, 2] < -0.5).all()
    mesh = first(cloth, Mesh, '/cloth/mesh')
    assert [t.vertex_indices.tolist() for t in mesh.triangles] == triangles.tolist()
    assert [[p.x, p.y, p.z] for p in mesh.vertices] == vertices.tolist()
    assert cloth.node.said('cloths.c.mesh: 1 vertex that no triangle uses; left out')
    heard = cloth.peer.hear(MarkerArray, '/cloth/markers')
    cloth.peer.until(lambda: cloth.trigger('step')[0] and heard, 'markers')
    assert len(heard[0].markers[0].points) == 3 * len(triangles)


def test_a_late_subscriber_can_rebuild_the_surface(use):
    cloth = use(TOWEL)
    cloth.meet()
    mesh = first(cloth, Mesh, '/cloth/mesh')
    vertices = np.array([[p.x, p.y, p.z] for p in mesh.vertices])
    triangles = np.array([t.vertex_indices for t in mesh.triangles])
    assert vertices == pytest.approx(simulated(TOWEL, 0), abs=1e-7)
    assert np.array_equal(np.unique(triangles), np.arange(81))
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    normals = 0.5 * np.cross(b - a, c - a)
    assert normals.sum(0) == pytest.approx([0.0, 0.0, 0.16]), 'its area, and its upper side'


def test_the_scene_topic_makes_the_same_simulation_again(use):
    """Overrides and what ``auto`` chose are in it; its cloud is the node's, bit for bit."""
    cloth = use(SHEET[:SHEET.index('solver')] + CORNER, frame_id='base_link')
    text = first(cloth, String, '/cloth/scene').data
    assert 'frame_id: base_link' in text
    assert f'substeps: {cloth.get("solver.substeps")[0]}' in text
    cloth.meet()
    frame = cloth.step(30)
    assert cloth.clouds[-1].header.frame_id == 'base_link'
    assert np.array_equal(cloth.cloud(frame).reshape(-1, 3), simulated(text, frame))
    assert cloth.set(gravity=[1.0, 0.0, -5.0]) == (True, '')
    cloth.step()
    heard = cloth.peer.hear(String, '/cloth/scene', LATCHED)
    cloth.peer.until(lambda: heard and 'gravity: [1.0, 0.0, -5.0]' in heard[-1].data,
                     'the scene as it runs now', lambda: heard)


def test_stamps_rise_whatever_happens(use):
    cloth = use(TOWEL, frame_id='')
    cloth.meet()
    frame = cloth.step(3)
    assert cloth.trigger('reset') == (True, f'back at the start, in frame {frame + 1}')
    assert cloth.step() == frame + 2, 'time goes on'
    cloth.peer.until(lambda: stamp_ns(cloth.clouds[-1]) == cloth.epoch_ns + time_ns(frame + 2),
                     'the last cloud')
    assert np.diff([stamp_ns(c) for c in cloth.clouds]) == pytest.approx(1e9 / 60.0, abs=1)
    assert cloth.set(mode='fast') == (True, ''), 'its own clock runs ahead'
    cloth.status(lambda status: int(status['frame']) > frame + 2000)
    assert cloth.set(mode='lockstep') == (True, '')
    assert cloth.go('deactivate', 'activate')
    seen = len(cloth.clouds)
    cloth.step()
    cloth.peer.until(lambda: len(cloth.clouds) > seen, 'a cloud')
    assert (np.diff([stamp_ns(c) for c in cloth.clouds]) > 0).all()
    last = stamp_ns(cloth.clouds[-1])
    cloth.restart()
    cloth.meet()
    assert cloth.step() < 100, 'from the start'
    assert stamp_ns(cloth.clouds[0]) > last


def test_everything_is_reliable_and_what_stays_is_latched(use):
    cloth = use(TOWEL)
    latched = {'mesh', 'scene'}
    for topic in ('particles', 'pin_states', 'collider_wrenches', 'markers', 'mesh', 'scene'):
        def offered(topic=topic):
            return cloth.peer.node.get_publishers_info_by_topic(f'/cloth/{topic}')
        cloth.peer.until(lambda offered=offered: len(offered()) == 1, topic)
        (info,) = offered()
        assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert info.qos_profile.durability == (
            DurabilityPolicy.TRANSIENT_LOCAL if topic in latched else DurabilityPolicy.VOLATILE)
    assert cloth.get('qos_overrides./cloth/particles.publisher.depth') == [5], 'overridable'


def test_markers_come_while_someone_listens(use):
    cloth = use(TOWEL)
    cloth.meet()
    cloth.mark(pin('hand', (-0.2, -0.2, 0.004)))
    cloth.step()
    heard = cloth.peer.hear(MarkerArray, '/cloth/markers')
    cloth.peer.until(lambda: cloth.trigger('step')[0] and len(heard) >= 2, 'markers')
    (surface,) = heard[0].markers
    assert (surface.type, surface.action) == (Marker.TRIANGLE_LIST, Marker.ADD)
    assert surface.color.a == 1.0
    corners = np.array([[p.x, p.y, p.z] for p in surface.points], np.float32)
    frame = round((stamp_ns(surface) - cloth.epoch_ns) * 60e-9)
    assert {tuple(p) for p in corners} == {
        tuple(p) for p in cloth.cloud(frame).reshape(-1, 3)}
    assert [(m.ns, m.type) for m in heard[1].markers if m.action == Marker.ADD] == [
        ('pins', Marker.SPHERE), ('forces', Marker.ARROW)]
    assert cloth.set(marker_rate=0.0) == (True, '')
    cloth.step()
    cloth.peer.spin(0.1)
    count = len(heard)
    cloth.step(20)
    cloth.peer.spin(0.2)
    assert len(heard) == count
    assert cloth.set(marker_rate=15.0) == (True, '')


def test_who_comes_late_to_a_paused_node_sees_its_cloth(use):
    cloth = use(TOWEL)
    cloth.meet()
    frame = cloth.step(3)
    heard = cloth.peer.hear(MarkerArray, '/cloth/markers')
    cloth.peer.until(lambda: len(heard) >= 4, 'markers without a step')
    (surface,) = heard[0].markers
    assert stamp_ns(surface) == cloth.epoch_ns + time_ns(frame)
    assert {tuple(map(np.float32, (p.x, p.y, p.z))) for p in surface.points} == {
        tuple(p) for p in cloth.cloud(frame).reshape(-1, 3)}


def test_the_wrench_of_the_cloth_on_each_collider(use):
    """A towel at rest on a table weighs m g, in every frame; its pose and twist are told too."""
    cloth = use(TOWEL)
    heard = cloth.peer.hear(MultiDOFJointState, '/cloth/collider_wrenches')
    cloth.meet()
    frame = cloth.step(20)
    cloth.peer.until(lambda: heard and stamp_ns(heard[-1]) == cloth.epoch_ns + time_ns(frame),
                     'a state of the colliders')
    state = heard[-1]
    assert state.header.frame_id == 'world'
    table = state.joint_names.index('table')
    assert len(state.wrench) == len(state.twist) == len(state.transforms) == len(state.joint_names)
    assert state.wrench[table].force.z == pytest.approx(-0.25 * 0.16 * 9.80665, rel=1e-3)
    assert state.twist[table].linear.z == 0.0
    assert state.transforms[table].rotation.w == 1.0


def test_publish_rate_is_a_divisor_of_the_frame_rate(use):
    cloth = use(TOWEL, publish_rate=20.0)
    cloth.peer.until(lambda: cloth.trigger('step')[0] and cloth.clouds and cloth.pins, 'a cloud')
    cloth.status()
    cloth.peer.until(lambda: cloth.step() % 3 == 0, 'a third frame')
    clouds, states = len(cloth.clouds), len(cloth.pins)
    frame = cloth.step(9)
    cloth.cloud(frame)
    cloth.pin_state(frame)
    expected = [cloth.epoch_ns + time_ns(n) for n in range(frame - 6, frame + 1, 3)]
    assert [stamp_ns(cloud) for cloud in cloth.clouds][-3:] == expected
    assert (len(cloth.clouds), len(cloth.pins)) == (clouds + 3, states + 3)
    assert cloth.set(publish_rate=0.0) == (True, '')
    cloth.step(3)
    cloth.peer.until(lambda: len(cloth.clouds) == clouds + 6, 'every frame')


def test_the_clock_tells_simulation_time(use):
    cloth = use(TOWEL, publish_clock=False)
    cloth.peer.until(lambda: not cloth.peer.node.get_publishers_info_by_topic('/clock'),
                     'no clock: only if asked for')
    cloth.restart(publish_clock=True)
    heard = cloth.peer.hear(Clock, '/clock')
    cloth.peer.until(lambda: cloth.trigger('step')[0] and heard, '/clock')
    cloth.meet()
    frame = cloth.step(5)
    expected = [cloth.epoch_ns + time_ns(n) for n in range(frame - 4, frame + 1)]
    cloth.peer.until(lambda: len(heard) >= 5, '/clock')
    assert [c.clock.sec * 10**9 + c.clock.nanosec for c in heard][-5:] == expected


def test_diagnostics_say_how_it_is_doing(use):
    cloth = use(TOWEL)
    heard = cloth.peer.hear(DiagnosticArray, '/diagnostics')
    cloth.meet()
    cloth.mark(pin('hand', (-0.2, -0.2, 0.004)))
    frame = cloth.step(20)
    status = cloth.status(lambda status: int(status['frame']) == frame)
    assert (status['level'], status['message']) == (b'\0', 'waiting')
    cloth.peer.until(lambda: heard, 'diagnostics')
    assert heard[-1].status[0].hardware_id == 'xpbd_ros'
    assert (status['pins'], status['substeps'], status['rejected_inputs']) == ('1', '20', '0')
    assert int(status['contacts']) > 40, 'it lies on the table'
    assert 0.0 < float(status['step_ms_p50']) <= float(status['step_ms_p95']) <= float(
        status['step_ms_max'])
    assert 0.0 <= float(status['age_s /cloth/pins']) < 60.0
    assert float(status['energy_j']) == pytest.approx(0.25 * 0.16 * 9.80665 * 0.004, rel=0.1)
    assert 0.0 <= float(status['strain_max']) < 0.01
    assert (status['dropped_frames'], status['bytes_recorded']) == ('0', '0')
    frame = cloth.step(40)
    status = cloth.status(lambda status: status['estimates'] == '1')
    assert 0.0 <= float(status['error_m']) <= float(status['error_m_largest']) < 0.001
    assert 0 < int(status['error_frame']) <= frame - 30
    assert 0.0 < float(status['estimates_share']) < 1.0
    assert float(status['effective_stiffness_share']) > 0.0
    assert 0.0 <= float(status['residual_m']) < 0.001
    assert cloth.set(mode='realtime') == (True, '')
    status = cloth.status(lambda status: float(status['real_time_factor']) > 0.0)
    assert status['message'] == 'stepping' or 'dropped' in status['message']
    assert cloth.set(mode='lockstep') == (True, '')


def test_markers_of_pins_wipe_what_was_there_and_name_each_once():
    """RViz wipes one namespace at a time, and takes a name that stands twice for a mistake."""
    simulation = simulate((3, 3), pins={'hand': {'cloth': 'c', 'at': 'corner_00'}})
    outputs = Outputs(simulation, 'world', '')
    frame = simulation.step()
    markers = drawn_markers(outputs, frame)
    wiped = {marker.ns for marker in markers if marker.action == Marker.DELETEALL}
    drawn = {marker.ns for marker in markers if marker.action == Marker.ADD}
    assert wiped == drawn == {'pins', 'forces'}
    assert len({(marker.ns, marker.id) for marker in markers}) == len(markers)
    hand = frame.pins['hand']
    ball, arrow = (marker for marker in markers if marker.action == Marker.ADD)
    assert place(ball.pose.position) == place(arrow.points[0]) == hand.pose.position
    assert place(arrow.points[1]) == tuple(np.add(hand.pose.position, 0.1 * hand.force))
    assert {(m.header.frame_id, stamp_ns(m)) for m in markers} == {('world', NOW)}
    markers = drawn_markers(outputs, simulation.step([Release('hand')]))
    assert [(m.ns, m.action) for m in markers] == [(ns, Marker.DELETEALL)
                                                   for ns in ('pins', 'forces')]


NOW = 1_234_567_890


def drawn_markers(outputs: Outputs, frame) -> list[Marker]:
    """Return the markers of pins, or else of colliders."""
    return deserialize_message(outputs.markers(frame, NOW)[1], MarkerArray).markers


def place(point) -> tuple[float, float, float]:
    """Return the coordinates of a point."""
    return point.x, point.y, point.z


def test_an_arrow_shows_where_and_how_the_cloth_pushes_each_collider():
    """It begins on the line of the force, here above the middle of the plane's load."""
    simulation = simulate((1, 1), pose={'position': [0.3, 0.2, 0.01]}, substeps=2, colliders={
        'floor': {'plane': {}}, 'far': {'sphere': {'radius': 0.1}, 'position': [5.0, 0.0, 0.0]}},
        scene_effects={'contact': {'thickness': 0.01}, 'friction': {}})
    wiped, arrow = drawn_markers(Outputs(simulation, 'world', ''), simulation.step())
    assert (wiped.action, wiped.ns, arrow.ns) == (Marker.DELETEALL, *['collider_forces'] * 2)
    start, tip = ([p.x, p.y, p.z] for p in arrow.points)
    assert start == pytest.approx([0.3, 0.2, 0.0], abs=1e-9)
    assert tip == pytest.approx([0.3, 0.2, -0.980665], abs=1e-9)


def test_only_topics_with_listeners_are_serialized(own_domain, towel, tmp_path):
    """A frame without listeners costs nothing to publish; a log has all topics."""
    rclpy.init(args=['--ros-args', '-p', f'scene:={towel}', '-p', 'mode:=lockstep',
                     '-r', '__ns:=/alone'])
    node, listener = ClothNode(), rclpy.create_node('listener')
    try:
        assert node.trigger_configure() == node.trigger_activate() == (
            TransitionCallbackReturn.SUCCESS)
        serialize, built = node.outputs.frame, []

        def noted(*arguments, **options):
            found = serialize(*arguments, **options)
            built.append(set(found))
            return found
        node.outputs.frame = noted

        def step() -> set[str]:
            node.stepper.ask(node.step).result(TIMEOUT)
            return built.pop()
        assert step() == set()
        listener.create_subscription(PointCloud2, '/alone/cloth/particles', built.append, 5)
        deadline = time.monotonic() + TIMEOUT
        while not node.topics.is_heard('particles'):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert step() == {'particles'}
        node.stepper.ask(lambda: node.start_recording(tmp_path / 'log')).result(TIMEOUT)
        built.clear()
        assert step() == {'particles', 'pin_states', 'collider_wrenches'}
    finally:
        node.close()
        node.destroy_node()
        listener.destroy_node()
        rclpy.try_shutdown()
    hashed = [m.frame for m in LogReader(tmp_path / 'log').messages({
        '/alone/cloth/state_hash'})]
    assert hashed == [2, 3]
