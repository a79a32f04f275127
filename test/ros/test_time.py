"""A node that follows /clock, as beside another simulator."""

import pytest
from ros.rig import Cloth, points, stamp_ns
from rosgraph_msgs.msg import Clock

from xpbd_ros.log.reader import LogReader

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

    def run(self, nanoseconds: int) -> None:
        """Let time pass, in steps of 5 ms."""
        end = self.now_ns + nanoseconds
        while self.now_ns < end:
            self.now_ns = min(end, self.now_ns + 5_000_000)
            self.tell()
            self.peer.spin(0.001)


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


def test_a_node_that_makes_the_clock_does_not_wait_for_it(start, peer, towel):
    cloth = Cloth(peer, start('-r', '__node:=source', scene=towel, use_sim_time='true',
                              publish_clock='true'), '/source')
    heard = peer.hear(Clock, '/clock')
    peer.until(lambda: len(cloth.clouds) > 30 and len(heard) > 30, 'frames')
    assert cloth.set(mode='lockstep') == (True, '')
    cloth.step()
