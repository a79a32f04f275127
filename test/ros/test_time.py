"""What time it is: the clock of those who listen, or /clock, as beside another simulator."""

import signal
import time

from diagnostic_msgs.msg import DiagnosticArray
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import MultiDOFJointState, PointCloud2

from support.node import Cloth, points, stamp_ns
from support.tiers import slow
from xpbd_ros.log.reader import LogReader

FRAME = 16_666_667
"""[ns]"""

BEGIN = 1000 * 10**9
"""what the other simulator's clock says at first [ns]"""


class Simulator:
    """Publishes /clock."""

    def __init__(self, peer):
        self.peer, self.now_ns = peer, BEGIN

    def tell(self):
        """Say what time it is."""
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(self.now_ns, 10**9)
        self.peer.say('/clock', message)

    def set(self, now_ns: int) -> None:
        """Set the clock, and say so until it is heard."""
        self.now_ns = now_ns
        for _ in range(5):
            self.tell()
            self.peer.spin(0.05)

    def pass_slowly(self, seconds: float) -> None:
        """Let time pass, at half its pace, so that what takes time on the way matters less."""
        self.run(round(0.5e9 * seconds), 0.01)

    def run(self, nanoseconds: int, pause: float = 0.001) -> None:
        """Let time pass, in steps of 5 ms."""
        end = self.now_ns + nanoseconds
        while self.now_ns < end:
            self.now_ns = min(end, self.now_ns + 5_000_000)
            self.tell()
            self.peer.spin(pause)


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """Return where the node records to."""
    return tmp_path_factory.mktemp('log') / 'run'


def test_stamps_and_speed_are_those_of_the_clock(start, peer, towel, run):
    node = start(scene=towel, use_sim_time='true', record__path=run)
    cloth = Cloth(peer, node)
    node.wait_for('use_sim_time: waiting for /clock')
    peer.spin(0.5)
    assert cloth.clouds == [], 'nothing to stamp it with'
    assert not run.exists()
    simulator = Simulator(peer)
    peer.until(lambda: simulator.tell() or peer.spin(0.05) or run.exists(), 'the start')
    peer.spin(0.3)
    assert len(cloth.clouds) <= 1, 'time stands still'
    simulator.run(500_000_000)
    peer.until(lambda: stamp_ns(cloth.clouds[-1]) >= BEGIN + 450_000_000, 'half a second')
    assert all(BEGIN <= stamp_ns(cloud) <= simulator.now_ns for cloud in cloth.clouds)
    assert points(cloth.clouds[-1]).shape == (9, 9, 3)
    assert node.end() == 0
    peer.company.clear()
    reader = LogReader(run)
    assert reader.whole
    assert BEGIN <= reader.start_ns < reader.end_ns <= simulator.now_ns


def test_what_cannot_be_recorded_is_said_while_it_waits_for_the_clock(start, peer, towel,
                                                                      tmp_path):
    cloth = Cloth(peer, start('-r', '__node:=early', scene=towel, use_sim_time='true',
                              autostart='false', record__path=tmp_path), '/early')
    assert cloth.go('configure')
    assert not cloth.go('activate'), 'as without a clock to wait for'
    cloth.node.wait_for('[ERROR]', f'{tmp_path}: exists already; a log goes into a folder of its')
    run = tmp_path / 'run'
    assert cloth.set(record__path=str(run)) == (True, '')
    assert cloth.go('activate')
    waiting = False, 'use_sim_time: waiting for /clock'
    assert cloth.record(True) == waiting
    assert cloth.trigger('reset') == waiting, 'no frame without a time to stamp it with'
    assert cloth.trigger('save_state') == waiting
    assert not run.exists(), 'no log without a time to begin at'
    run.mkdir()
    simulator = Simulator(peer)
    peer.until(lambda: simulator.tell() or peer.spin(0.05) or cloth.clouds, 'the start')
    cloth.node.wait_for('[ERROR]', f'not recording: {run}: exists already')
    simulator.run(200_000_000)
    assert cloth.state == 'active', 'it goes on without a log'
    good, folder = cloth.record(True)
    assert good, folder
    assert cloth.record(False) == (True, folder)
    assert LogReader(folder).start_ns >= BEGIN
    assert cloth.node.end() == 0
    peer.company.clear()


def test_in_lockstep_all_services_act_before_the_clock(start, peer, towel, tmp_path):
    """A simulator may tell its first time after the first step; the log has the start."""
    run = tmp_path / 'run'
    cloth = Cloth(peer, start('-r', '__node:=locked', scene=towel, use_sim_time='true',
                              mode='lockstep'), '/locked')
    cloth.node.wait_for('running')
    assert cloth.set(record__path=str(run)) == (True, '')
    assert cloth.record(True) == (True, str(run))
    assert cloth.trigger('save_state') == (True, 'saved the state of frame 0')
    assert cloth.trigger('step') == (True, 'at frame 1')
    assert cloth.record(False)[0]
    assert LogReader(run).frames == 2
    assert cloth.node.end() == 0
    peer.company.clear()


def test_a_node_that_makes_the_clock_does_not_wait_for_it(start, peer, towel):
    cloth = Cloth(peer, start('-r', '__node:=source', scene=towel, use_sim_time='true',
                              publish_clock='true'), '/source')
    heard = peer.hear(Clock, '/clock')
    peer.until(lambda: len(cloth.clouds) > 30 and len(heard) > 30, 'frames')
    assert cloth.set(mode='lockstep') == (True, '')
    cloth.step()


class Ages:
    """How old clouds, pin states and diagnostics are when they come, by a client's clock [ns]."""

    def __init__(self, cloth, now_ns=time.time_ns):
        self.cloth, self.heard, self.now_ns = cloth, {}, now_ns
        for kind, topic in ((PointCloud2, f'{cloth.name}/particles'), (MultiDOFJointState,
                            f'{cloth.name}/pin_states'), (DiagnosticArray, '/diagnostics')):
            self.heard[topic] = []
            cloth.peer.node.create_subscription(
                kind, topic, lambda message, topic=topic: self._take(topic, message), 50)

    def _take(self, topic: str, message) -> None:
        name = self.cloth.name.lstrip('/')
        if topic != '/diagnostics' or message.status[0].name.startswith(f'{name}:'):
            self.heard[topic].append(self.now_ns() - stamp_ns(message))

    def are_fresh(self, wait=None) -> bool:
        """
        Tell whether what comes from now on is from no more than a frame before, and never later.

        The least of several ages counts: a busy machine may be slow to hand messages over.
        """
        for ages in self.heard.values():
            ages.clear()
        for _ in range(8):
            (wait or self.cloth.peer.spin)(1.2)
            if all(ages and min(ages) <= FRAME for ages in self.heard.values()):
                break
        return all(ages and -2_000_000 <= min(ages) <= FRAME for ages in self.heard.values())


@pytest.mark.slow
def test_stamps_are_the_clocks_after_whatever_held_frames_up(start, peer, towel):
    cloth = Cloth(peer, start('-r', '__node:=held', scene=towel), '/held')
    peer.until(lambda: cloth.clouds and cloth.statuses, 'the node')
    ages = Ages(cloth)
    assert ages.are_fresh()
    assert cloth.trigger('pause')[0]
    peer.spin(2.0)
    assert min(ages.heard['/diagnostics'][-1:]) < 10**9, 'a paused node says when it says so'
    assert cloth.trigger('play')[0]
    assert ages.are_fresh(), ('pause', ages.heard)
    assert cloth.set(mode='lockstep') == (True, '')
    peer.spin(1.5)
    cloth.step(40)
    assert cloth.set(mode='realtime') == (True, '')
    assert ages.are_fresh(), ('lockstep', ages.heard)
    frame = int(cloth.status()['frame'])
    assert cloth.set(mode='fast') == (True, '')
    cloth.status(lambda status: int(status['frame']) > frame + 600)
    assert cloth.set(mode='realtime') == (True, '')
    assert ages.are_fresh(), ('fast', ages.heard)
    for _ in range(5):
        assert cloth.trigger('reset')[0]
    assert ages.are_fresh(), ('reset', ages.heard)
    dropped = int(cloth.status()['dropped_frames'])
    cloth.node.process.send_signal(signal.SIGSTOP)
    time.sleep(1.5)
    cloth.node.process.send_signal(signal.SIGCONT)
    assert ages.are_fresh(), ('drops', ages.heard)
    assert int(cloth.status()['dropped_frames']) >= dropped + 60
    stamps = [stamp_ns(cloud) for cloud in cloth.clouds]
    assert all(b > a for a, b in zip(stamps, stamps[1:])), 'they rise'
    assert float(cloth.statuses[-1]['stamps_moved_s']) != 0.0, 'and it says by how much they moved'
    assert cloth.go('deactivate', 'activate')
    assert ages.are_fresh(), ('activate', ages.heard)
    assert cloth.node.end() == 0
    peer.company.clear()


@pytest.mark.parametrize('times_s', [(1090, 0.001), slow((1090, 500, 0.001))], ids=str)
def test_a_clock_that_is_set_is_followed(start, peer, towel, times_s):
    cloth = Cloth(peer, start('-r', '__node:=set', scene=towel, use_sim_time='true'), '/set')
    simulator = Simulator(peer)
    status = cloth.status()
    assert (status['level'], status['message']) == (b'\1', 'use_sim_time: waiting for /clock')
    peer.until(lambda: simulator.tell() or peer.spin(0.05) or cloth.clouds, 'the start')
    ages = Ages(cloth, lambda: simulator.now_ns)

    wait = simulator.pass_slowly
    wait(1.0)
    cloth.status(lambda status: status['message'] == 'waiting: /clock stands still')
    assert ages.are_fresh(wait)
    for time_s in times_s:
        cloth.statuses.clear()
        jump = '+' if 1e9 * time_s > simulator.now_ns else '-'
        simulator.set(round(1e9 * time_s))
        wait(0.5)
        assert ages.are_fresh(wait), (time_s, ages.heard)
        assert any(status['message'].startswith(f'the clock jumped by {jump}')
                   and status['level'] == b'\1' for status in cloth.statuses), cloth.statuses
    assert status['dropped_frames'] == '0', 'it was not slow'
    dropped = [int(line.split(': ')[1].split()[0]) for line in cloth.node.said('too slow')]
    assert sum(dropped) < 60, 'a clock that is set drops no frames'
    assert cloth.record(True)[0]
    simulator.set(BEGIN)
    cloth.statuses.clear()
    wait(0.5)
    while not cloth.statuses:
        wait(0.1)
    _, run = cloth.record(False)
    reader = LogReader(run)
    assert reader.whole
    times = [message.time_ns for message in reader.messages()]
    assert times == sorted(times), 'simulation time, which no clock jump changes'
    assert '/diagnostics' in reader.topics, 'and how far stamps moved from it'
    assert cloth.node.end() == 0
    peer.company.clear()


@pytest.mark.slow
def test_use_sim_time_may_be_set_while_it_runs(start, peer, towel):
    cloth = Cloth(peer, start('-r', '__node:=live', scene=towel), '/live')
    peer.until(lambda: cloth.clouds and cloth.statuses, 'the node')
    simulator = Simulator(peer)
    simulator.now_ns = 77 * 10**9
    simulator.tell()
    assert cloth.set(use_sim_time=True) == (True, '')
    peer.spin(0.5)
    ages = Ages(cloth, lambda: simulator.now_ns)
    count = len(cloth.clouds)
    peer.spin(1.0)
    assert len(cloth.clouds) <= count + 1, 'it waits for /clock'
    simulator.run(10**9)
    assert ages.are_fresh(simulator.pass_slowly), ages.heard
    assert cloth.set(use_sim_time=False) == (True, '')
    system = Ages(cloth)
    assert system.are_fresh(), system.heard
