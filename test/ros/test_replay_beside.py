"""``replay`` beside a node that is running: it drives it only if it is told to."""

import re
import subprocess
import sys

import pytest
from rclpy.serialization import serialize_message
from std_msgs.msg import UInt64
from visualization_msgs.msg import MarkerArray

from support.logs import cdr_uint64
from support.node import child_environment, collider, pin
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.writer import LogWriter

START = 1_700_000_000_000_000_000
INPUTS = ['/cloth/pins', '/cloth/colliders']


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """Return a log of a second with a grasp, a collider and a counter in each frame."""
    folder = tmp_path_factory.mktemp('log') / 'run'
    grasp = MarkerArray(markers=[pin('ghost', (-0.2, -0.2, 0.004), radius=0.05)])
    cube = MarkerArray(markers=[collider('ghost', (0.0, 0.0, -1.0))])
    with LogWriter(folder, scene='', settings={}) as log:
        for topic in INPUTS:
            log.add_channel(topic, 'visualization_msgs/msg/MarkerArray', Qos(depth=10))
        log.add_channel('/count', 'std_msgs/msg/UInt64', Qos())
        for frame in range(60):
            for topic, data in zip([*INPUTS, '/count'], [
                    serialize_message(grasp), serialize_message(cube), cdr_uint64(frame)]):
                log.write(topic, data, time_ns=START + frame * 16_666_667, frame=frame)
    return folder


def replay(run, *flags) -> subprocess.Popen:
    """Start a replay."""
    return subprocess.Popen([sys.executable, '-m', 'xpbd_ros', 'replay', run, *flags],
                            env=child_environment(), stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True)


def ended(process) -> tuple[str, str]:
    """End a replay and return what it said."""
    process.terminate()
    said = process.communicate(timeout=60.0)
    assert process.returncode == 0, said
    return said


def test_a_node_is_driven_only_if_asked_for_and_that_is_said(lockstep, run):
    before = set(lockstep.pin_state(lockstep.step()))
    heard = lockstep.peer.hear(UInt64, '/count')
    process = replay(run, '--loop')
    lockstep.peer.until(lambda: len(heard) > 120, 'two rounds of the replay')
    out, err = ended(process)
    assert f'left out, as inputs: {", ".join(INPUTS)} (--inputs publishes them)\n' in out
    assert err == ''
    assert set(lockstep.pin_state(lockstep.step())) == before

    process = replay(run, '--loop', '--inputs')
    lockstep.peer.until(
        lambda: 'ghost' in lockstep.pin_state(lockstep.step()), 'a grasp by the log')
    out, err = ended(process)
    assert 'left out' not in out
    for topic in INPUTS:
        assert re.search(f'{topic}: (/cloth|a node) listens: it takes the inputs of this log\n',
                         err)


def test_an_input_that_is_named_is_published(run):
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', 'replay', run, '--topics', '/cloth/pins', '--json',
         '-', '--rate', '10', '--remap', '/cloth/pins:=/missing'], env=child_environment(),
        capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, '')
    assert '"/cloth/pins": 60' in done.stdout
    assert '"left_out": []' in done.stdout


def test_a_log_of_inputs_alone_is_refused_with_the_way_out(tmp_path):
    with LogWriter(tmp_path / 'run', scene='', settings={}) as log:
        log.add_channel('/cloth/collider/ball/pose', 'geometry_msgs/msg/PoseStamped', Qos())
        log.write('/cloth/collider/ball/pose', bytes(4), time_ns=START, frame=1)
    done = subprocess.run([sys.executable, '-m', 'xpbd_ros', 'replay', tmp_path / 'run'],
                          env=child_environment(), capture_output=True,
                          text=True, check=False)
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.endswith('run_0.mcap: holds only inputs (/cloth/collider/ball/pose);'
                                ' --inputs publishes them\n')
