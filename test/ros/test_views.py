"""RViz and Foxglove: the shipped views, handles of pins, wrench topics, surface colours."""

import json
import re

from geometry_msgs.msg import Pose, WrenchStamped
import numpy as np
import pytest
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import (
    InteractiveMarkerFeedback,
    InteractiveMarkerUpdate,
    Marker,
    MarkerArray,
)
from visualization_msgs.srv import GetInteractiveMarkers
import yaml

from support.node import Cloth, PINNED, stamp_ns, targets, TOWEL
from xpbd_ros.ros.messages import colours
from xpbd_ros.ros.particle_fields import table
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.share import share_folder

VIEWS = share_folder() / 'views'
LEFT = (-0.2, -0.2, 0.004)


@pytest.fixture(scope='module')
def cloth(start, peer, tmp_path_factory):
    """Return a node with handles and coloured surfaces, in mode lockstep."""
    file = tmp_path_factory.mktemp('scene') / 'pinned.yaml'
    file.write_text(PINNED)
    cloth = Cloth(peer, start(scene=file, mode='lockstep', publish_clock='true',
                              interactive_markers='true', marker_color='force'))
    cloth.meet(pins=MarkerArray(), pin_targets=targets(), pin_handles__feedback=feedback(
        'left', InteractiveMarkerFeedback.POSE_UPDATE))
    return cloth


# the shipped views


def offered(cloth) -> tuple[dict, dict, dict]:
    """Return the node's publications, subscriptions and services: types by name."""
    node, name = cloth.peer.node, cloth.name.lstrip('/')
    cloth.topics()
    return tuple({topic: types[0] for topic, types in ask(name, '/')} for ask in (
        node.get_publisher_names_and_types_by_node, node.get_subscriber_names_and_types_by_node,
        node.get_service_names_and_types_by_node))


def test_rviz_finds_its_topics_at_the_node(cloth):
    manager = yaml.safe_load((VIEWS / 'cloth.rviz').read_text())['Visualization Manager']
    publishes, listens, serves = offered(cloth)
    displays = {entry['Topic']['Value']: entry['Class'].split('/')[1]
                for entry in manager['Displays'] if 'Topic' in entry}
    assert displays == {'/cloth/particles': 'PointCloud2', '/cloth/markers': 'MarkerArray'}
    for topic, kind in displays.items():
        assert publishes[topic].endswith(f'/msg/{kind}')
    (tool,) = (entry for entry in manager['Tools'] if 'Topic' in entry)
    assert tool['Class'] == 'rviz_default_plugins/PublishPoint'
    assert listens[tool['Topic']['Value']] == 'geometry_msgs/msg/PointStamped'
    (handles,) = (entry['Interactive Markers Namespace'] for entry in manager['Displays']
                  if entry['Class'].endswith('/InteractiveMarkers'))
    kind = 'visualization_msgs/msg/InteractiveMarker'
    assert publishes[f'{handles}/update'] == f'{kind}Update'
    assert listens[f'{handles}/feedback'] == f'{kind}Feedback'
    assert serves[f'{handles}/get_interactive_markers'] == (
        'visualization_msgs/srv/GetInteractiveMarkers')


def panels(part) -> list[str]:
    """Return the names of the panels in a part of Foxglove's layout."""
    return [part] if isinstance(part, str) else panels(part['first']) + panels(part['second'])


def test_foxglove_finds_its_topics_and_services_at_the_node(cloth):
    view = json.loads((VIEWS / 'cloth.foxglove.json').read_text())
    publishes, listens, serves = offered(cloth)
    assert sorted(panels(view['layout'])) == sorted(view['configById'])
    kinds = {name.split('!')[0] for name in view['configById']}
    assert kinds >= {'3D', 'Plot', 'CallService'}
    for name, about in view['configById'].items():
        if name.startswith('CallService!'):
            kind = SetBool if json.loads(about['requestPayload']) else Trigger
            assert serves[about['serviceName']] == f'std_srvs/srv/{kind.__name__}', name
            request = kind.Request(**json.loads(about['requestPayload']))
            assert isinstance(request, kind.Request)
    scene = view['configById']['3D!cloth']
    assert set(scene['topics']) <= set(publishes)
    assert listens[scene['publish']['pointTopic']] == 'geometry_msgs/msg/PointStamped'
    assert publishes[view['configById']['RawMessages!recording']['topicPath'].removesuffix(
        '.data')] == 'std_msgs/msg/String'
    status = cloth.status(lambda status: 'residual_m' in status)
    frame = cloth.step(45)    # after which errors have been estimated
    status = cloth.status(lambda status: int(status['frame']) >= frame and 'error_m' in status)
    for panel in (about for name, about in view['configById'].items() if name.startswith('Plot!')):
        for line in panel['paths']:
            topic, _, rest = line['value'].partition('.')
            if topic == '/diagnostics':
                name, key = re.fullmatch(r'status\[:\]\{name=="(.*?)"\}\.values\[:\]'
                                         r'\{key=="(.*?)"\}\.value', rest).groups()
                assert name == 'cloth: simulation'
                float(status[key])
            else:
                assert publishes[topic] == 'geometry_msgs/msg/WrenchStamped'
                value = WrenchStamped()
                for field in rest.split('.'):
                    value = getattr(value, field)
                assert value == 0.0


def test_the_views_fit_the_default_scene():
    assert list(load_scene('towel').sections['pins']) == ['left', 'right']


# wrenches


def test_a_pin_tells_its_wrench_as_pin_states_does(cloth):
    assert cloth.trigger('reset')[0]
    heard = cloth.peer.hear(WrenchStamped, '/cloth/pin/left/wrench')
    cloth.peer.until(lambda: cloth.trigger('step')[0] and heard, 'a wrench')
    cloth.aim(left=(-0.2, -0.2, 0.1))
    frame = cloth.step(10)
    expected = cloth.pin_state(frame)['left'][2]
    found = cloth.peer.until(lambda: next((m for m in heard if stamp_ns(m) == stamp_ns(
        cloth.pins[-1])), None), 'its wrench')
    assert found.wrench == expected
    assert found.wrench.force.z < -0.01
    assert found.header.frame_id == 'world'
    assert cloth.grasp('left', False)[0]
    cloth.step()
    cloth.peer.until(lambda: heard[-1].wrench == WrenchStamped().wrench, 'no wrench while open')


# handles


def handles(cloth) -> dict[str, Pose]:
    """Return where all handles are, by name."""
    answer = cloth.peer.ask(GetInteractiveMarkers, '/cloth/pin_handles/get_interactive_markers')
    for marker in answer.markers:
        assert [entry.title for entry in marker.menu_entries] == ['grasp', 'release']
        assert len(marker.controls) == 7
        assert marker.header.frame_id == 'world'
    return {marker.name: marker.pose for marker in answer.markers}


def feedback(name: str, event: int, *, place=LEFT, entry: int = 0,
             frame_id: str = 'world') -> InteractiveMarkerFeedback:
    """Return a message of RViz about a handle."""
    message = InteractiveMarkerFeedback(client_id='rviz', marker_name=name, event_type=event,
                                        menu_entry_id=entry)
    message.header.frame_id = frame_id
    p = message.pose.position
    p.x, p.y, p.z = map(float, place)
    message.pose.orientation.w = 1.0
    return message


def test_a_dragged_handle_moves_its_pin_and_its_menu_opens_and_closes_it(cloth):
    assert cloth.trigger('reset')[0]
    cloth.step(30)
    updates = cloth.peer.hear(InteractiveMarkerUpdate, '/cloth/pin_handles/update')
    cloth.peer.until(lambda: handles(cloth)['left'].position.z < 0.005, 'the handles')
    assert list(handles(cloth)) == ['left', 'right']
    topic = '/cloth/pin_handles/feedback'
    cloth.peer.say(topic, feedback('left', InteractiveMarkerFeedback.POSE_UPDATE,
                                   place=(-0.2, -0.15, 0.1)))
    frame = cloth.step(5)
    assert cloth.cloud(frame)[0, 0] == pytest.approx([-0.2, -0.15, 0.1], abs=1e-7)
    cloth.peer.until(lambda: handles(cloth)['left'].position.z == 0.1, 'the handle up there')
    cloth.peer.until(lambda: any(pose.name == 'left' and pose.pose.position.z == 0.1
                                 for update in updates for pose in update.poses), 'an update')
    numbers = [update.seq_num for update in updates]
    assert numbers == sorted(numbers)
    assert all(bool(b.poses) == (b.seq_num > a.seq_num) for a, b in zip(updates, updates[1:]))
    menu = InteractiveMarkerFeedback.MENU_SELECT
    cloth.peer.say(topic, feedback('left', menu, entry=2))
    cloth.node.wait_for(f'{topic}: released 1 particle')
    assert list(cloth.pin_state(cloth.step())) == ['right']
    cloth.peer.say(topic, feedback('left', menu, entry=1))
    cloth.peer.until(lambda: cloth.node.said(f'{topic}: holds 1 particle')
                     or cloth.node.said(f'{topic}: refused: ', 'no free particle'), 'an answer')


def test_feedback_without_sense_is_refused_and_the_node_goes_on(cloth):
    topic, moved = '/cloth/pin_handles/feedback', InteractiveMarkerFeedback.POSE_UPDATE
    for message, reason in [
            (feedback('none', moved), "no handle is called 'none'"),
            (feedback('left', moved, frame_id='map'), "TF frame 'map' is not the scene's")]:
        cloth.peer.spin(1.1)    # one warning a second and topic
        cloth.peer.say(topic, message)
        cloth.node.wait_for(f'{topic}: refused: ', reason)
    cloth.step()


def test_handles_of_an_inactive_node_do_nothing(cloth):
    topic, selected = '/cloth/pin_handles/feedback', InteractiveMarkerFeedback.MENU_SELECT
    assert cloth.go('deactivate')
    cloth.peer.spin(1.1)
    cloth.peer.say(topic, feedback('left', selected, entry=1))
    cloth.node.wait_for(f'{topic}: refused: the node is not active')
    assert cloth.go('activate')


# colours


def test_surfaces_are_coloured_by_the_force_in_them(cloth):
    assert cloth.trigger('reset')[0]
    cloth.aim(left=(-0.2, -0.2, 0.3), right=(0.2, -0.2, 0.3))
    cloth.step(60)
    heard = cloth.peer.hear(MarkerArray, '/cloth/markers')
    cloth.peer.until(lambda: cloth.trigger('step')[0] and any(
        marker.ns == 'towel' for array in heard for marker in array.markers), 'a surface')
    surface = next(m for array in heard for m in array.markers if m.ns == 'towel')
    assert surface.type == Marker.TRIANGLE_LIST
    assert len(surface.colors) == len(surface.points) == 3 * 2 * 64
    red = {(round(p.x, 3), round(p.y, 3)): c.r - c.b
           for p, c in zip(surface.points, surface.colors)}
    high = max(surface.points, key=lambda p: p.z)
    assert red[round(high.x, 3), round(high.y, 3)] > 0.3, 'the pins carry the weight'
    low = min(surface.points, key=lambda p: p.z)
    assert red[round(low.x, 3), round(low.y, 3)] < -0.3, 'nothing hangs from the lowest'
    assert all(c.a == 1.0 for c in surface.colors)


def test_colours_go_from_blue_over_white_to_red():
    found = colours(np.array([0.0, 0.05, 0.1]), 0.01)
    assert found[0].tolist() == pytest.approx([0.15, 0.3, 0.75, 1.0])
    assert found[1].tolist() == pytest.approx([0.95, 0.95, 0.95, 1.0])
    assert found[2].tolist() == pytest.approx([0.8, 0.1, 0.1, 1.0])
    assert colours(np.array([0.001]), 0.01)[0, 2] > 0.7, 'little is blue, whatever is largest'


def test_ids_count_from_the_first_particle_of_each_cloth():
    scene = yaml.safe_load(TOWEL)
    scene['cloths']['other'] = scene['cloths']['towel']
    simulation = compile_scene(scene_from_mapping(scene, where='two', name='two'))
    for cloth in simulation.cloths:
        found = table(('id',), cloth, simulation.frame())[:, 3].copy().view('<u4')
        assert found.tolist() == list(range(81))
