"""However it ends, the log can be read; asked to end, it ends well."""

import signal
import subprocess
import sys
import time

import pytest

from support.node import child_environment, Cloth, NodeProcess, PATIENCE, stamp_ns, TOWEL
from support.strict_reader import read_strictly
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.recover import recover

FAILING = """
import sys
from xpbd_ros.ros.cloth_node import main
from xpbd_ros.sim.simulation import Simulation
step = Simulation.step
def fail(self, *arguments, **options):
    if self.index == 20:
        raise MemoryError('no room')
    return step(self, *arguments, **options)
Simulation.step = fail
sys.exit(main())
"""
SIGNALS = [signal.SIGINT, signal.SIGTERM]
CAST = [(number, moment) for number in SIGNALS for moment in ('compiling', 'running')]


@pytest.fixture(scope='module')
def ended(tmp_path_factory, towel, own_domain):
    """Return nodes that were told to end, by signal and moment; all at once, to save time."""
    nodes = {}
    for number, moment in CAST:
        folder = tmp_path_factory.mktemp('node')
        environment = {'XDG_CACHE_HOME': str(folder / 'cache'), 'NUMBA_CACHE_DIR': ''}
        nodes[number, moment] = NodeProcess(
            folder, '-r', f'__node:=n{len(nodes)}',
            parameters={'scene': towel, 'record.path': folder / 'run'},
            environment=environment if moment == 'compiling' else {})
    for (_, moment), node in nodes.items():
        node.wait_for(moment)
    time.sleep(0.5)    # into the thick of it
    for (number, _), node in nodes.items():
        node.process.send_signal(number)
    yield nodes
    for node in nodes.values():
        node.kill()


@pytest.mark.parametrize(('number', 'moment'), CAST)
def test_a_signal_ends_it_well(ended, number, moment):
    node = ended[number, moment]
    assert node.process.wait(PATIENCE) == 0, node.lines
    assert not node.said('Traceback'), node.lines
    assert not node.said('ERROR'), node.lines
    run = node.output.parent / 'run'
    assert run.exists() == (moment == 'running')
    if run.exists():
        reader = LogReader(run)
        assert reader.whole, reader.damage
        (topic,) = (topic for topic in reader.topics if topic.endswith('/particles'))
        frames = [message.frame for message in reader.messages({topic})]
        assert len(frames) > 5
        assert frames == list(range(len(frames)))
    else:
        assert not node.said('compiled in'), 'was interrupted'


def test_a_second_signal_does_not_cut_the_log_short(tmp_path, towel, own_domain):
    """As launch sends it: SIGINT, and SIGTERM when it loses patience."""
    node = NodeProcess(tmp_path, '-r', '__node:=twice',
                       parameters={'scene': towel, 'record.path': tmp_path / 'run'})
    try:
        node.wait_for('running')
        time.sleep(0.3)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGINT):
            node.process.send_signal(number)
        assert node.process.wait(PATIENCE) == 0, node.lines
        assert not node.said('Traceback'), node.lines
        assert LogReader(tmp_path / 'run').whole
    finally:
        node.kill()


def test_signals_that_go_on_do_not_cut_its_end_short(tmp_path, towel, own_domain):
    """As when a shell and launch both pass it on: one may come while Python takes itself apart."""
    node = NodeProcess(tmp_path, '-r', '__node:=often', parameters={'scene': towel})
    try:
        node.wait_for('running')
        deadline = time.monotonic() + PATIENCE
        while node.process.poll() is None and time.monotonic() < deadline:
            node.process.send_signal(SIGNALS[0])
            time.sleep(0.001)
        assert node.process.poll() == 0, node.lines
    finally:
        node.kill()


def test_a_step_that_fails_ends_it_with_1_and_a_whole_log(tmp_path, towel, own_domain):
    done = subprocess.run(
        [sys.executable, '-c', FAILING, '--ros-args', '-p', f'scene:={towel}',
         '-p', f'record.path:={tmp_path}/run'],
        env={**child_environment(), 'ROS_LOG_DIR': str(tmp_path)}, capture_output=True, text=True,
        check=False, timeout=PATIENCE)
    assert done.returncode == 1
    assert 'Traceback' not in done.stderr
    (line,) = (line for line in done.stderr.splitlines() if '[FATAL]' in line)
    assert line.endswith('stopped stepping: MemoryError: no room')
    reader = LogReader(tmp_path / 'run')
    assert reader.whole
    assert reader.frames == 21


def test_a_kill_costs_a_second_at_most(tmp_path, peer):
    small = tmp_path / 'small.yaml'    # so that no chunk of the log is filled meanwhile
    small.write_text(TOWEL.replace('[9, 9]', '[3, 3]'))
    node = NodeProcess(tmp_path, '-r', '__node:=killed',
                       parameters={'scene': small, 'record.path': tmp_path / 'run'})
    try:
        cloth = Cloth(peer, node, '/killed')
        peer.until(lambda: len(cloth.clouds) > 180, 'three seconds')
        node.kill()
        peer.company.clear()
        peer.spin(0.2)
    finally:
        node.kill()
    reader = LogReader(tmp_path / 'run')
    assert not reader.whole
    stamps = [message.time_ns for message in reader.messages({'/killed/particles'})]
    assert stamps == sorted(stamps)
    assert len(stamps) > 100
    lost = (stamp_ns(cloth.clouds[-1]) - stamps[-1]) * 1e-9
    assert lost < 1.0 + 0.25, 'record.flush_period, and what a busy machine adds'
    whole = recover(reader, tmp_path / 'whole')
    assert whole.whole
    assert read_strictly(tmp_path / 'whole') == {
        name: topic.count for name, topic in reader.topics.items()}
