"""A node that follows topics of other programs, over DDS."""

from geometry_msgs.msg import PoseStamped
import pytest
from std_msgs.msg import String

from support.logs import recorded_inputs
from support.node import Cloth, pose_stamped, targets, TOWEL
from support.repeated import repeated
from xpbd_ros.errors import InputError
from xpbd_ros.ros.topic_poses import KEPT, TopicPoses

SCENE = TOWEL + """
pins:
  hand: {cloth: towel, at: corner_00}
inputs:
  /tool_pose: {pin: hand, position: [0.0, 0.0, 0.1], frame_timeout: 30.0}
  trackers: {collider: ball, joint: ball, frame_timeout: 30.0}
"""


def test_pins_and_colliders_follow_topics_whose_type_is_found(start, peer, tmp_path):
    (tmp_path / 'scene.yaml').write_text(SCENE)
    run = tmp_path / 'run'
    cloth = Cloth(peer, start(scene=tmp_path / 'scene.yaml', record__path=str(run)))
    cloth.node.wait_for('running')
    assert cloth.status(lambda status: status['colliders'] == '1'), 'the ball is not there yet'
    other = peer.node.create_publisher(String, '/tool_pose', 1)
    cloth.node.wait_for('/tool_pose: refused: is std_msgs/msg/String, which moves no pin')
    peer.node.destroy_publisher(other)
    place = 0.0

    def moved() -> bool:
        nonlocal place
        place = min(place + 0.001, 0.2)
        for topic, message in (('/tool_pose', pose_stamped((-0.2, -0.2, place))),
                               ('/trackers', targets(ball=(0.0, 1.0, 0.5 + place)))):
            message.header.stamp = peer.node.get_clock().now().to_msg()
            peer.say(topic, message)
        return bool(cloth.pins) and (
            cloth.pins[-1].transforms[0].translation.z == pytest.approx(0.3, abs=1e-9))
    peer.until(moved, 'the pin at its offset from the last pose')
    assert cloth.status()['colliders'] == '2'
    assert cloth.node.end() == 0
    assert {topic for _, topic in recorded_inputs(run)} == {
        'colliders', 'collider_states', 'pin_targets'}
    repeated(run, tmp_path)


def test_messages_may_arrive_between_two_lookups():
    """A pose that another thread has replaced is refused, and the next lookup succeeds."""
    source = TopicPoses('/hand', 'world', lambda: None, lambda: 0)

    def take(stamp: int) -> None:
        message = pose_stamped((0.0, 0.0, 0.1 * stamp))
        message.header.stamp.sec = stamp
        source.take('geometry_msgs/msg/PoseStamped', message)
    take(1)
    stamp_ns = source.latest_ns('world', 'hand')
    for stamp in range(2, 2 + KEPT):
        take(stamp)
    with pytest.raises(InputError, match='/hand: the pose has been replaced by later ones'):
        source.pose('world', 'hand', stamp_ns)
    stamp_ns = source.latest_ns('world', 'hand')
    assert source.pose('world', 'hand', stamp_ns).position[2] == pytest.approx(0.1 * (1 + KEPT))
    source.clear()
    with pytest.raises(InputError, match='no pose on /hand'):
        source.pose('world', 'hand', stamp_ns)


def test_poses_that_tf_would_have_to_transform_are_refused_without_it(start, peer, tmp_path):
    peer.forget()
    peer.company.clear()
    (tmp_path / 'scene.yaml').write_text(SCENE)
    node = start(scene=tmp_path / 'scene.yaml')
    node.wait_for('running')

    def refused() -> list[str]:
        peer.say('/tool_pose', pose_stamped((0.0, 0.0, 0.0), frame_id='mars'), PoseStamped)
        return node.said('/tool_pose: refused:') or node.said('/tool_pose: no pose in ')
    peer.until(refused, 'the refusal')
