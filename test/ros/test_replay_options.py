"""Options of ``replay`` that ``ros2 bag play`` has: filters, ends, delay, clock, QoS, bursts."""

import time

import pytest
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String, UInt64

from support.logs import cdr_uint64
from support.replayed import nanoseconds
from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader
from xpbd_ros.ros.qos_file import qos_overrides
from xpbd_ros.ros.replay import Replay

START = 1_700_000_000_000_000_000


@pytest.mark.parametrize(('flags', 'topics'), [
    (['--regex', '/cloth/(count|text)'], {'/cloth/count', '/cloth/text'}),
    (['--exclude-regex', '/cloth/t.*'], {'/cloth/count', '/cloth/scene'}),
    (['--regex', '/cloth/.*', '-x', '.*t'], {'/cloth/scene'})])
def test_topics_are_chosen_by_regular_expressions(write_log, ended, flags, topics):
    found, _, _ = ended(write_log(), '--rate', 10, *flags)
    assert set(found['topics']) == topics


@pytest.mark.parametrize(('flags', 'count'), [
    (['--playback-until-nsec', START + 500_000_010], 31),
    (['--playback-until-sec', 1_700_000_000.25], 15),
    (['--playback-until-nsec', START + 500_000_010, '--playback-duration', 0.25], 31),
    (['--playback-until-nsec', START + 250_000_010, '--playback-duration', 0.5], 30)])
def test_it_ends_at_a_time_or_after_a_duration_whichever_is_later(write_log, ended, flags, count):
    found, _, _ = ended(write_log(), '--rate', 10, '--topics', '/cloth/count', *flags)
    assert found['messages'] == count


def test_a_delay_comes_before_each_round(write_log, replay, ended, listener):
    run = write_log(frames=2)
    assert ended(run, '--delay', 1.5)[2] >= 1.5
    heard = []
    listener.node.create_subscription(
        UInt64, '/cloth/count', lambda _: heard.append(listener.node.get_clock().now()), 10)
    replay(run, '--loop', '--delay', 0.3)
    listener.until(lambda: len(heard) > 8)
    rounds = [1e-9 * (later - one).nanoseconds for one, later in zip(heard, heard[2:])]
    assert all(seconds > 0.3 for seconds in rounds), rounds


def test_the_log_takes_its_time_after_a_delay(write_log, own_domain):
    rclpy.init()
    node = Replay(LogReader(write_log()), delay=0.5)
    begin = time.monotonic()
    node.run(lambda: False)
    assert time.monotonic() - begin >= 0.5 + 59 / 60
    node.close()
    rclpy.shutdown()


@pytest.mark.parametrize(('flags', 'steps'), [
    (['--clock-topics', '/cloth/count'], {2 * 10**7}), (['--clock-topics-all'], {0, 2 * 10**7})])
def test_messages_set_the_clock(write_log, replay, listener, flags, steps):
    listener.listen(Clock, '/clock', raw=False)
    replay(write_log(frames=500, frame_ns=2 * 10**7), *flags)
    listener.until(lambda: len(listener.heard) > 30)
    times = [nanoseconds(message) for _, message in listener.heard]
    assert all((time_ns - START) % (2 * 10**7) == 0 for time_ns in times)
    assert {later - one for one, later in zip(times, times[1:])} == steps


def test_a_file_sets_the_quality_of_service(write_log, own_domain, tmp_path):
    file = tmp_path / 'qos.yaml'
    file.write_text('/cloth/count: {reliability: best_effort, durability: volatile, '
                    'history: keep_last, depth: 7, deadline: {sec: 1, nsec: 5}}\n'
                    '/cloth/text: {durability: transient_local, history: keep_all}\n')
    rclpy.init()
    node = Replay(LogReader(write_log()), paused=True, qos=qos_overrides(file))
    profiles = {topic: publisher.qos_profile for topic, publisher in node._publishers.items()}
    node.close()
    rclpy.shutdown()
    count = profiles['/cloth/count']
    assert (count.reliability, count.depth) == (ReliabilityPolicy.BEST_EFFORT, 7)
    assert count.deadline.nanoseconds == 10**9 + 5
    assert profiles['/cloth/text'].durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert profiles['/cloth/scene'].durability == DurabilityPolicy.TRANSIENT_LOCAL, 'as recorded'


@pytest.mark.parametrize(('text', 'said'), [
    ('- a', "must map topics to profiles, such as '/cloth/particles: "),
    ('/a: {reliabilty: reliable}', "/a.reliabilty: unknown key; did you mean 'reliability'?"),
    ('/a: {reliability: sure, depth: 1}',
     "/a.reliability: must be one of system_default, reliable, best_effort, best_available (got "
     "'sure')"),
    ('/a: {depth: 0}', '/a.depth: must be a whole number >= 1 (got 0)'),
    ('/a: {reliability: reliable}', "/a: needs 'depth', unless history is keep_all"),
    ('/a: {depth: 1, lifespan: 3}', '/a.lifespan: '),
    ('{', 'is not YAML: ')])
def test_a_profile_without_sense_is_refused(tmp_path, text, said):
    file = tmp_path / 'qos.yaml'
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        qos_overrides(file)
    assert str(caught.value).startswith(f'{file}: ')
    assert said in str(caught.value)
    assert '\n' not in str(caught.value)


def test_a_burst_publishes_so_many_messages_at_once(write_log, replay, listener):
    replay(write_log(frames=100, frame_ns=10**9), '--start-paused', '--topics', '/cloth/count')
    listener.listen(UInt64, '/cloth/count')
    listener.listen(String, '/cloth/scene', QoSProfile(
        depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    change = listener.node.create_client(SetParameters, '/xpbd_ros_replay/set_parameters')

    def burst(count) -> tuple[bool, str]:
        listener.until(change.service_is_ready)
        listener.spin(0.3)
        future = change.call_async(SetParameters.Request(
            parameters=[Parameter('burst', value=count).to_parameter_msg()]))
        listener.until(future.done)
        (found,) = future.result().results
        return found.successful, found.reason
    assert listener.call('is_paused') == (True, 'is paused at 0.000 s')
    assert burst(0) == (False, 'burst: must be >= 1 (got 0)')
    assert burst(10) == (True, '')
    assert listener.call('is_paused') == (True, 'is paused at 9.000 s')
    assert burst(5) == (True, '')
    expected = [('/cloth/count', cdr_uint64(frame)) for frame in range(10, 15)]
    listener.until(lambda: listener.heard[-5:] == expected)
    assert listener.call('is_paused') == (True, 'is paused at 14.000 s')
    listener.call('resume')
    assert burst(1) == (False, 'burst: is playing; pause first')
