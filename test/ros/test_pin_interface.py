"""Pins of the scene by their own topics and services; clicks; saved and loaded states."""

from math import nan

from geometry_msgs.msg import PointStamped
import numpy as np
import pytest
from visualization_msgs.msg import MarkerArray

from support.logs import recorded_inputs, state_hashes
from support.node import Cloth, pin, PINNED, points, pose_stamped, targets
from support.repeated import repeated
from xpbd_ros.cli.main import main

LEFT, RIGHT = (-0.2, -0.2, 0.004), (0.2, -0.2, 0.004)


@pytest.fixture(scope='module')
def node(start, peer, tmp_path_factory):
    """Return a node with two pins in mode lockstep."""
    file = tmp_path_factory.mktemp('scene') / 'pins.yaml'
    file.write_text(PINNED)
    cloth = Cloth(peer, start(scene=file, mode='lockstep', publish_clock='true'))
    cloth.meet(pins=MarkerArray(), pin_targets=targets(), pin__left__target=pose_stamped(LEFT),
               pin__right__target=pose_stamped(RIGHT))
    peer.say('/cloth/clicked_point', clicked((9.0, 9.0, 9.0)))
    peer.until(lambda: cloth.step() and cloth.node.said('/cloth/clicked_point: refused: '),
               'the refusal')
    return cloth


@pytest.fixture
def cloth(node):
    """Return it at the start of its scene."""
    assert node.trigger('reset')[0]
    return node


def clicked(point, frame_id: str = 'world') -> PointStamped:
    """Return a message for ~/clicked_point."""
    message = PointStamped()
    message.header.frame_id = frame_id
    message.point.x, message.point.y, message.point.z = map(float, point)
    return message


def click(cloth, point) -> int:
    """Click, and return the next frame."""
    cloth.peer.say('/cloth/clicked_point', clicked(point))
    return cloth.step()


def test_a_pin_follows_its_own_target(cloth):
    assert list(cloth.pin_state(cloth.step())) == ['left', 'right']
    up = (-0.2, -0.15, 0.05)
    cloth.peer.say('/cloth/pin/left/target', pose_stamped(up))
    assert cloth.cloud(cloth.step(2))[0, 0] == pytest.approx(up, abs=1e-7)


def test_a_gripper_opens_moves_and_grasps_where_it_is(cloth):
    assert cloth.grasp('left', False) == (True, 'released 1 particle')
    frame = cloth.step()
    assert list(cloth.pin_state(frame)) == ['right']
    assert cloth.grasp('left', False) == (False, "pin 'left' holds nothing (holding: right)")
    cloth.peer.say('/cloth/pin/left/target', pose_stamped((-0.2, 0.2, 0.104)))
    cloth.step(10)
    good, said = cloth.grasp('left', True)
    assert not good
    assert said == ("pin 'left': no free particle within 0.02 m of [-0.2, 0.2, 0.104]; the "
                    'nearest is 0.1 m away')
    cloth.peer.say('/cloth/pin/left/target', pose_stamped((-0.2, 0.2, 0.014)))
    cloth.step(10)
    good, said = cloth.grasp('left', True)
    assert good
    assert said == 'holds 1 particle, the nearest 0.01 m away'
    assert cloth.grasp('left', True) == (True, f'already {said}')
    cloth.peer.say('/cloth/pin/left/target', pose_stamped((-0.2, 0.2, 0.214)))
    frame = cloth.step(20)
    assert cloth.cloud(frame)[8, 0] == pytest.approx([-0.2, 0.2, 0.204], abs=1e-3), 'other corner'


def test_a_pin_that_holds_several_says_how_many(cloth):
    assert cloth.grasp('right', False) == (True, 'released 3 particles')
    good, said = cloth.grasp('right', True)
    assert good
    assert said.startswith('holds 3 particles, the nearest 0')


def test_release_all_says_how_many(cloth):
    assert cloth.trigger('release_all') == (True, 'released 2 pins')
    assert cloth.pin_state(cloth.step()) == {}
    assert cloth.trigger('release_all') == (True, 'released 0 pins')


def test_services_act_after_the_messages_before_them(cloth):
    cloth.mark(pin('left', action=2), pin('right', action=2))
    cloth.peer.spin(0.2)
    assert cloth.trigger('release_all') == (True, 'released 0 pins')


def test_a_click_pins_the_nearest_particle_and_releases_it(cloth):
    frame = click(cloth, (0.01, 0.02, 0.01))
    assert list(cloth.pin_state(frame)) == ['left', 'right', 'clicked_0']
    cloth.aim(clicked_0=(0.0, 0.0, 0.1))
    frame = cloth.step(10)
    place = cloth.cloud(frame)[4, 4]
    assert place == pytest.approx([0.0, 0.0, 0.1], abs=1e-6)
    assert list(cloth.pin_state(click(cloth, place))) == ['left', 'right']
    assert list(cloth.pin_state(click(cloth, LEFT))) == ['right'], 'any pin'


def test_a_click_beside_the_cloth_is_refused_with_the_distance(cloth):
    click(cloth, (0.0, 0.0, 0.504))
    cloth.node.wait_for('/cloth/clicked_point: refused: ', 'no particle within 0.05 m of '
                        '[0.0, 0.0, 0.504]; the nearest is 0.5 m away')


def test_a_loaded_state_is_the_saved_one_and_time_goes_on(cloth):
    cloth.peer.say('/cloth/pin/left/target', pose_stamped((-0.2, -0.15, 0.3)))
    frame = cloth.step(5)
    assert cloth.trigger('save_state') == (True, f'saved the state of frame {frame}')
    assert cloth.step() == frame + 1, 'to save takes no frame'
    expected = [cloth.cloud(frame + 1), cloth.cloud(cloth.step())]
    assert cloth.trigger('release_all')[0]
    last = cloth.step(20)
    assert cloth.trigger('load_state') == (True, f'back at the saved state, in frame {last + 1}')
    found = [cloth.cloud(last + 1), cloth.cloud(cloth.step())]
    assert np.array_equal(found, expected)
    assert list(cloth.pin_state(last + 1)) == ['left', 'right']


def test_a_log_that_begins_between_a_release_and_its_frame_is_solved_again(cloth, tmp_path):
    """The initial state of the log includes the release, which must not be applied again."""
    run = str(tmp_path / 'run')
    assert cloth.set(record__path=run) == (True, '')
    assert cloth.grasp('left', False) == (True, 'released 1 particle')
    assert cloth.record(True) == (True, run)
    cloth.step(5)
    assert cloth.record(False) == (True, run)
    assert main(['resim', run]) == 0
    assert cloth.set(record__path='') == (True, '')


def test_an_invalid_target_is_refused_and_the_node_goes_on(cloth):
    cloth.peer.say('/cloth/pin/left/target', pose_stamped((0, nan, 0)))
    cloth.node.wait_for('/cloth/pin/left/target: refused: left: position or orientation is not')
    assert list(cloth.pin_state(cloth.step())) == ['left', 'right']


def play(cloth) -> None:
    """Use all of it, with motion between."""
    cloth.peer.say('/cloth/pin/left/target', pose_stamped((-0.2, -0.15, 0.2)))
    cloth.step(6)
    click(cloth, (0.0, 0.0, 0.004))
    assert cloth.trigger('save_state')[0]
    cloth.step(4)
    assert cloth.grasp('left', False)[0]
    assert cloth.grasp('right', False)[0]
    cloth.step(8)
    cloth.peer.say('/cloth/pin/right/target', pose_stamped((0.2, -0.2, 0.02)))
    cloth.step(3)
    cloth.grasp('right', True)
    assert cloth.set(solver__substeps=13, gravity=[0.5, 0.0, -9.0]) == (True, '')
    cloth.step(3)
    assert cloth.trigger('load_state')[0]
    cloth.step(5)
    assert cloth.trigger('release_all')[0]
    cloth.step(4)
    assert cloth.trigger('load_state')[0]
    cloth.step(4)


def test_a_run_with_all_of_it_is_repeated_from_its_log(node, tmp_path):
    run = tmp_path / 'run'
    node.restart(mode='lockstep', record__path=str(run))
    node.meet()
    assert node.trigger('load_state') == (False, 'no state has been saved'), 'a new simulation'
    play(node)
    assert node.record(False) == (True, str(run))
    kinds = {topic for _, topic in recorded_inputs(run)}
    assert kinds >= {'pins', 'pin_targets', 'clicked_point', 'saved_states', 'parameter_events'}
    hashes = state_hashes(run)
    assert len(set(hashes.values())) > 30
    assert repeated(run, tmp_path) == hashes


def test_an_inactive_node_refuses_them(node):
    assert node.go('deactivate')
    try:
        for service in ('save_state', 'load_state', 'release_all'):
            assert node.trigger(service) == (False, 'the node is not active')
        assert node.grasp('left', True) == (False, 'the node is not active')
    finally:
        assert node.go('activate')
    assert points(node.clouds[-1]).shape == (9, 9, 3)
