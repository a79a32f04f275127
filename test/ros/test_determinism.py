"""The same inputs give the same states, bit for bit: again, in another process, without DDS."""

import json
import os
import subprocess
import sys

from geometry_msgs.msg import Point, Twist
import pytest
from visualization_msgs.msg import Marker, MarkerArray

from support.logs import recorded_inputs, state_hashes
from support.node import child_environment, Cloth, collider, pin, pose_stamped, targets
from support.repeated import repeated
from support.strict_reader import read_strictly
from xpbd_ros.node_stress.node import SCENE

AUTO = SCENE.replace(', substeps: SUBSTEPS', '').replace('0.004}', '0.004, mesh_nodes: 50000}')
"""its substeps follow from its stiffness"""
STIFF = 'cloths.towel.effects.stretch.warp'


@pytest.fixture(scope='module')
def scene(tmp_path_factory):
    """Return the file of the scene."""
    file = tmp_path_factory.mktemp('scene') / 'auto.yaml'
    file.write_text(AUTO)
    return file


@pytest.fixture(scope='module')
def cloth(start, peer, scene):
    """Return a node in a namespace of its own."""
    cloth = Cloth(peer, start('-r', '__ns:=/robot', scene=scene, mode='lockstep',
                              publish_clock='true'), '/robot/cloth')
    cloth.meet(pins=MarkerArray(), pin_targets=targets(), collider_states=targets(),
               colliders=MarkerArray(),
               collider__ball__pose=pose_stamped((0.0, 1.0, 0.15)))
    return cloth


def play(cloth, wait) -> None:
    """Do a bit of everything; ``wait(n)`` lets about n frames pass."""
    rub = Twist()
    rub.linear.x, rub.angular.z = 0.3, 1.0
    turned = (0.0, 0.0, 0.6, 0.8)
    wait(2)
    cloth.mark(pin('left', (-0.2, -0.2, 0.004)), pin('right', (0.2, -0.2, 0.004), radius=0.06))
    wait(3)
    for k in range(5):
        cloth.aim(left=(-0.2, -0.2, 0.05 + 0.03 * k), right=(0.2, -0.2, 0.05 + 0.02 * k))
        wait(2)
    cloth.peer.say(f'{cloth.name}/pin_targets', targets(
        stamp=1_700_000_000_123_456_789, twist=rub, left=(-0.1, -0.1, 0.3)))
    cloth.peer.say(f'{cloth.name}/collider/ball/pose', pose_stamped((0.0, 0.3, 0.15), turned))
    wait(10)
    cloth.peer.say(f'{cloth.name}/collider_states', targets(ball=(0.05, 0.1, 0.15), twist=rub))
    assert cloth.set(**{STIFF: 2500.0}) == (True, '')
    assert cloth.trigger('save_state')[0], 'behind the key, from which auto chooses substeps'
    wedge = collider('wedge', (0.0, 0.1, -0.03), (0.1, 0.1, 0.1), kind=Marker.TRIANGLE_LIST)
    a, b, c, d = (Point(x=x, y=y, z=z) for x, y, z in (
        (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    wedge.points = [a, c, b, a, b, d, a, d, c, b, c, d]
    cloth.peer.say(f'{cloth.name}/colliders', MarkerArray(markers=[
        wedge, collider('crate', (-0.05, 0.0, 0.02), (0.1, 0.1, 0.04)),
        collider('brief', (0.1, 0.0, 0.0), kind=Marker.SPHERE, lifetime_ns=100_000_000)]))
    wait(8)
    cloth.peer.say(f'{cloth.name}/colliders', MarkerArray(markers=[
        collider('crate', (0.05, 0.0, 0.03), kind=Marker.CYLINDER),
        collider('ball', action=Marker.DELETE)]))
    assert cloth.set(gravity=[1.0, 0.0, -7.0], solver__iterations=2) == (True, '')
    assert cloth.set(colliders__table__friction=0.1) == (True, '')
    wait(8)
    cloth.mark(pin('right', action=Marker.DELETE),
               pin('brief', (0.2, 0.2, 0.004), radius=0.3, lifetime_ns=100_000_000))
    wait(10)
    assert cloth.trigger('reset')[0]
    cloth.mark(pin('again', (0.0, 0.0, 0.004), radius=0.05))
    assert cloth.set(solver__substeps=11, effects__damping__rate=0.3) == (True, '')
    wait(10)
    assert cloth.trigger('load_state')[0]
    wait(10)
    assert cloth.trigger('release_all')[0]
    wait(20)


def record(cloth, run, mode: str, wait) -> dict[int, int]:
    """Play into a log of its own, from the start of the scene; return its hashes."""
    cloth.restart(mode='lockstep', record__path=str(run))
    cloth.meet()
    cloth.step(100 - cloth.step())
    assert cloth.set(mode=mode) == (True, '')
    play(cloth, wait)
    assert cloth.set(mode='lockstep') == (True, '')
    assert cloth.record(False) == (True, str(run))
    assert read_strictly(run)['/parameter_events'] > 0
    return state_hashes(run)


def test_lockstep_twice_gives_the_same_bits(cloth, tmp_path):
    def wait(count):
        cloth.peer.spin(0.05)    # DDS does not say whether a message or a service call is first
        cloth.step(count)
    first = record(cloth, tmp_path / 'first', 'lockstep', wait)
    second = record(cloth, tmp_path / 'second', 'lockstep', wait)
    assert recorded_inputs(tmp_path / 'second') == recorded_inputs(tmp_path / 'first')
    assert len(set(first.values())) > 40, 'something happened'
    assert second == first
    assert repeated(tmp_path / 'first', tmp_path) == first


def test_a_run_in_real_time_can_be_repeated_from_its_log(cloth, tmp_path):
    """With whatever frames the inputs came to act on."""
    def wait(count):
        before = len(cloth.clouds)
        cloth.peer.until(lambda: len(cloth.clouds) >= before + count, 'frames')
    run = tmp_path / 'run'
    first = record(cloth, run, 'realtime', wait)
    kinds = {topic for _, topic in recorded_inputs(run)}
    assert kinds == {'pins', 'pin_targets', 'colliders', 'collider_states', 'parameter_events',
                     'resets', 'saved_states'}
    assert cloth.get('solver.substeps') == [11]
    assert set(first) == set(range(max(first) + 1)), 'every frame'
    assert repeated(run, tmp_path) == first
    assert os.path.exists(run)


def test_a_log_that_began_in_the_midst_of_a_run_is_solved_again_from_there(cloth, scene, tmp_path):
    cloth.restart(mode='lockstep', record__path='')
    cloth.meet()
    cloth.mark(pin('left', (-0.2, -0.2, 0.004)))
    cloth.step(3)
    good, run = cloth.record(True)
    assert good, run
    cloth.aim(left=(-0.2, -0.2, 0.05))
    cloth.step(3)
    assert cloth.record(False) == (True, run)
    first = min(state_hashes(run))
    assert first >= 3
    assert recorded_inputs(run) != []
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', 'run', scene, '--commands', run, '-o',
         tmp_path / 'again'], env=child_environment(), capture_output=True, text=True,
        check=False)
    assert (done.returncode, done.stdout) == (1, '')
    assert f'begins in the middle of a run, with frame {first}, so ' in done.stderr
    assert done.stderr.count('\n') == 1
    assert not (tmp_path / 'again').exists()
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', 'resim', run, '--json', '-'],
        env=child_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found['identical'], found['first_frame']) == (True, first)
    assert found['frames'] == max(state_hashes(run)) - first + 1
