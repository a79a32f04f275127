"""The shipped robot over DDS: joint states close its fingers on a cloth, lift it, lay it down."""

from importlib.util import find_spec
import json
from pathlib import Path
import subprocess
import sys

from geometry_msgs.msg import TransformStamped
import numpy as np
import pytest
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from support.logs import recorded_inputs
from support.node import child_environment, Cloth, LATCHED, points, transform
from support.tiers import slow
from xpbd_ros.log.reader import LogReader
from xpbd_ros.scene.urdf import Description
from xpbd_ros.share import share_folder

pytestmark = pytest.mark.skipif(find_spec('yourdfpy') is None,
                                reason="yourdfpy is missing: pip install '.[robot]'")
ROBOTS = share_folder() / 'robots'
CENTRE = 10, 10


def publish_tf(peer) -> None:
    """Publish the poses of the links for each joint state, as robot_state_publisher does."""
    from tf2_msgs.msg import TFMessage
    description = Description(ROBOTS / 'two_finger.urdf')
    publisher = peer.node.create_publisher(TFMessage, '/tf', 100)

    def publish(message: JointState) -> None:
        description.move(dict(zip(message.name, message.position)))
        transforms = []
        for link in description.links[1:]:
            pose = description.pose(link)
            found = TransformStamped(header=message.header, child_frame_id=link,
                                     transform=transform(pose.position, pose.orientation))
            found.header.frame_id = 'world'
            transforms.append(found)
        publisher.publish(TFMessage(transforms=transforms))
    peer.node.create_subscription(JointState, '/joint_states', publish, 100)


def fingers_closed_in_the_air(cloth: Cloth) -> None:
    """See the refused grasp told and counted under the topic that it came by."""
    inputs = [info.qos_profile.reliability for info in
              cloth.peer.node.get_subscriptions_info_by_topic('/joint_states')
              if info.node_name == 'cloth']
    assert ReliabilityPolicy.RELIABLE in inputs, 'as all inputs'

    def refused() -> list[str]:
        message = JointState(name=['reach', 'lift', 'finger'], position=[0.4, 0.4, 0.004])
        message.header.stamp = cloth.peer.node.get_clock().now().to_msg()
        cloth.peer.say('/joint_states', message)
        return cloth.node.said("refused: pin 'arm_gripper': no free particle within 0.03 m")
    line, = cloth.peer.until(refused, 'the refusal')
    assert ' /joint_states: refused: ' in line
    status = cloth.status(lambda status: 'rejected /joint_states' in status)
    assert float(status['age_s /joint_states']) < 10.0
    assert 'rejected /cloth/pins' not in status


@pytest.mark.parametrize('follow', ['joint_states', pytest.param('tf', marks=pytest.mark.skipif(
    find_spec('tf2_ros') is None,
    reason='tf2_ros is missing: apt install ros-jazzy-tf2-ros-py'))])
def test_a_gripper_picks_up_a_cloth_and_lays_it_down(start, peer, tmp_path, follow):
    run, scene = tmp_path / 'run', tmp_path / 'robot.yaml'
    scene.write_text((ROBOTS / 'robot.yaml').read_text().replace(
        'follow: joint_states', f'follow: {follow}').replace(
            'two_finger.urdf', str(ROBOTS / 'two_finger.urdf')))
    if follow == 'tf':
        publish_tf(peer)
    cloth = Cloth(peer, start(scene=scene, record__path=str(run)))
    cloth.node.wait_for(f"robot 'arm': follows {follow}")
    cloth.node.wait_for('running')
    with subprocess.Popen([sys.executable, str(ROBOTS / 'two_finger_motion.py')],
                          env=child_environment()) as motion:
        try:
            def held() -> bool:
                return bool(cloth.pins) and cloth.pins[-1].joint_names == ['arm_gripper']

            def centre() -> np.ndarray:
                return points(cloth.clouds[-1])[CENTRE]
            peer.until(held, 'the grasp')
            assert centre() == pytest.approx([0.0, 0.0, 0.004], abs=5e-3)
            assert cloth.status()['colliders'] == '4'
            peer.until(lambda: centre()[2] > 0.2, 'the lift')
            corners = points(cloth.clouds[-1])[[0, 0, -1, -1], [0, -1, 0, -1]]
            assert corners[:, 2].max() < centre()[2] - 0.05, 'it hangs'
            peer.until(lambda: not held(), 'the release')
            peer.until(lambda: np.ptp(points(cloth.clouds[-1])[..., 2]) < 0.1, 'rest')
        finally:
            motion.kill()
    source = '/joint_states' if follow == 'joint_states' else 'TF'
    final = points(cloth.clouds[-1])
    assert final[CENTRE][0] == pytest.approx(0.2, abs=0.03)
    assert final[..., 2].min() > 0.0
    assert not cloth.node.said('refused'), cloth.node.lines
    cloth.node.wait_for(f'{source}: palm, ', ' silent for more than 1 s', 'arm_palm held',
                        'pin arm_gripper holds nothing')
    if follow == 'joint_states':
        fingers_closed_in_the_air(cloth)
    assert cloth.node.end() == 0
    assert {topic for _, topic in recorded_inputs(run)} == {
        'pins', 'pin_targets', 'colliders', 'collider_states'}
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', 'run', scene, '--commands', run,
         '-o', tmp_path / 'again', '--json', '-'],
        env=child_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    numbers = json.loads(done.stdout)
    assert numbers['commands']['identical']
    assert any('arm_palm (palm)' in note for note in numbers['notes'])


@pytest.mark.parametrize('sent', [True, slow(False)])
def test_a_description_on_a_topic_is_read_once_and_kept_in_the_log(start, peer, tmp_path, sent):
    """As robot_state_publisher latches it; without one the node says so and ends."""
    text = (ROBOTS / 'two_finger.urdf').read_text()
    scene, run = tmp_path / 'robot.yaml', tmp_path / 'run'
    scene.write_text((ROBOTS / 'robot.yaml').read_text().replace(
        'two_finger.urdf', '/arm/robot_description'))
    publisher = peer.node.create_publisher(String, '/arm/robot_description', LATCHED)
    if sent:
        publisher.publish(String(data=text))
    node = start(scene=scene, record__path=str(run))
    try:
        if not sent:
            said = node.wait_for('[ERROR]')
            assert f'{scene}: robots.arm.description: no description on ' in said
            assert '/arm/robot_description (std_msgs/String, transient local) in 10 s' in said
            assert node.process.wait(60) == 2
            return
        node.wait_for('waiting for /arm/robot_description')
        cloth = Cloth(peer, node)
        assert cloth.status()['colliders'] == '4'
        assert cloth.set(effects__contact__thickness=0.005) == (True, '')
        assert cloth.record(False)[0]
        assert cloth.record(True)[0], 'also after a live key changed the scene'
        second = Path(cloth.record(False)[1])
    finally:
        peer.node.destroy_publisher(publisher)
    assert node.end() == 0
    for log in (run, second if second.is_absolute() else node.output.parent / second):
        assert LogReader(log).attachments['robots.arm.description.urdf'] == text.encode()
