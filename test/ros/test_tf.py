"""Pins, colliders and inputs in TF frames that another process broadcasts; needs tf2."""

from collections.abc import Callable, Iterator
from importlib.util import find_spec
import json
from pathlib import Path
import signal
import subprocess
import sys
import time

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import MultiDOFJointState
from visualization_msgs.msg import Marker

from support import tf_broadcaster
from support.logs import recorded_inputs
from support.node import child_environment, Cloth, pin, pose_stamped, targets, TOWEL, transform
from xpbd_ros.ros.logged_commands import Recording
from xpbd_ros.scene.compile import compile_scene

pytestmark = pytest.mark.skipif(find_spec('tf2_ros') is None,
                                reason='tf2_ros is missing: apt install ros-jazzy-tf2-ros-py')
SCENE = TOWEL.replace('position: [0.0, 1.0, 0.15]',
                      'frame: tool, position: [0.0, 0.0, 0.1], frame_timeout: 0.5') + """
pins:
  hand: {cloth: towel, at: corner_00, frame: hand, frame_timeout: 0.5}
"""
SILENT = 20
"""frames of rest that are the silence; a busy machine may cause shorter ones"""


@pytest.fixture
def broadcast(own_domain) -> Iterator[Callable[[], subprocess.Popen]]:
    """Return a function that starts the broadcaster."""
    started = []

    def broadcast() -> subprocess.Popen:
        started.append(subprocess.Popen([sys.executable, tf_broadcaster.__file__],
                                        env=child_environment()))
        return started[-1]
    yield broadcast
    for process in started:
        process.kill()
        process.wait()


def test_parts_follow_tf_and_repeat_from_the_log(start, peer, broadcast, tmp_path):
    """The frame is unknown, known, silent, and back."""
    (tmp_path / 'scene.yaml').write_text(SCENE)
    run = tmp_path / 'run'
    cloth = Cloth(peer, start(scene=tmp_path / 'scene.yaml', record__path=str(run)))
    said = cloth.node.wait_for('TF: no transform of', 'collider ball absent', 'pin hand held')
    assert 'does not exist' in said
    status = cloth.status(lambda status: 'TF: ' in status['message'])
    assert (status['level'], status['colliders'], status['pins']) == (b'\x01', '1', '1')
    process = broadcast()
    cloth.node.wait_for('TF:', 'tool', 'back')
    assert cloth.status(lambda status: float(status['frame_age_s tool']) < 0.2)['colliders'] == '2'
    peer.spin(2.5)
    process.kill()
    cloth.node.wait_for('silent for more than 0.5 s', 'collider ball held', 'pin hand released')
    status = cloth.status(lambda status: 'silent' in status['message'])
    assert (status['level'], status['colliders'], status['pins']) == (b'\x01', '2', '0')
    broadcast()
    peer.until(lambda: len(cloth.node.said('TF:', 'back')) > 1, 'the return')
    cloth.status()
    assert cloth.node.end() == 0
    assert {'pins', 'pin_targets', 'colliders', 'collider_states'} == {
        topic for _, topic in recorded_inputs(run)}
    places = repeated_places(run)
    speeds = 60.0 * np.linalg.norm(np.diff(places, axis=0), axis=1)
    begin = np.flatnonzero(speeds)[0]
    rests = np.convolve(speeds == 0.0, np.ones(SILENT), 'valid') == SILENT
    end = begin + np.flatnonzero(rests[begin:])[0]
    assert end - begin > 100
    assert np.median(speeds[begin:end]) == pytest.approx(0.5, rel=0.02)
    places = places[begin:end]
    radius = np.linalg.norm((places - tf_broadcaster.CENTRE)[:, :2], axis=1)
    off = np.hypot(radius - tf_broadcaster.RADIUS, places[:, 2] - tf_broadcaster.CENTRE[2] - 0.1)
    assert off.max() < 1e-3, 'm off the path'


def test_frames_are_followed_after_the_clock_went_back(start, peer, tmp_path):
    """In every mode: a bag that begins again, or a simulator that was reset."""
    from tf2_msgs.msg import TFMessage
    (tmp_path / 'scene.yaml').write_text(SCENE)
    cloth = Cloth(peer, start(scene=tmp_path / 'scene.yaml', mode='lockstep',
                              use_sim_time='true'))
    cloth.node.wait_for('running')
    balls = peer.hear(MultiDOFJointState, '/cloth/collider_wrenches')
    now_ns = time.time_ns()

    def tell_clock() -> None:
        peer.say('/clock', Clock(clock=Time(sec=now_ns // 10**9, nanosec=now_ns % 10**9)))

    def tell_frame(x: float) -> None:
        moved = TransformStamped(child_frame_id='tool', transform=transform((x, 1.0, 0.2)))
        moved.header.frame_id = 'world'
        moved.header.stamp = Time(sec=now_ns // 10**9, nanosec=now_ns % 10**9)
        peer.say('/tf', TFMessage(transforms=[moved]))

    def follows(x: float) -> bool:
        """Let time pass with the frame at x, and return whether the ball is there."""
        nonlocal now_ns
        now_ns += 20_000_000
        tell_clock()
        tell_frame(x)
        cloth.step()
        places = {name: each.translation.x for message in balls[-1:]
                  for name, each in zip(message.joint_names, message.transforms)}
        return abs(places.get('ball', 9.0) - x) < 1e-6
    peer.until(lambda: follows(0.1), 'the ball')
    cloth.node.process.send_signal(signal.SIGSTOP)    # when it goes on, it reads the clock first
    tell_frame(0.0)
    now_ns = 1000 * 10**9
    tell_clock()
    cloth.node.process.send_signal(signal.SIGCONT)
    peer.until(lambda: follows(0.2), 'the ball by the earlier time')
    assert cloth.set(use_sim_time=False) == cloth.set(use_sim_time=True) == (True, '')
    now_ns = 500 * 10**9
    peer.until(lambda: follows(0.3), 'the ball by the time of another clock')
    assert cloth.node.end() == 0
    peer.company.clear()


def repeated_places(run: Path) -> np.ndarray:
    """Repeat a log without TF, bit for bit; return the places of the ball that follows TF."""
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', 'run', run.parent / 'scene.yaml', '--commands', run,
         '-o', run.parent / 'again', '--json', '-'],
        env=child_environment(), capture_output=True, text=True, check=False)
    numbers = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    assert numbers['commands']['identical']
    assert numbers['refused'] == 0
    recording = Recording(str(run))
    simulation, places = compile_scene(recording.scene), []
    simulation._advance = lambda: None    # the colliders alone
    for index in range(1, recording.last + 1):
        frame = simulation.step(recording.commands.get(index, []))
        if 'ball' in frame.colliders and index > 1:
            places.append(frame.colliders['ball'].pose.position)
    return np.array(places[2:])


def step_until(cloth: Cloth, true: Callable[[dict], bool], what: str) -> dict:
    """Step until the pins are as waited for; return their states."""
    found: dict = {}

    def look() -> bool:
        nonlocal found
        found = cloth.pin_state(cloth.step())
        return true(found)
    cloth.peer.until(look, what, lambda: found)
    return found


def test_inputs_in_another_frame_act_where_it_was_at_their_stamp(lockstep, broadcast):
    cloth, half = lockstep, 0.5**0.5
    broadcast()
    cloth.peer.until(lambda: cloth.peer.node.count_publishers('/tf_static'), 'the broadcaster')
    cloth.mark(pin('left', (-0.2, 0.2, -0.496), frame_id='base'))
    found = step_until(cloth, lambda pins: 'left' in pins, 'the grasp')
    t, q = found['left'][0].translation, found['left'][0].rotation
    assert (t.x, t.y, t.z) == pytest.approx((-0.2, -0.2, 0.004), abs=1e-12)
    assert (q.x, q.y, q.z, q.w) == pytest.approx((0.0, 0.0, half, half))

    cloth.peer.say('/cloth/pin_targets', targets(frame_id='tool', left=(0.0, 0.0, 0.1)))
    step_until(cloth, lambda pins: pins['left'][0].translation.z > 0.69, 'the pin at the tool')
    now_ns = time.time_ns()    # its transform arrives 30 to 50 ms later
    cloth.peer.say('/cloth/pin_targets', targets(frame_id='tool', stamp=now_ns,
                                                 left=(0.0, 0.0, 0.1)))
    x, y, z = tf_broadcaster.tool(1e-9 * now_ns)

    def distance(pins: dict) -> float:
        assert not cloth.node.said('refused'), cloth.node.lines
        place = pins['left'][0].translation
        return float(np.linalg.norm((place.x - x, place.y - y, place.z - z - 0.1)))
    step_until(cloth, lambda pins: distance(pins) < 1e-3, f'the pin at {x}, {y}')


def test_a_frame_that_tf_cannot_give_is_refused_with_the_reason(lockstep, broadcast):
    cloth = lockstep
    broadcast()
    cloth.node.wait_for('running')
    cloth.mark(pin('a', frame_id='moon'))
    cloth.node.wait_for("/cloth/pins: refused: marker a/0: TF frame 'moon' is not the scene's "
                        "'world'; ", '"moon"', 'does not exist')
    hour = 3600 * 10**9
    cloth.peer.say('/cloth/pin_targets', targets(frame_id='tool', stamp=time.time_ns() + hour,
                                                 left=(0.0, 0.0, 0.1)))
    cloth.node.wait_for('/cloth/pin_targets: refused: ', 'extrapolation into the future')
    ball = pose_stamped((0.0, 1.0, 0.15), frame_id='tool')
    ball.header.stamp.sec = 1
    cloth.peer.say('/cloth/collider/ball/pose', ball)
    cloth.node.wait_for('/cloth/collider/ball/pose: refused: ', 'extrapolation into the past')
    cloth.mark(pin('left', action=Marker.DELETE))
    step_until(cloth, lambda pins: not pins, 'the release')
