"""When a gripper grasps and releases; the joint positions are given."""

from importlib.util import find_spec

import pytest
from sensor_msgs.msg import JointState

from xpbd_ros.errors import InputError
from xpbd_ros.ros.robots import GripperFollower, JointStates, Kinematics
from xpbd_ros.scene.load import load_scene
from xpbd_ros.share import share_folder
from xpbd_ros.sim.commands import Grasp, Release

pytestmark = pytest.mark.skipif(find_spec('yourdfpy') is None,
                                reason="yourdfpy is missing: pip install '.[robot]'")


@pytest.fixture
def robot():
    """Return the shipped robot."""
    return load_scene(str(share_folder() / 'robots' / 'robot.yaml')).robots['arm']


def state(stamp: int = 0, **positions) -> JointState:
    """Return a message with joint positions."""
    message = JointState(name=list(positions), position=list(map(float, positions.values())))
    message.header.stamp.sec = stamp
    return message


@pytest.fixture
def states():
    """Return joint states on a clock that stands at 5 s."""
    return JointStates('/joint_states', lambda: 5 * 10**9)


def test_joint_states_of_several_publishers_add_up(states):
    states.take(state(3, reach=0.1, lift=0.2))
    states.take(state(2, finger=0.03))
    assert states.latest == {'reach': (3 * 10**9, 0.1), 'lift': (3 * 10**9, 0.2),
                             'finger': (2 * 10**9, 0.03)}
    states.take(state(finger=0.02))
    assert states.latest['finger'] == (5 * 10**9, 0.02), 'now'
    states.take(JointState(name=['finger'], velocity=[1.0]))
    for bad in state(6, finger=float('nan')), JointState(name=['finger'], position=[1.0, 2.0]):
        with pytest.raises(InputError, match='positions, or some are not finite'):
            states.take(bad)
    assert states.latest['finger'] == (5 * 10**9, 0.02)


def test_links_have_a_pose_once_all_joints_are_known(states, robot):
    source = Kinematics(robot, states)
    states.take(state(3, reach=0.1, lift=0.2))
    with pytest.raises(InputError, match='no position of finger on /joint_states'):
        source.latest_ns('world', 'palm')
    states.take(state(4, finger=0.03))
    assert source.latest_ns('world', 'palm') == 4 * 10**9
    assert source.pose('world', 'right_finger', 4 * 10**9).position == pytest.approx(
        (0.1, -0.03, 0.3))
    states.clear()    # as another thread does when the clock goes back
    with pytest.raises(InputError, match='no position of reach, lift, finger'):
        source.pose('world', 'right_finger', 4 * 10**9)


def test_a_stamp_far_ahead_holds_no_later_positions_up(states, robot):
    """As after a clock was set back: positions count by arrival, with their own stamp."""
    source = Kinematics(robot, states)
    states.take(state(3600, reach=0.1, lift=0.2, finger=0.03))
    states.take(state(4, reach=0.2, lift=0.2, finger=0.03))
    assert source.latest_ns('world', 'palm') == 4 * 10**9
    assert source.pose('world', 'palm', 4 * 10**9).position == pytest.approx((0.2, 0.0, 0.3))


def test_robots_on_one_topic_are_told_apart(states, robot):
    """Joints of another robot are no news of this one, which may be silent."""
    source = Kinematics(robot, states)
    states.take(state(3, reach=0.1, lift=0.2, finger=0.03))
    states.take(state(4, other_joint=1.0))
    assert source.latest_ns('world', 'palm') == 3 * 10**9


def test_new_positions_with_an_old_stamp_move_the_links(states, robot):
    """As after a simulator began again."""
    source = Kinematics(robot, states)
    for reach in (0.1, 0.3):
        states.take(state(3, reach=reach, lift=0.2, finger=0.03))
        assert source.pose('world', 'palm', 3 * 10**9).position[0] == pytest.approx(reach)
        states.clear()


@pytest.fixture
def gripper(states, robot):
    """Return the follower of its gripper, which has nothing to report."""
    said = []
    yield GripperFollower(robot, states, Kinematics(robot, states), 'world', now_ns=lambda: 0,
                          warn=said.append)
    assert said == []


def test_it_grasps_below_releases_above_and_does_nothing_between(gripper, states):
    given = []
    for finger in (0.02, 0.0061, 0.0059, 0.004, 0.0065, 0.0071, 0.008, 0.0065, 0.004):
        states.take(state(3, reach=0.0, lift=0.0, finger=finger))
        given.append(gripper.command(holds=bool(given) and not gripper.open, reset=False))
    nothing = type(None)
    assert [type(command) for command in given] == [
        nothing, nothing, Grasp, nothing, nothing, nothing, Release, nothing, Grasp]
    assert (given[2].pin, given[2].radius) == ('arm_gripper', 0.03)
    assert given[2].pose.position == pytest.approx((0.0, 0.0, 0.075)), 'at the tip'


def test_a_joint_that_nothing_publishes_is_reported_once(states, robot):
    said, now_ns = [], [7]
    gripper = GripperFollower(robot, states, Kinematics(robot, states), 'world',
                              now_ns=lambda: now_ns[0], warn=said.append)
    states.take(state(3, reach=0.0, lift=0.0))
    for now_ns[0] in (7, 10**9, 2 * 10**9, 3 * 10**9):
        assert gripper.command(holds=False, reset=False) is None
        assert bool(said) == (now_ns[0] > 10**9)
    assert said == ["robot 'arm': no position of finger on /joint_states, so its gripper does "
                    'nothing']


def test_a_reset_closes_it_again(gripper, states):
    states.take(state(3, reach=0.0, lift=0.0, finger=0.004))
    assert isinstance(gripper.command(holds=False, reset=False), Grasp)
    assert gripper.command(holds=False, reset=False) is None, 'it tries once'
    assert isinstance(gripper.command(holds=True, reset=True), Grasp)
