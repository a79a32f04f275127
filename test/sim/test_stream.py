"""Streams of stamped poses: how smoothly, how faithfully and how late they are followed."""

from math import cos, pi, sin

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xpbd_ros.sim.commands import Pose, Twist
from xpbd_ros.sim.target_motion import Motion
from xpbd_ros.sim.target_stream import CATCH_UP, Stream, UNEVEN_NS

FRAME = 1 / 60
EPOCH = 1_700_000_000_000_000_000
"""what the sender's clock says at the start [ns]"""
LONG, FAR = 2.0, 0.2
"""a move from rest to rest [s, m]"""
LARGEST = 0.5 * FAR * (pi / LONG)**2
"""its largest acceleration [m/s²]"""


def place(t):
    """Return where the sender's hand is [m]."""
    return 0.5 * FAR * (1.0 - cos(pi * min(max(t, 0.0), LONG) / LONG))


def speed(t):
    """Return how fast it is [m/s]."""
    return 0.5 * FAR * pi / LONG * sin(pi * t / LONG) if 0.0 <= t <= LONG else 0.0


def hand(t, *, twist):
    """Return pose and twist of the hand, which also turns about z by as many radians."""
    half = 0.5 * place(t)
    return Pose((place(t), 0.0, 0.0), (0.0, 0.0, sin(half), cos(half))), Twist(
        (speed(t), 0.0, 0.0), (0.0, 0.0, speed(t))) if twist else None


def follow(motion, sent, arrives, *, frames=200, pace=1.0, twist=False):
    """
    Return the motion's poses after each frame.

    ``sent`` are the sender's times [s], ``arrives`` when they come [s], in a simulation that takes
    ``pace`` of a second for one of the sender's.
    """
    poses, waiting = [motion.pose], sorted(zip(arrives, sent))
    for frame in range(frames):
        now_ns = round(frame * 1e9 / 60)
        while waiting and waiting[0][0] * pace * 1e9 <= now_ns:
            _, t = waiting.pop(0)
            motion.aim(*hand(t, twist=twist), EPOCH + round(t * 1e9), now_ns)
        motion.advance(round((frame + 1) * 1e9 / 60), FRAME)
        poses.append(motion.pose)
    return poses


def along_x(poses):
    return np.array([pose.position[0] for pose in poses])


def turned(poses):
    return Rotation.from_quat([pose.orientation for pose in poses]).as_rotvec()[:, 2]


@pytest.mark.parametrize('twist', [False, True])
@pytest.mark.parametrize('rate', [10, 30, 100, 1000])
def test_uneven_arrival_does_not_shake_it(rate, twist):
    """At most 1.5 times the acceleration of the hand, which arrives in 10 ms more or less."""
    for seed in range(5):
        late = 0.02 + np.random.default_rng(seed).uniform(-0.01, 0.01, round(2.3 * rate))
        sent = np.arange(len(late)) / rate - 0.1
        poses = follow(Motion(Pose(), 5.0), sent, np.maximum.accumulate(sent + 0.1 + late),
                       twist=twist)
        for moved in (along_x(poses), turned(poses)):
            assert moved[-1] == pytest.approx(FAR, abs=1e-12)
            assert np.abs(np.diff(moved, 2)).max() / FRAME**2 < 1.5 * LARGEST


@pytest.mark.parametrize(('twist', 'error'), [(False, 3e-4), (True, 1e-5)])
def test_it_is_where_the_hand_was_a_constant_delay_ago(twist, error):
    """With the hand's velocity a cubic is wrong by h⁴ / 384 times the fourth derivative."""
    sent = np.arange(70) / 30
    motion = Motion(Pose(), 5.0)
    moved = along_x(follow(motion, sent, sent - 1e-6, twist=twist))
    delay = 1e-9 * motion.stream.delay_ns
    assert delay == pytest.approx(2.0 / 30 + FRAME, abs=1e-6)
    now = np.arange(len(moved)) * FRAME
    assert moved == pytest.approx([place(t - delay) for t in now], abs=error)


def test_velocities_meet_between_frames_too():
    """However unevenly the poses were sent."""
    sent = np.random.default_rng(1).uniform(0.02, 0.04, 70).cumsum()
    stream = Stream(EPOCH, Pose(), 0)
    fine, moved = 1_000_000, []
    for k in range(2500):
        for t in sent[(sent > (k - 1) * 1e-3) & (sent <= k * 1e-3)]:
            stream.push(EPOCH + round(t * 1e9), hand(t, twist=False)[0], None, k * fine, Pose())
        if stream.last_ns > EPOCH:
            moved.append(stream.at((k + 1) * fine, fine))
    assert stream.late == 0
    assert np.abs(np.diff(along_x(moved), 2)).max() * 1e6 < 20.0 * LARGEST, 'a jump is 100 times'


def test_a_parabola_is_followed_exactly_however_unevenly_it_was_sent():
    """Slopes are those of the parabola through three poses, also at the last pose."""
    sent = [0.0, 0.08, *0.08 + np.random.default_rng(2).uniform(0.02, 0.08, 40).cumsum()]
    motion, moved = Motion(Pose(), 5.0), []
    for frame in range(200):
        for t in sent:
            if frame - 1 < 60 * t <= frame:
                motion.aim(Pose((0.05 * t * t, 0.0, 0.0)), None, EPOCH + round(t * 1e9),
                           round(frame * 1e9 / 60))
        motion.advance(round((frame + 1) * 1e9 / 60), FRAME)
        moved.append(motion.pose.position[0])
    times = np.sqrt([x / 0.05 for x in moved if 0.0 < x < moved[-1]])
    assert moved[-1] == 0.05 * sent[-1]**2
    assert len(times) > 100
    assert np.diff(times) == pytest.approx(FRAME, abs=1e-8)


def test_a_late_pose_is_awaited_and_lengthens_the_delay():
    sent = np.arange(70) / 30
    arrives = np.where(np.arange(70) < 20, sent, sent + 0.15)
    motion = Motion(Pose(), 5.0)
    moved = along_x(follow(motion, sent, arrives))
    assert motion.stream.late == 1
    assert moved[-1] == FAR
    assert np.diff(moved).min() > -1e-6, 'never back'
    assert np.diff(moved).max() / FRAME < 2.0 * speed(0.5 * LONG), 'no dash'


@pytest.mark.parametrize('pace', [0.3, 3.0])
def test_a_slow_or_fast_simulation_keeps_up_with_the_sender(pace):
    """Of a sender that takes 2 s, the simulation sees 0.6 s, or 6."""
    sent = np.arange(300) / 30 - 4.0
    motion = Motion(Pose((place(-4.0), 0.0, 0.0)), 5.0)
    count = round(5.0 * pace / FRAME)
    moved = along_x(follow(motion, sent, sent + 4.0, frames=count, pace=pace))
    begin = round(4.0 * pace / FRAME)
    now = np.arange(begin, count + 1) * FRAME / pace - 4.0
    lag = (2.0 / 30 + FRAME + 2.0 * CATCH_UP / pace + 2e-9 * UNEVEN_NS) * max(1.0, 1.0 / pace)
    assert (moved[begin:] <= [place(t) + 1e-3 for t in now]).all()
    assert (moved[begin:] >= [place(t - lag) - 1e-3 for t in now]).all()


def test_after_a_long_pause_the_stream_resumes_near_its_end():
    motion = Motion(Pose(), 5.0)
    sent = np.arange(180) / 30
    follow(motion, sent, np.where(sent < 1.0, sent, 6.0), frames=370)
    assert motion.pose.position[0] == FAR
    assert motion.stream.last_ns == EPOCH + round(sent[-1] * 1e9)


def test_where_many_poses_come_at_once_playback_skips_to_near_their_end():
    """It gets there within a period, and without a peak of speed."""
    def x(t):
        return 0.01 * t
    motion, moved, speed = Motion(Pose(), 5.0), [], 0.01
    sent = np.arange(300) / 30
    arrives = np.where((sent < 1.0) | (sent > 5.0), sent, 5.0)
    for frame in range(420):
        for t in sent[(frame - 1 < 60 * arrives) & (60 * arrives <= frame)]:
            motion.aim(Pose((x(t), 0.0, 0.0)), None, EPOCH + round(t * 1e9),
                       round(frame * 1e9 / 60))
        motion.advance(round((frame + 1) * 1e9 / 60), FRAME)
        moved.append(motion.pose.position[0])
    delay = 1e-9 * motion.stream.delay_ns
    for frame in range(306, 420):
        assert moved[frame] == pytest.approx(x((frame + 1) / 60 - delay), abs=2e-4)
    assert np.diff(moved).max() / FRAME < 1.5 * speed * 4.0 / (1.0 / 30 + FRAME)


def test_what_comes_again_or_too_late_is_passed_over():
    sent = np.arange(31) / 30
    once, twice = Motion(Pose(), 5.0), Motion(Pose(), 5.0)
    alone = follow(once, sent, sent, frames=90)
    again = np.concatenate([sent, sent, sent])
    arrives = np.concatenate([sent, sent + 1e-3, sent + 0.1])
    assert along_x(follow(twice, again, arrives, frames=90)) == pytest.approx(along_x(alone))


def test_a_restarted_clock_of_the_sender_starts_a_new_stream():
    motion = Motion(Pose(), 5.0)
    motion.aim(Pose((0.01, 0.0, 0.0)), None, EPOCH, 0)
    motion.advance(16_666_667, FRAME)
    motion.aim(Pose((0.02, 0.0, 0.0)), None, 10**9, 16_666_667)
    motion.advance(33_333_333, FRAME)
    assert motion.pose.position[0] == pytest.approx(0.02)


def test_a_stamp_that_stays_is_none():
    """As of a message that is sent again and again with another place in it."""
    motion = Motion(Pose(), 5.0)
    for k in range(1, 10):
        motion.aim(Pose((0.01 * k, 0.0, 0.0)), None, EPOCH, round(k * 1e9 / 60))
        motion.advance(round((k + 1) * 1e9 / 60), FRAME)
        assert motion.pose.position[0] == pytest.approx(0.01 * k)


@pytest.mark.parametrize('pause', [0, 9, 10])
def test_the_sign_of_a_quaternion_makes_no_turn(pause):
    """Also where poses arrive ``pause`` frames late and the curve is restarted."""
    motion, angles = Motion(Pose(), 5.0), [0.0]
    for frame in range(80):
        for k in range(30):
            if 2 * k + pause * (k >= 16) == frame:    # the previous one has the other sign
                sign, half = (-1.0)**k, 0.01 * k
                q = 0.0, sign * sin(half), 0.0, sign * cos(half)
                motion.aim(Pose((0.01 * k, 0.0, 0.0), q), None, EPOCH + k * 33_333_333,
                           frame * 16_666_667)
        motion.advance((frame + 1) * 16_666_667, FRAME)
        angles.append(Rotation(motion.pose.orientation).as_rotvec()[1])
    assert motion.stream.late == (pause > 0)
    assert min(np.diff(angles)) > -1e-9
    assert max(np.diff(angles)) < 0.02


def test_angular_velocities_are_in_world_axes():
    """10 Hz samples of a tilted body in uniform rotation about another axis are followed."""
    start, w = Rotation.from_rotvec([0.9, -0.7, 0.3]), np.array([0.8, 1.1, -0.6])
    motion, off = Motion(Pose(), 5.0), []
    for frame in range(120):
        now_ns = round(frame * 1e9 / 60)
        if frame % 6 == 0:
            turn = Rotation.from_rotvec(frame / 60 * w) * start
            motion.aim(Pose((0.0, 0.0, 0.0), tuple(turn.as_quat().tolist())),
                       Twist((0.0, 0.0, 0.0), tuple(w.tolist())), EPOCH + now_ns, now_ns)
        motion.advance(round((frame + 1) * 1e9 / 60), FRAME)
        if frame > 60:
            late = 1e-9 * motion.stream.delay_ns
            exact = Rotation.from_rotvec(((frame + 1) / 60 - late) * w) * start
            off.append((Rotation(motion.pose.orientation) * exact.inv()).magnitude())
    assert max(off) < 1e-6


def test_an_empty_twist_is_none():
    """A zero twist counts as missing unless another of the stream is not zero."""
    def moved(twist):
        motion, found = Motion(Pose(), 5.0), []
        for frame in range(120):
            if frame % 6 == 0:
                t, now_ns = frame / 60, round(frame * 1e9 / 60)
                motion.aim(hand(t, twist=False)[0], twist, EPOCH + now_ns, now_ns)
            motion.advance(round((frame + 1) * 1e9 / 60), FRAME)
            found.append(motion.pose)
        return found
    assert moved(Twist()) == moved(None)


def test_a_twist_that_contradicts_the_poses_does_no_harm():
    motion = Motion(Pose(), 5.0)
    for k in range(60):
        noise = np.random.default_rng(k).choice([-1e6, 0.0, 1e6], 6).tolist()
        motion.aim(Pose((0.001 * k, 0.0, 0.0)), Twist(tuple(noise[:3]), tuple(noise[3:])),
                   EPOCH + k * 33_333_333, k * 33_333_333)
        for half in (1, 2):
            before = motion.pose
            motion.advance(k * 33_333_333 + half * 16_666_667, FRAME)
            p, q = motion.pose.position, motion.pose.orientation
            assert np.linalg.norm(np.subtract(p, before.position)) <= 5.0 * FRAME * (1 + 1e-12)
            assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-12)
