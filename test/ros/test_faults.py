"""What goes wrong around a node: it goes on, or ends well, and the log holds what there was."""

from pathlib import Path
import resource
import signal
import time

from lifecycle_msgs.srv import GetState
import numpy as np
import pytest
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from support.node import Cloth, collider, pin, points, pose_stamped, stamp_ns, targets, TOWEL
from support.tiers import slow
from xpbd_ros.log.reader import LogReader

ROOMY = TOWEL.replace('max_pins: 4', 'max_pins: 128').replace(
    'contact: {thickness', 'contact: {max_colliders: 128, thickness')
HUNDRED = 100


@pytest.fixture(scope='module')
def run(tmp_path_factory) -> Path:
    """Return where the node records to."""
    return tmp_path_factory.mktemp('log') / 'run'


@pytest.fixture(scope='module')
def cloth(start, peer, tmp_path_factory, run) -> Cloth:
    """Return a node in real time, with room for many pins and colliders, that records."""
    file = tmp_path_factory.mktemp('scene') / 'roomy.yaml'
    file.write_text(ROOMY)
    cloth = Cloth(peer, start(scene=file, record__path=run))
    peer.until(lambda: cloth.clouds and cloth.statuses, 'the node')
    return cloth


def goes_on(cloth: Cloth, frames: int = 20) -> None:
    """Wait for more frames, all of them finite, with stamps that rise."""
    count = len(cloth.clouds)
    cloth.peer.until(lambda: len(cloth.clouds) >= count + frames, 'more frames')
    stamps = [stamp_ns(cloud) for cloud in cloth.clouds[-frames:]]
    assert stamps == sorted(set(stamps))
    assert np.isfinite(points(cloth.clouds[-1])).all()
    assert not cloth.node.said('Traceback'), cloth.node.lines


def test_another_node_of_the_same_name_is_reported(cloth, peer):
    twin = rclpy.create_node(cloth.name.lstrip('/'), context=peer.node.context)
    told = f'another node is also named {cloth.name}'
    status = cloth.status(lambda status: told in status['message'])
    assert status['level'] == b'\1', status
    twin.destroy_node()
    cloth.status(lambda status: told not in status['message'])


def stopped_for(cloth: Cloth, seconds: float) -> None:
    """Stop the process, as a debugger or a suspended machine does, and let it go on."""
    before = int(cloth.status()['dropped_frames'])
    cloth.node.process.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    cloth.node.process.send_signal(signal.SIGCONT)
    status = cloth.status(lambda status: int(status['dropped_frames']) > before)
    assert status['level'] == b'\1', status
    assert ' dropped in the last second' in status['message']
    goes_on(cloth)
    dropped = int(status['dropped_frames']) - before
    assert dropped >= 0.8 * 60.0 * seconds, 'not made up for'


def test_a_stop_of_a_second_is_not_made_up_for(cloth):
    stopped_for(cloth, 1.0)


@pytest.mark.slow
def test_a_stop_of_ten_seconds_is_not_made_up_for(cloth):
    stopped_for(cloth, 10.0)


def test_a_subscriber_that_never_reads_blocks_no_other(cloth, context):
    from rclpy.node import Node
    deaf = Node('deaf', context=context, start_parameter_services=False)
    try:
        deaf.create_subscription(PointCloud2, '/cloth/particles', lambda message: None,
                                 QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE))
        time.sleep(0.5)
        goes_on(cloth, 90)
    finally:
        deaf.destroy_node()


def test_a_message_of_a_million_markers_is_refused_by_length(cloth):
    one = serialize_message(MarkerArray(markers=[Marker()] * 1000))
    million = one[:4] + (10**6).to_bytes(4, 'little') + one[8:] * 20
    for data in (one[:4] + (10**6).to_bytes(4, 'little') + one[8:], million):
        before = int(cloth.status()['rejected_inputs'])
        cloth.peer.say('/cloth/colliders', data, MarkerArray)
        cloth.status(lambda status, before=before: int(status['rejected_inputs']) > before)
    assert cloth.node.said('/cloth/colliders', 'there is room for')
    goes_on(cloth)


def test_a_hundred_pins_and_a_hundred_colliders(cloth):
    table = [((k % 10) * 0.04 - 0.18, (k // 10) * 0.04 - 0.18) for k in range(HUNDRED)]
    cloth.peer.say('/cloth/colliders', MarkerArray(markers=[
        collider(f'c{k}', (x, y, -0.5), kind=Marker.SPHERE) for k, (x, y) in enumerate(table)]))
    cloth.peer.say('/cloth/pins', MarkerArray(markers=[
        pin(f'p{k}', (*points(cloth.clouds[-1])[k // 9, k % 9].tolist(),), radius=0.02)
        for k in range(81)]))
    status = cloth.status(lambda status: int(status['pins']) > 20
                          and int(status['colliders']) >= HUNDRED)
    assert int(status['colliders']) == HUNDRED + 2
    goes_on(cloth)
    cloth.peer.say('/cloth/pins', MarkerArray(markers=[pin('', action=Marker.DELETEALL)]))
    cloth.peer.say('/cloth/colliders', MarkerArray(markers=[
        collider(f'c{k}', action=Marker.DELETE) for k in range(HUNDRED)]))
    cloth.status(lambda status: int(status['pins']) == 0 and int(status['colliders']) == 2)


@pytest.mark.parametrize('count', [300, slow(2000)])
def test_a_stream_of_a_thousand_a_second(cloth, count):
    begin = time.monotonic()
    for k in range(count):
        place = (0.3 * np.sin(0.01 * k), 1.0, 0.15)
        cloth.peer.say('/cloth/collider/ball/pose', pose_stamped(place))
        cloth.peer.say('/cloth/collider_states', targets(ball=place))
        while time.monotonic() < begin + 0.001 * k:
            cloth.peer.spin(0.0005)
    goes_on(cloth)


@pytest.mark.parametrize('count', [9, slow(60)])
def test_a_storm_of_parameters(cloth, count):
    for k in range(count):
        good, said = cloth.set(solver__substeps=(20, 3, 40)[k % 3], gravity=[
            0.0, 0.0, -9.80665 * (1.0 + 0.1 * (k % 2))])
        assert good, said
    assert cloth.set(solver__substeps=20, gravity=[0.0, 0.0, -9.80665]) == (True, '')
    goes_on(cloth)


def test_another_node_of_the_same_name_does_not_stop_it(cloth, start, towel):
    """As ROS warns: their topics mix. Both live, and the second ends well."""
    cloth.peer.company = [cloth.node]
    second = start(scene=towel)
    second.wait_for('running')
    cloth.peer.spin(0.5)
    assert second.end() == 0, second.lines
    assert not second.said('Traceback'), second.lines
    cloth.peer.spin(1.0)
    cloth.clouds.clear()
    goes_on(cloth)


def test_a_restart_in_mid_recording_leaves_a_whole_log(cloth, run):
    assert cloth.go('deactivate', 'cleanup')
    reader = LogReader(run)
    assert reader.whole, reader.damage
    stamps = [message.time_ns for message in reader.messages({'/cloth/particles'})]
    assert stamps == sorted(stamps)
    assert len(stamps) > 30
    folder = run.parent / 'again'
    assert cloth.set(**{'record__path': str(folder)}) == (True, '')
    assert cloth.go('configure', 'activate'), cloth.node.lines
    cloth.clouds.clear()
    goes_on(cloth)
    assert cloth.peer.ask(GetState, '/cloth/get_state').current_state.label == 'active'
    assert folder.is_dir()


def test_a_full_disk_ends_the_recording_and_not_the_node(cloth):
    """No file may grow beyond 8 kB: the log cannot be written, the cloth goes on."""
    assert cloth.record(False)[0]
    good, folder = cloth.record(True)
    assert good, folder
    process = cloth.node.process.pid
    resource.prlimit(process, resource.RLIMIT_FSIZE, (8_000, resource.RLIM_INFINITY))
    try:
        line = cloth.node.wait_for('recording stopped')
        assert 'Traceback' not in line
        assert line.endswith(f"'xpbd_ros recover {folder}' writes a whole log of what it holds")
        goes_on(cloth)
        assert not cloth.node.said(f'recorded {folder}'), 'it is not whole'
    finally:
        resource.prlimit(process, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
    for _ in range(2):    # also a second later
        cloth.statuses.clear()
        status = cloth.status(lambda status: int(status['bytes_recorded']) == 0)
        assert (status['level'], status['message'].split(':')[0]) == (b'\2', 'recording stopped')
    assert cloth.record(True)[0]
    cloth.statuses.clear()
    cloth.status(lambda status: status['level'] != b'\2')
    assert cloth.record(False)[0]


def test_a_full_disk_is_told_while_it_is_paused(cloth):
    """The error is found by the periodic flush, as no frame is written."""
    assert cloth.set(record__flush_period=60.0) == (True, '')
    good, folder = cloth.record(True)
    assert good, folder
    goes_on(cloth)
    assert cloth.trigger('pause')[0]
    process = cloth.node.process.pid
    resource.prlimit(process, resource.RLIMIT_FSIZE, (8_000, resource.RLIM_INFINITY))
    try:
        assert cloth.set(record__flush_period=0.1) == (True, '')
        cloth.node.wait_for('recording stopped', folder)
        cloth.status(lambda status: (status['level'], status['bytes_recorded']) == (b'\2', '0'))
        assert cloth.record(False) == (False, 'not recording')
    finally:
        resource.prlimit(process, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
    assert cloth.set(record__flush_period=1.0) == (True, '')
    assert cloth.trigger('play')[0]
    goes_on(cloth)


def test_a_log_that_cannot_be_finished_is_no_success(cloth):
    assert cloth.set(record__flush_period=60.0) == (True, '')
    assert cloth.trigger('pause')[0]
    good, folder = cloth.record(True)
    assert good, folder
    process = cloth.node.process.pid
    resource.prlimit(process, resource.RLIMIT_FSIZE, (8_000, resource.RLIM_INFINITY))
    try:
        good, reason = cloth.record(False)
    finally:
        resource.prlimit(process, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
    assert not good, reason
    assert reason.startswith(f'not finished: {folder}/'), reason
    assert 'File too large' in reason
    assert cloth.record(False) == (False, 'not recording')
    assert cloth.trigger('play')[0]
    goes_on(cloth)
