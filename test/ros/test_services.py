"""Services: every answer tells the truth, in each mode."""

from pathlib import Path

import numpy as np
import pytest
from std_msgs.msg import String

from support.node import Cloth, LATCHED, points, stamp_ns
from xpbd_ros.log.reader import LogReader


@pytest.fixture(scope='module')
def node(start, peer, towel):
    """Return a node in real time that has been met."""
    cloth = Cloth(peer, start(scene=towel))
    peer.until(lambda: cloth.clouds and cloth.statuses, 'the node')
    return cloth


@pytest.fixture
def running(node):
    """Return it, running in real time."""
    assert node.set(mode='realtime') == (True, '')
    assert node.trigger('play')[0]
    return node


@pytest.fixture
def stepping(node):
    """Return it in mode lockstep."""
    assert node.set(mode='lockstep') == (True, '')
    assert node.trigger('play')[0]
    return node


def frame_in(answer: tuple[bool, str]) -> int:
    """Return the frame that a good answer names."""
    good, said = answer
    assert good, said
    return int(''.join(c for c in said.split('frame')[1].split('(')[0] if c.isdigit()))


def more_frames(cloth) -> bool:
    """Return whether frames come by themselves, as far as a while can tell."""
    count = len(cloth.clouds)
    cloth.peer.spin(0.3)
    return len(cloth.clouds) > count


def test_pause_stops_time_and_play_lets_it_run(running):
    begin = len(running.clouds)
    running.peer.until(lambda: len(running.clouds) > begin + 10, 'frames')
    frame = frame_in(running.trigger('pause'))
    running.cloud(frame)
    assert not more_frames(running)
    assert stamp_ns(running.clouds[-1]) == running.epoch_ns + round(frame * 1e9 / 60.0)
    assert frame_in(running.trigger('pause')) == frame, 'once more makes no difference'
    assert frame_in(running.trigger('play')) == frame
    begin = len(running.clouds)
    running.peer.until(lambda: len(running.clouds) > begin + 10, 'frames')


def test_a_pause_is_not_made_up_for(running):
    running.trigger('pause')
    dropped = int(running.status()['dropped_frames'])
    running.peer.spin(2.0)    # 120 frames
    frame = frame_in(running.trigger('play'))
    assert frame_in(running.trigger('pause')) - frame < 60
    assert int(running.status()['dropped_frames']) - dropped < 60


def test_step_is_refused_while_it_runs(running):
    assert running.trigger('step') == (
        False, 'the node steps by itself; call ~/pause first, or use mode lockstep')
    assert running.set(mode='fast') == (True, '')
    assert not running.trigger('step')[0]


def test_step_is_one_frame_while_paused(running):
    frame = frame_in(running.trigger('pause'))
    assert running.step() == frame + 1
    assert running.step(3) == frame + 4
    running.cloud(frame + 4)
    assert not more_frames(running)


def test_step_is_one_frame_in_lockstep(stepping):
    frame = frame_in(stepping.trigger('step'))
    before = len(stepping.clouds)
    stepping.cloud(frame)
    assert [frame_in(stepping.trigger('step')) for _ in range(5)] == list(
        range(frame + 1, frame + 6))
    stepping.cloud(frame + 5)
    assert not more_frames(stepping)
    assert len(stepping.clouds) <= before + 6


def test_play_says_that_lockstep_waits(stepping):
    good, said = stepping.trigger('play')
    assert good
    assert said.endswith('(mode lockstep: only ~/step advances)')
    assert not more_frames(stepping)


def test_reset_goes_back_to_the_start(stepping):
    frame = frame_in(stepping.trigger('reset'))
    start = stepping.cloud(frame)
    assert stepping.set(gravity=[0.0, 0.0, 5.0]) == (True, ''), 'upward'
    assert stepping.cloud(stepping.step(30))[..., 2].min() > 0.05
    assert stepping.set(gravity=[0.0, 0.0, -9.80665]) == (True, '')
    again = frame_in(stepping.trigger('reset'))
    assert again == frame + 31
    assert np.array_equal(stepping.cloud(again), start)


def test_reset_while_it_runs(running):
    frame = frame_in(running.trigger('reset'))
    assert points(running.clouds[-1])[..., 2].max() < 0.02
    assert frame_in(running.trigger('pause')) >= frame


def test_records_on_request_into_a_fresh_folder(running):
    told = running.peer.hear(String, '/cloth/recording', LATCHED)
    assert running.record(False) == (False, 'not recording')
    good, path = running.record(True)
    assert good
    assert Path(path).is_absolute()
    assert Path(path).parent == running.node.output.parent, 'in its working directory'
    assert Path(path).name.startswith('xpbd_ros_node_')
    assert running.record(True) == (False, f'already recording to {path}')
    begin = len(running.clouds)
    running.peer.until(lambda: len(running.clouds) > begin + 30, 'frames')
    assert int(running.status(lambda s: s['bytes_recorded'] != '0')['bytes_recorded']) > 0
    assert running.record(False) == (True, path)
    reader = LogReader(path)
    assert reader.whole, reader.damage
    assert reader.topics['/cloth/particles'].count >= 30
    assert running.record(False) == (False, 'not recording')
    _, other = running.record(True)
    assert other != path
    assert running.record(False) == (True, other)
    running.peer.until(lambda: [each.data for each in told[-4:]] == [path, '', other, ''],
                       'the paths', lambda: told)


def test_a_log_is_split_as_the_parameters_say_also_an_open_one(stepping, tmp_path):
    def frames_of_files(name: str, **live) -> list[int]:
        assert stepping.set(record__path=str(tmp_path / name)) == (True, '')
        assert stepping.record(True)[0]
        stepping.step(2)
        assert stepping.set(**live) == (True, '')
        stepping.step(11)
        assert stepping.record(False)[0]
        count = len(list((tmp_path / name).glob('*.mcap')))
        return [len(list(LogReader(tmp_path / name / f'{name}_{k}.mcap').messages(
            {'/cloth/state_hash'}))) for k in range(count)]
    assert stepping.set(record__split_duration=0.09) == (True, '')
    assert frames_of_files('new', mode='lockstep') == [6, 6, 2], 'of 1/60 s'
    assert stepping.set(record__split_duration=0.0) == (True, '')
    assert len(frames_of_files('open', record__split_duration=0.04)) > 2
    small = frames_of_files('small', record__split_duration=0.0, record__split_size=0.1)
    assert small == [14], 'which is 100 kB'
    assert len(frames_of_files('tiny', record__split_size=0.001)) > 2
    assert stepping.set(record__path='', record__split_size=4000.0) == (True, '')


def test_a_new_flush_period_applies_to_an_open_log(stepping, tmp_path):
    run = tmp_path / 'run'
    assert stepping.set(record__path=str(run), record__flush_period=3600.0) == (True, '')
    assert stepping.record(True) == (True, str(run))
    begin = (run / 'run_0.mcap').stat().st_size
    stepping.step()
    assert (run / 'run_0.mcap').stat().st_size == begin
    assert stepping.set(record__flush_period=0.01) == (True, '')
    stepping.peer.until(lambda: (run / 'run_0.mcap').stat().st_size > begin, 'a flush')
    assert stepping.record(False)[0]
    assert stepping.set(record__path='', record__flush_period=1.0) == (True, '')


def test_a_new_checkpoint_period_applies_to_an_open_log(stepping, tmp_path):
    run = tmp_path / 'run'
    assert stepping.set(record__path=str(run)) == (True, '')
    assert stepping.record(True) == (True, str(run))
    begin = stepping.step(5)
    assert stepping.set(record__checkpoint_period=0.05) == (True, ''), '3 frames'
    end = stepping.step(9)
    assert stepping.record(False)[0]
    frames = [message.frame for message in LogReader(run).messages({'/cloth/state'})]
    assert frames[1:] == [k for k in range(begin + 1, end + 1) if k % 3 == 0]
    assert stepping.set(record__path='', record__checkpoint_period=10.0) == (True, '')


def test_records_where_it_is_told_to(stepping, tmp_path):
    assert stepping.set(record__path=str(tmp_path / 'here')) == (True, '')
    assert stepping.record(True) == (True, str(tmp_path / 'here'))
    frame = stepping.step(7)
    assert stepping.record(False)[0]
    frames = [message.frame for message in LogReader(tmp_path / 'here').messages(
        {'/cloth/state_hash'})]
    assert frames == list(range(frame - 7, frame + 1)), 'from the state that it began with'
    assert (tmp_path / 'here' / 'metadata.yaml').exists()


@pytest.mark.parametrize('place', ['/dev/null/run', '/proc/run'])
def test_says_why_it_cannot_record(stepping, place):
    assert stepping.set(record__path=place) == (True, '')
    good, said = stepping.record(True)
    assert not good
    assert said.startswith(f'{place}: cannot be written: ')
    assert stepping.record(False) == (False, 'not recording')
    assert stepping.step(), 'goes on'
    assert stepping.set(record__path='') == (True, '')


def test_an_inactive_node_says_so(node):
    """Nothing waits for its activation: what a robot says meanwhile is refused."""
    assert node.go('deactivate')
    try:
        for service in ('pause', 'play', 'step', 'reset'):
            assert node.trigger(service) == (False, 'the node is not active')
        assert node.record(True) == (False, 'the node is not active')
        node.mark()
        node.node.wait_for('/cloth/pins: refused: the node is not active')
    finally:
        assert node.go('activate')
