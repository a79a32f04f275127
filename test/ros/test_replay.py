"""
``replay`` in a process of its own, over DDS, heard by a node in this one.

What must not be missed is replayed in a loop, so that nothing depends on how long discovery takes.
"""

import os
import pty
import re
import signal
import subprocess
import sys
import threading

from mcap.writer import Writer
import pytest
from rcl_interfaces.srv import GetParameters, SetParameters
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String, UInt64

from support.logs import cdr_string, cdr_uint64
from support.replayed import nanoseconds, padded, PATIENCE
from xpbd_ros.cli.main import main
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.writer import LogWriter
from xpbd_ros.ros.replay import Replay

START = 1_700_000_000_000_000_000
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_every_message_comes_as_it_was_recorded(write_log, replay, listener):
    run = write_log()
    log = LogReader(run)
    listener.listen(String, '/cloth/text')
    listener.listen(UInt64, '/cloth/count')
    listener.listen(String, '/cloth/scene', LATCHED)
    replay(run, '--loop')

    recorded = {topic: [padded(message.data) for message in log.messages([topic])]
                for topic in log.topics}

    def complete(topic):
        """Return whether a topic was heard from the start of the log to its end."""
        heard = [data for name, data in listener.heard if name == topic]
        assert set(heard) <= set(recorded[topic])
        length = len(recorded[topic])
        return any(heard[at:at + length] == recorded[topic] for at in range(len(heard)))

    listener.until(lambda: all(map(complete, recorded)))


def test_a_late_subscriber_gets_what_is_latched(write_log, replay, listener):
    replay(write_log(), '--start-paused')
    assert listener.call('play_next') == (True, '/cloth/scene, frame 0, at 0.000 s')
    listener.listen(String, '/cloth/scene', LATCHED)
    listener.until(lambda: listener.heard)
    assert listener.heard == [('/cloth/scene', padded(cdr_string('the scene')))]


def test_play_next_publishes_one_message_and_says_which(write_log, replay, listener):
    run = write_log(frames=600)
    recorded = list(LogReader(run).messages())
    replay(run, '--start-paused')
    listener.listen(UInt64, '/cloth/count')
    listener.listen(String, '/cloth/text')
    published = 0

    def play_next():
        nonlocal published
        message = recorded[published]
        published += 1
        seconds = (message.time_ns - START) * 1e-9
        assert listener.call('play_next') == (
            True, f'{message.topic}, frame {message.frame}, at {seconds:.3f} s')
        return message.topic, padded(message.data)

    last = {}
    while {topic for topic, _ in listener.heard} != {'/cloth/count', '/cloth/text'}:
        topic, data = play_next()    # lost, until the nodes have met
        last[topic] = data
        listener.spin(0.2)
    listener.until(lambda: {'/cloth/scene': last['/cloth/scene'], **dict(listener.heard)} == last)
    for _ in range(6):
        listener.heard.clear()
        expected = play_next()
        listener.until(lambda: listener.heard)
        listener.spin(0.1)
        assert listener.heard == [expected]


def test_paused_at_the_end_it_waits_and_says_so(write_log, replay, listener):
    process = replay(write_log(frames=2), '--start-paused')
    answers = [listener.call('play_next') for _ in range(7)]
    assert [success for success, _ in answers] == [True] * 5 + [False] * 2
    assert answers[-1][1] == 'no message after 0.017 s: the end of the log'
    assert process.poll() is None
    success, said = listener.call('resume')
    assert success
    assert said == 'goes on at 0.017 s'
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (0, '')
    assert out.endswith('ended after 5 messages\n')


def test_who_lets_it_end_gets_an_answer_even_if_slow_to_look(write_log, replay, listener):
    replay(write_log(frames=2), '--start-paused')
    while listener.call('play_next')[0]:
        pass
    assert listener.call('resume', after=0.5) == (True, 'goes on at 0.017 s')


def test_the_services_say_what_they_did(write_log, replay, listener):
    replay(write_log(frames=100, frame_ns=10**9), '--clock', 100)
    listener.listen(Clock, '/clock', raw=False)
    listener.until(lambda: listener.heard)
    success, said = listener.call('play_next')
    assert (success, said) == (False, 'is playing; pause first')
    success, said = listener.call('resume')
    assert success
    assert said.startswith('was playing at ')
    success, said = listener.call('pause')
    assert success
    assert said.startswith('is paused at ')
    moment = said.removeprefix('is paused at ')
    assert listener.call('pause') == (True, f'was paused at {moment}')
    listener.heard.clear()
    listener.until(lambda: len(listener.heard) > 5)
    listener.heard.clear()
    listener.until(lambda: len(listener.heard) > 5)    # the clock still tells, and stands still
    assert len({nanoseconds(message) for _, message in listener.heard}) == 1
    assert listener.call('toggle_paused') == (True, f'goes on at {moment}')
    listener.heard.clear()
    listener.until(lambda: len(listener.heard) > 5)
    assert len({nanoseconds(message) for _, message in listener.heard}) > 1
    success, said = listener.call('toggle_paused')
    assert success
    assert said.startswith('is paused at ')


def test_it_says_whether_it_is_paused_and_stops_on_request(write_log, replay, listener):
    process = replay(write_log(frames=100, frame_ns=10**9), '--start-paused')
    assert listener.call('is_paused') == (True, 'is paused at 0.000 s')
    listener.call('resume')
    success, said = listener.call('is_paused')
    assert (success, said[:14]) == (False, 'is playing at ')
    listener.call('pause')
    success, said = listener.call('stop')
    assert success
    assert said.startswith('stops at ')
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (0, '')
    assert 'ended after ' in out


def test_rate_and_position_are_parameters(write_log, replay, listener):
    replay(write_log(frames=100, frame_ns=10**9), '--start-paused', '--rate', 2)
    assert listener.call('pause') == (True, 'was paused at 0.000 s')
    get = listener.node.create_client(GetParameters, '/xpbd_ros_replay/get_parameters')
    change = listener.node.create_client(SetParameters, '/xpbd_ros_replay/set_parameters')

    def ask(client, request):
        listener.until(client.service_is_ready)
        listener.spin(0.3)
        future = client.call_async(request)
        listener.until(future.done)
        return future.result()

    def put(name, value) -> tuple[bool, str]:
        (found,) = ask(change, SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()])).results
        return found.successful, found.reason
    assert ask(get, GetParameters.Request(names=['rate'])).values[0].double_value == 2.0
    listener.listen(UInt64, '/cloth/count')
    listener.listen(String, '/cloth/scene', LATCHED)
    assert put('seek', 40.5) == (True, '')
    listener.until(lambda: [topic for topic, _ in listener.heard] == ['/cloth/scene'])
    assert listener.call('is_paused') == (True, 'is paused at 40.500 s')
    assert listener.call('play_next')[1] == '/cloth/count, frame 41, at 41.000 s'
    listener.until(lambda: ('/cloth/count', cdr_uint64(41)) in listener.heard)
    assert put('rate', 1e9) == (True, '')
    listener.call('resume')
    listener.until(lambda: ('/cloth/count', cdr_uint64(99)) in listener.heard)
    assert ('/cloth/count', cdr_uint64(40)) not in listener.heard
    assert [topic for topic, _ in listener.heard].count('/cloth/scene') == 1, 'latched'


@pytest.mark.parametrize(('name', 'value', 'said'), [
    ('rate', 0.0, 'rate: must be > 0 (got 0.0)'),
    ('seek', 99.5, 'seek: must be within the log, which is 99.000 s long (got 99.5)')])
def test_a_rate_or_position_without_sense_is_refused(write_log, own_domain, name, value, said):
    rclpy.init()
    node = Replay(LogReader(write_log(frames=100, frame_ns=10**9)), paused=True)
    (found,) = node._node.set_parameters([Parameter(name, value=value)])
    assert (found.successful, found.reason) == (False, said)
    node.close()
    rclpy.shutdown()


def test_a_service_answers_within_a_burst_of_messages(write_log, replay, listener):
    """Messages that are all late leave no pause between them."""
    replay(write_log(), '--loop', '--rate', 1e9)
    success, said = listener.call('pause')
    assert success
    assert said.startswith('is paused at ')


def test_the_clock_follows_the_log_in_place_of_a_recorded_one(tmp_path, replay, listener):
    run = tmp_path / 'run'
    with LogWriter(run, scene='', settings={}) as log:
        log.add_channel('/clock', 'rosgraph_msgs/msg/Clock', Qos())
        log.add_channel('/count', 'std_msgs/msg/UInt64', Qos())
        for frame in range(2000):
            log.write('/clock', bytes([0, 1, 0, 0, *bytes(8)]), time_ns=START + frame * 10**7,
                      frame=frame)    # tells 0
            log.write('/count', cdr_uint64(frame), time_ns=START + frame * 10**7, frame=frame)
    replay(run, '--clock')
    listener.listen(Clock, '/clock', raw=False)
    listener.until(lambda: len(listener.heard) > 20)
    times = [nanoseconds(message) for _, message in listener.heard]
    assert times == sorted(times)
    assert START <= times[0] < times[-1] < START + 20 * 10**9


def test_a_topic_may_get_another_name(write_log, replay, listener):
    listener.listen(UInt64, '/other/count')
    listener.listen(UInt64, '/cloth/count')
    replay(write_log(), '--loop', '--remap', '/cloth/count:=/other/count', 'cloth/text:=t')
    listener.until(lambda: listener.heard)
    listener.spin(0.2)
    assert {topic for topic, _ in listener.heard} == {'/other/count'}


def test_keys_of_the_terminal_control_it(write_log, own_domain):
    run = write_log(frames=600)
    terminal, inner = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, '-m', 'xpbd_ros', 'replay', str(run), '--start-paused', '--loop'],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))},
        stdin=inner, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    os.close(inner)

    def until(text):
        """Return the line that ends with a text."""
        for line in process.stderr:
            if re.search(text, line):
                return line
        pytest.fail(f'ended before {text}')

    try:
        timer = threading.Timer(PATIENCE, process.kill)
        timer.start()
        for keys, text in ((b'\x1b[C', 'frame 0, at 0.000 s'), (b'\x1b[C', 'frame 0, at 0.000 s'),
                           (b'\x1b[C\x1b[C', 'frame 1, at 0.017 s'), (b'\x1b[A', 'rate 1.1$'),
                           (b'\x1b[B', 'rate 1$'), (b'x ', 'playing at '), (b' ', 'paused at ')):
            os.write(terminal, keys)
            until(text)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0
    finally:
        timer.cancel()
        process.kill()
        process.communicate()
        os.close(terminal)


@pytest.mark.parametrize(('frame_ns', 'rate', 'least', 'most'), [
    (10**9, 40.0, 59 / 40, 50.0), (16_666_667, 0.5, 2 * 59 / 60, PATIENCE)])
def test_it_takes_its_time(write_log, ended, frame_ns, rate, least, most):
    """59 s at 40 times the rate; 1 s at half of it."""
    found, _, seconds = ended(write_log(frame_ns=frame_ns), '--rate', rate)
    assert found['messages'] == 121
    assert found['topics'] == {'/cloth/scene': 1, '/cloth/count': 60, '/cloth/text': 60}
    assert least <= seconds < most


def test_an_offset_is_skipped_but_for_what_is_latched(write_log, ended):
    found, _, _ = ended(write_log(), '--start-offset', 0.5)
    assert found['topics'] == {'/cloth/scene': 1, '/cloth/count': 30, '/cloth/text': 30}


def test_as_many_latched_messages_precede_an_offset_as_a_late_subscriber_gets(tmp_path, ended):
    with LogWriter(tmp_path / 'run', scene=None, settings={}) as log:
        log.add_channel('/latched', 'std_msgs/msg/UInt64',
                        Qos(durability='transient_local', depth=3))
        for k in range(7):
            log.write('/latched', cdr_uint64(k), time_ns=START + k * 10**8, frame=k)
    assert ended(tmp_path / 'run', '--start-offset', 0.45)[0]['topics'] == {'/latched': 3 + 2}


def test_only_the_topics_asked_for_are_published(write_log, ended):
    found, _, _ = ended(write_log(), '--topics', '/cloth/count')
    assert found['topics'] == {'/cloth/count': 60}


def test_topics_can_be_left_out_and_the_end_can_come_early(write_log, ended):
    found, _, seconds = ended(write_log(), '--exclude-topics', '/cloth/text', '--rate', 0.5,
                              '--start-offset', 0.25, '--playback-duration', 0.5)
    assert found['topics'] == {'/cloth/scene': 1, '/cloth/count': 30}
    assert seconds >= 2 * 29 / 60


def test_a_damaged_log_is_played_as_far_as_it_goes(write_log, ended):
    run = write_log(filling=5000)    # a chunk of 256 KiB holds 26 frames
    file = run / 'run_0.mcap'
    data = file.read_bytes()
    file.write_bytes(data[:len(data) * 2 // 3])
    found, err, _ = ended(run, '--rate', 10)
    assert 20 < found['topics']['/cloth/count'] < 60
    assert found['whole'] is False
    assert 'xpbd_ros replay: damaged log: it has no end' in err
    assert 'Traceback' not in err


def test_a_log_of_nothing_is_refused(write_log, replay):
    run = write_log()
    file = run / 'run_0.mcap'
    file.write_bytes(file.read_bytes()[:300])
    out, err = replay(run).communicate(timeout=PATIENCE)
    assert (out, err) == ('', f'xpbd_ros replay: {file}: holds no readable message\n')


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_without_a_traceback(write_log, replay, listener, number):
    process = replay(write_log(), '--loop')
    listener.listen(UInt64, '/cloth/count')
    listener.until(lambda: listener.heard)
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (0, '')
    assert out.splitlines()[-1].startswith('stopped after ')


def test_a_type_that_is_not_installed_is_left_out(tmp_path, ended):
    path = tmp_path / 'other.mcap'
    with open(path, 'wb') as file:
        log = Writer(file)
        log.start('ros2', 'another')
        for topic, type_name in (('/known', 'std_msgs/msg/UInt64'), ('/new', 'no_msgs/msg/Thing'),
                                 ('/typo', 'std_msgs/msg/Uint64'), ('/old', 'std_msgs/UInt64')):
            schema = log.register_schema(type_name, 'ros2msg', b'uint64 data')
            channel = log.register_channel(topic, 'cdr', schema)
            log.add_message(channel, START, cdr_uint64(1), START)
        channel = log.register_channel('/none', 'cdr', 0)
        log.add_message(channel, START, cdr_uint64(1), START)
        channel = log.register_channel('/json', 'json', schema)
        log.add_message(channel, START, b'{"data": 1}', START)
        log.finish()
    found, err, _ = ended(path)
    assert found['topics'] == {'/known': 1}
    assert '/new: left out, its no_msgs/msg/Thing cannot be published here' in err
    for topic in ('/typo', '/old', '/none', '/json'):
        assert f'{topic}: left out, its ' in err
    assert 'Traceback' not in err


@pytest.mark.parametrize(('flags', 'said'), [
    (['--rate', '0'], 'argument -r/--rate: must be > 0 (got 0)'),
    (['--rate', 'nan'], 'argument -r/--rate: must be > 0 (got nan)'),
    (['--start-offset', '-1'], 'argument --start-offset: must be >= 0 (got -1)'),
    (['--start-offset', '7'], '--start-offset: must be within the log, which is 0.983 s long '
                              '(got 7 s)'),
    (['--clock', '-4'], 'argument --clock: must be > 0 (got -4)'),
    (['--remap', '/a:='], 'argument -m/--remap: must be FROM:=TO'),
    (['--playback-until-nsec', '5'], '--playback-until: must not be before '
                                     '1700000000000000000 ns, where the replay starts (got 5 ns)'),
    (['--clock', '40', '--clock-topics-all'], 'not allowed with argument --clock'),
    (['--clock-topics', '/cloth/cuont'], '/cloth/cuont: the log has no such topic; did you mean '
                                         '/cloth/count?'),
    (['--regex', '['], 'argument -e/--regex: is no regular expression: unterminated character '
                       'set at position 0 (got [)'),
    (['--regex', '/cloth'], '--regex: leaves no topic of '),
    (['--exclude-regex', '.*'], '--exclude-regex: leaves no topic of '),
    (['--qos-profile-overrides-path', 'none.yaml'], 'none.yaml: cannot be read: No such file'),
    (['--playback-duration', '0'], 'argument --playback-duration: must be > 0 (got 0)'),
    (['--exclude-topics', '/cloth/cuont'], '/cloth/cuont: the log has no such topic; did you '
                                           'mean /cloth/count?'),
    (['--exclude-topics', '/cloth/scene', '/cloth/text', '/cloth/count'],
     '--exclude-topics: leaves no topic of '),
    (['--topics', '/cloth/cuont'], '/cloth/cuont: the log has no such topic; did you mean '
                                   '/cloth/count?')])
def test_bad_input_is_refused_in_one_line(write_log, capsys, flags, said):
    try:
        code = main(['replay', str(write_log()), *flags])
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    assert (code, out) == (2, '')
    assert said in err.splitlines()[-1]


def test_a_log_whose_topics_are_all_unreadable_is_refused(write_log, capsys):
    file = write_log(filling=5000) / 'run_0.mcap'    # topics are described in the first chunk
    file.write_bytes(file.read_bytes().replace(b'std_msgs/msg', b'std_msgs\xffmsg'))
    assert main(['replay', str(file)]) == 2
    assert capsys.readouterr().err.endswith(f'{file}: holds no readable message\n')


def test_a_log_of_which_nothing_can_be_published_is_refused(tmp_path, capsys):
    path = tmp_path / 'ros1.mcap'
    with open(path, 'wb') as file:
        log = Writer(file)
        log.start('ros1')
        schema = log.register_schema('std_msgs/UInt64', 'ros1msg', b'uint64 data')
        log.add_message(log.register_channel('/count', 'ros1', schema), START, bytes(8), START)
        log.finish()
    assert main(['replay', str(path)]) == 2
    out, err = capsys.readouterr()
    assert 'ended' not in out
    assert err.endswith(f'xpbd_ros replay: {path}: has no topic that can be published here\n')


def test_without_ros_it_says_how_to_get_it(write_log):
    code = ('import sys; sys.modules.update(rclpy=None);'
            'from xpbd_ros.cli.main import main; sys.exit(main(sys.argv[1:]))')
    done = subprocess.run([sys.executable, '-c', code, 'replay', write_log()],
                          capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, '')
    assert 'source /opt/ros/jazzy/setup.bash' in done.stderr
    assert "pip install 'xpbd_ros[ros]'" in done.stderr
    assert done.stderr.count('\n') == 1
