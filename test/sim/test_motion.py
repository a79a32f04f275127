"""How a pose follows its target: streams, jumps, turns, paths."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Pose, Twist
from xpbd_ros.sim.target_motion import check_motion, MAX_TURN, MonotoneCubic, Motion

RATE = 60
DT = 1.0 / RATE


def nanoseconds(frame):
    """Return the time at which a frame begins [ns]."""
    return round(frame * 10**9 / RATE)


def follow(motion, frames, aims=lambda frame: ()):
    """Advance by some frames and return the poses, the first before them."""
    poses = [motion.pose]
    for frame in range(frames):
        for pose, twist, stamp_ns in aims(frame):
            motion.aim(pose, twist, stamp_ns, nanoseconds(frame))
        motion.advance(nanoseconds(frame + 1), DT, nanoseconds(frame + 1))
        assert motion.start is poses[-1]
        poses.append(motion.pose)
    return poses


def along_x(poses):
    """Return the velocities along x in each frame [m/s]."""
    return np.diff([pose.position[0] for pose in poses]) / DT


def turns(poses):
    """Return the angle turned in each frame [rad]."""
    r = Rotation.from_quat([pose.orientation for pose in poses])
    return (r[1:] * r[:-1].inv()).magnitude()


@pytest.mark.parametrize('stamped', [False, True])
@pytest.mark.parametrize('every', [1, 2, 3, 6])
def test_a_stream_slower_than_the_frames_does_not_ring(every, stamped):
    """Its own speed comes out in every frame, not a dash and a stop."""
    speed = 0.3

    def aims(frame):
        if frame % every == 0:
            stamp = 10**9 + nanoseconds(frame) if stamped else 0
            yield Pose((speed * frame * DT, 0.0, 0.0)), None, stamp

    velocity = along_x(follow(Motion(Pose(), 5.0), 60, aims))
    begin = 4 * every + 4 if stamped else 2 * every
    np.testing.assert_allclose(velocity[begin:], speed, rtol=1e-6)


def test_a_target_without_a_stamp_is_reached_in_the_time_since_the_last():
    """At constant linear and angular speed, if max_speed forbids reaching it in one frame."""
    goal = tuple(Rotation.from_rotvec([0.0, 0.0, 0.9]).as_quat().tolist())
    poses = follow(Motion(Pose(), 5.0, lever=0.01), 50, lambda frame: {
        0: [(Pose(), None, 0)], 24: [(Pose((1.0, 0.0, 0.0), goal), None, 0)]}.get(frame, ()))
    np.testing.assert_allclose(along_x(poses)[24:48], 2.5, rtol=1e-6)
    np.testing.assert_allclose(turns(poses)[24:48], 0.9 / 24, rtol=0.05)    # a chord for an arc
    assert poses[-1] == Pose((1.0, 0.0, 0.0), goal)


def test_a_twist_gives_the_speed_of_what_comes_once():
    poses = follow(Motion(Pose(), 5.0), 90, lambda frame: [
        (Pose((0.03, 0.0, 0.0)), Twist((0.1, 0.0, 0.0)), 0)] if frame == 0 else [])
    velocity = along_x(poses)
    np.testing.assert_allclose(velocity[:18], 0.1, rtol=1e-9)
    np.testing.assert_allclose(velocity[18:], 0.0, atol=1e-12)
    assert poses[-1].position == (0.03, 0.0, 0.0)


def test_a_target_after_a_pause_is_not_part_of_a_stream():
    """Else the pin would creep while no target arrives."""
    motion = Motion(Pose(), 5.0)
    motion.aim(Pose(), None, 0, 0)
    motion.aim(Pose((0.01, 0.0, 0.0)), None, 0, 10**10)
    motion.advance(10**10 + nanoseconds(1), DT)
    assert motion.pose.position == (0.01, 0.0, 0.0)


def test_a_jump_of_10_m_is_followed_at_max_speed_and_reported():
    motion = Motion(Pose(), 5.0)
    motion.aim(Pose((10.0, 0.0, 0.0)), None, 0, 0)
    for frame in range(119):
        motion.advance(nanoseconds(frame + 1), DT)
        assert motion.limited
        assert motion.pose.position[0] - motion.start.position[0] == pytest.approx(5.0 * DT)
    follow(motion, 2)
    assert not motion.limited
    assert motion.pose.position == (10.0, 0.0, 0.0)


def test_a_target_within_reach_is_met_exactly():
    motion = Motion(Pose((0.1, 0.2, 0.3)), 5.0)
    target = Pose((0.11, 0.19, 0.3), (0.0, 0.0, 0.1, 0.99**0.5))
    motion.aim(target, None, 0, 0)
    motion.advance(nanoseconds(1), DT)
    assert motion.pose is target
    assert not motion.limited


@pytest.mark.parametrize('angle', [0.3, 2.0, 3.14])
def test_a_turn_is_bounded_per_frame_and_arrives(angle):
    goal = Rotation.from_rotvec([0.0, 0.0, angle])
    motion = Motion(Pose(), 1e9)
    motion.aim(Pose((0.0, 0.0, 0.0), tuple(goal.as_quat())), None, 0, 0)
    poses = follow(motion, 12)
    assert turns(poses).max() <= MAX_TURN * 1.02    # a chord for an arc
    assert poses[-1].orientation == tuple(goal.as_quat())


def test_a_far_particle_turns_no_faster_than_max_speed():
    goal = Rotation.from_rotvec([0.0, 0.0, 1.0])
    motion = Motion(Pose(), 2.0, lever=0.5)
    motion.aim(Pose((0.0, 0.0, 0.0), tuple(goal.as_quat())), None, 0, 0)
    poses = follow(motion, 20)
    assert 0.5 * turns(poses).max() / DT <= 2.0 * 1.01
    assert (Rotation.from_quat(poses[-1].orientation).inv() * goal).magnitude() < 1e-7


def test_the_opposite_quaternion_is_no_turn():
    motion = Motion(Pose((0.0, 0.0, 0.0), (0.0, 0.6, 0.0, 0.8)), 5.0)
    motion.aim(Pose((0.01, 0.0, 0.0), (0.0, -0.6, 0.0, -0.8)), None, 0, 0)
    assert turns(follow(motion, 3)).max() < 1e-7
    assert not motion.limited
    assert motion.pose.position == (0.01, 0.0, 0.0)


def test_a_path_is_followed_until_the_first_target():
    motion = Motion(Pose(), 5.0, keyframes=lambda t: (0.5 * t, 0.0, 1.0 * t))
    poses = follow(motion, 30)
    for frame, pose in enumerate(poses):
        np.testing.assert_allclose(pose.position, (0.5 * frame * DT, 0.0, frame * DT), atol=1e-9)
    motion.aim(Pose((0.0, 0.0, 0.0)), None, 0, nanoseconds(30))
    follow(motion, 30)
    assert motion.pose.position == (0.0, 0.0, 0.0)


def test_a_path_too_fast_is_followed_at_max_speed():
    motion = Motion(Pose(), 1.0, keyframes=lambda t: (7.0 * t, 0.0, 0.0))
    np.testing.assert_allclose(along_x(follow(motion, 10)), 1.0, rtol=1e-9)
    assert motion.limited


def test_stop_stays_where_it_is():
    motion = Motion(Pose(), 5.0, keyframes=lambda t: (t, 0.0, 0.0))
    here = follow(motion, 5)[-1]
    motion.stop()
    for frame in range(5, 10):
        motion.advance(nanoseconds(frame + 1), DT)
    assert motion.pose == here
    for frame in range(10, 30):    # a stream
        motion.aim(Pose((0.01 * frame, 0.0, 0.0)), None, 1 + nanoseconds(frame),
                   nanoseconds(frame))
        motion.advance(nanoseconds(frame + 1), DT)
    here = motion.pose
    assert here.position[0] > 0.2
    motion.stop()
    motion.advance(nanoseconds(31), DT)
    assert motion.pose == here


def test_a_monotone_cubic_interpolates_without_overshoot():
    points = [[0.0, 0.0, 1.0, 0.0], [1.0, 0.5, 1.0, 0.0], [1.5, 0.5, 1.0, 2.0],
              [3.0, 0.1, 1.0, 2.5]]
    curve = MonotoneCubic(points)
    for t, *position in points:
        assert curve(t) == pytest.approx(position, abs=1e-15)
    assert curve(-5.0) == pytest.approx(points[0][1:])
    assert curve(99.0) == pytest.approx(points[-1][1:])
    along = np.array([curve(t) for t in np.linspace(0.0, 3.0, 301)])
    assert along[:, 0].max() <= 0.5 + 1e-12
    assert (along[:, 1] == 1.0).all()
    assert (np.diff(along[:, 2]) >= -1e-12).all()
    assert MonotoneCubic([[2.0, 1.0, 2.0, 3.0]])(0.0) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize('points, text', [
    ([], 'motion: must be a list of [t, x, y, z] (s, m)'),
    ([[0.0, 1.0, 2.0]], 'motion: must be a list of [t, x, y, z] (s, m)'),
    ([[1.0, 0, 0, 0], [1.0, 1, 0, 0]], 'motion: times must rise (got [1.0, 1.0])')])
def test_what_is_no_path_is_refused(points, text):
    with pytest.raises(InputError) as error:
        check_motion(points)
    assert str(error.value) == text
