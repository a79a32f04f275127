"""Command in, moved particles out, force out: over DDS, one frame at a time."""

from math import cos, pi, sin

from geometry_msgs.msg import Twist
import numpy as np
import pytest
from visualization_msgs.msg import Marker, MarkerArray

from support.node import collider, pin, pose_stamped, targets, transform, WEIGHT

CORNER = (-0.2, -0.2, 0.004)
"""row 0, column 0 of the towel at the start [m]"""
FAR_CORNER = (-0.2, 0.2, 0.004)
"""last row, column 0"""


@pytest.fixture
def cloth(lockstep):
    """Return the towel on its table, flat and free."""
    assert lockstep.trigger('reset')[0]
    return lockstep


def rest(cloth) -> int:
    """Let it come to rest, as fast as it can, and return to lockstep."""
    start = int(cloth.status()['frame'])
    assert cloth.set(mode='fast') == (True, '')
    cloth.status(lambda status: int(status['frame']) > start + 1200)
    assert cloth.set(mode='lockstep') == (True, '')
    return cloth.step()


def test_a_grasped_corner_follows_its_target_and_is_released(cloth):
    cloth.mark(pin('gripper', CORNER))
    frame = cloth.step()
    assert list(cloth.pin_state(frame)) == ['gripper']
    up = (-0.2, -0.15, 0.1)
    cloth.aim(gripper=up)
    frame = cloth.step(2)    # 11 cm, at no more than 5 m/s
    assert cloth.cloud(frame)[0, 0] == pytest.approx(up, abs=1e-7)
    frame = cloth.step(20)
    assert cloth.cloud(frame)[0, 0] == pytest.approx(up, abs=1e-7), 'holds still'
    assert cloth.cloud(frame)[0, 1, 2] > 0.05, 'and lifts what it is part of'
    cloth.mark(pin('gripper', action=Marker.DELETE))
    frame = cloth.step()
    assert cloth.pin_state(frame) == {}
    frame = cloth.step(60)
    assert cloth.cloud(frame)[0, 0, 2] < 0.02, 'has its weight back'


def test_a_target_on_the_way_has_a_velocity_and_a_limit(cloth):
    cloth.mark(pin('gripper', CORNER))
    cloth.step()
    cloth.aim(gripper=(-0.2, -0.2, 1.004))
    frame = cloth.step(2)
    (before, _, _), = cloth.pin_state(frame - 1).values()
    (pose, twist, _), = cloth.pin_state(frame).values()
    # 1 m at no more than 5 m/s: a twelfth of a metre in a frame
    assert pose.translation.z - before.translation.z == pytest.approx(5.0 / 60.0)
    assert twist.linear.z == pytest.approx(5.0)
    assert (twist.linear.x, twist.linear.y) == (0.0, 0.0)
    assert cloth.status()['pins_at_max_speed'] == '1'
    frame = cloth.step(20)
    (pose, twist, _), = cloth.pin_state(frame).values()
    assert (pose.translation.z, twist.linear) == (1.004, Twist().linear)


def test_pins_at_rest_carry_the_weight(cloth):
    cloth.mark(pin('left', CORNER), pin('right', FAR_CORNER))
    cloth.step()
    cloth.aim(left=(-0.2, -0.15, 1.2), right=(-0.2, 0.15, 1.2))
    states = cloth.pin_state(rest(cloth))
    forces = np.array([[w.force.x, w.force.y, w.force.z] for _, _, w in states.values()])
    assert forces.sum(0) == pytest.approx([0.0, 0.0, -WEIGHT], abs=1e-3 * WEIGHT)
    left, right = forces
    assert left == pytest.approx(right * [1.0, -1.0, 1.0], abs=1e-3 * WEIGHT), 'half each'
    assert left[1] > 0.0 > right[1], 'and each is drawn to the other'
    cloth.mark(pin('left', action=Marker.DELETE))
    (_, _, wrench), = cloth.pin_state(rest(cloth)).values()
    assert wrench.force.z == pytest.approx(-WEIGHT, rel=1e-3), 'one carries it all'


def test_turning_a_pin_turns_what_it_holds(cloth):
    """Each particle keeps its offset in the pin's axes."""
    cloth.mark(pin('hand', (-0.2, -0.2, 0.004), radius=0.06))    # the corner and its neighbours
    cloth.step()
    cloth.aim(hand=(-0.2, -0.2, 0.304))
    before = cloth.cloud(cloth.step(10))
    half = pi / 6.0    # a sixth of a turn about z
    cloth.aim(hand=transform((-0.2, -0.2, 0.304), (0.0, 0.0, sin(half), cos(half))))
    frame = cloth.step(15)    # it takes the time that was between the targets
    after = cloth.cloud(frame)
    arm = before[0, 1] - before[0, 0]
    assert arm == pytest.approx([0.05, 0.0, 0.0], abs=1e-6)
    turned = [0.05 * cos(2.0 * half), 0.05 * sin(2.0 * half), 0.0]
    assert after[0, 1] - after[0, 0] == pytest.approx(turned, abs=1e-6)
    (_, _, wrench), = cloth.pin_state(frame).values()
    assert wrench.torque.y > 0.0, 'the cloth hangs on the far side of the hand, and pulls it down'


def test_deleteall_releases_every_pin(cloth):
    cloth.mark(pin('left', CORNER), pin('right', FAR_CORNER))
    assert list(cloth.pin_state(cloth.step())) == ['left', 'right']
    cloth.mark(pin('', action=Marker.DELETEALL))
    assert cloth.pin_state(cloth.step()) == {}


def test_one_message_may_wipe_and_grasp_again(cloth):
    """As RViz' users write it: DELETEALL in front of what there shall be."""
    cloth.mark(pin('old', CORNER))
    cloth.step()
    corners = [(x, y, 0.004) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    cloth.mark(pin('', action=Marker.DELETEALL),
               *(pin(f'new{k}', corner) for k, corner in enumerate(corners)))
    assert list(cloth.pin_state(cloth.step())) == ['new0', 'new1', 'new2', 'new3']


def test_a_pin_is_named_by_ns_and_id(cloth):
    marker = pin('hand', CORNER)
    marker.id = 7
    nameless = pin('', FAR_CORNER)
    cloth.mark(marker, nameless)
    assert list(cloth.pin_state(cloth.step())) == ['hand_7', 'pin_0']


def test_a_pin_with_a_lifetime_lets_go_unless_it_is_renewed(cloth):
    """A dead man's switch: six frames, in simulation time."""
    def renew():
        cloth.mark(pin('gripper', CORNER, lifetime_ns=100_000_000))
    renew()
    held = [bool(cloth.pin_state(cloth.step())) for _ in range(8)]
    assert held == [True] * 6 + [False] * 2
    for _ in range(4):
        renew()
        assert cloth.pin_state(cloth.step(5)), 'renewed in time'
    assert cloth.pin_state(cloth.step(1))
    assert not cloth.pin_state(cloth.step(1))


def test_a_grasp_again_moves_the_pin(cloth):
    cloth.mark(pin('gripper', CORNER))
    cloth.step()
    cloth.mark(pin('gripper', (-0.2, -0.2, 0.05)))
    frame = cloth.step()
    assert cloth.cloud(frame)[0, 0] == pytest.approx([-0.2, -0.2, 0.05], abs=1e-7)


def test_what_one_pin_holds_no_other_takes(cloth):
    cloth.mark(pin('first', CORNER))
    cloth.step()
    cloth.mark(pin('second', CORNER))
    assert list(cloth.pin_state(cloth.step())) == ['first']
    cloth.node.wait_for("/cloth/pins: refused: pin 'second': no free particle within 0.01 m")


@pytest.mark.parametrize('topic', ['collider/ball/pose', 'collider_states'])
def test_a_collider_pushes_the_towel_out_of_its_way(cloth, topic):
    before = cloth.cloud(cloth.step(5))
    place = (0.0, 0.0, 0.05)    # half way into the table, coming from +y
    message = pose_stamped(place) if topic.endswith('pose') else targets(ball=place)
    cloth.peer.say(f'{cloth.name}/{topic}', message)
    after = cloth.cloud(cloth.step(40))
    distance = np.linalg.norm(after - place, axis=-1)
    assert distance.min() > 0.1 + 0.004 - 1e-3, 'nothing is in the ball'
    assert (after - before)[..., 1].mean() < -0.05, 'the towel made way'
    assert after[..., 2].min() > 0.003, 'and nothing is in the table'


def test_the_speed_of_a_surface_rubs(cloth):
    """A twist is the velocity of the surface, as of a conveyor belt, though the pose stays."""
    before = cloth.cloud(cloth.step(5))
    belt = Twist()
    belt.linear.x = 0.2
    cloth.peer.say('/cloth/collider_states', targets(table=(0.0, 0.0, 0.0), twist=belt))
    after = cloth.cloud(cloth.step(30))
    assert (after - before)[..., 0].mean() > 0.02


def test_colliders_come_change_and_go(cloth):
    """A box under the towel lifts it, grows, and when it is gone the towel lies down again."""
    def put(*markers):
        cloth.peer.say('/cloth/colliders', MarkerArray(markers=list(markers)))
        return cloth.cloud(cloth.step(120))[4, 4, 2]
    assert put() == pytest.approx(0.004, abs=1e-5)
    crate = collider('crate', (0, 0, -0.01), (0.1, 0.1, 0.06))
    assert put(crate) == pytest.approx(0.024, abs=1e-4)
    grown = collider('crate', (0, 0, 0), (0.1, 0.1, 0.08), kind=Marker.CYLINDER)
    assert put(grown) == pytest.approx(0.044, abs=1e-4)
    assert cloth.status()['colliders'] == '3'
    assert put(collider('crate', action=Marker.DELETE)) == pytest.approx(0.004, abs=1e-4)
    crate.lifetime.nanosec = 200_000_000
    assert put(crate) == pytest.approx(0.004, abs=1e-4), 'missing renewed it'
    crowd = [collider(f'c{k}', (5.0, k, 0.0)) for k in range(31)]
    cloth.peer.say('/cloth/colliders', MarkerArray(markers=crowd))
    cloth.step()
    cloth.node.wait_for("/cloth/colliders: refused: collider 'c30': all 32 colliders are in use")
    assert put(collider('', action=Marker.DELETEALL)) < -1.0, 'there is no table any more'
