"""Configure, activate, deactivate, clean up, and again; and what cannot start says why."""

from pathlib import Path
import signal

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import pytest
from visualization_msgs.msg import MarkerArray

from support.node import Cloth, NodeProcess, PATIENCE, pin, TOWEL
from xpbd_ros.log.reader import LogReader


@pytest.fixture(scope='module')
def cloth(start, peer, towel):
    """Return a node that waits to be configured."""
    return Cloth(peer, start(scene=towel, mode='lockstep', autostart='false',
                             publish_clock='true'))


def test_waits_to_be_configured(cloth):
    assert cloth.state == 'unconfigured'
    assert cloth.topics() == (set(), set())
    assert cloth.get('scene')[0].endswith('towel.yaml')
    assert cloth.describe('gravity') == [], 'no scene, no keys of a scene'


@pytest.mark.smoke
def test_goes_through_its_states_and_back(cloth):
    for _ in range(2):
        assert cloth.go('configure')
        assert cloth.state == 'inactive'
        cloth.peer.until(lambda: '/cloth/particles' in cloth.topics()[0], 'topics')
        assert cloth.trigger('step') == (False, 'the node is not active')
        assert cloth.go('activate')
        assert cloth.state == 'active'
        cloth.statuses.clear()
        cloth.meet(pins=MarkerArray())
        frame = cloth.step()
        cloth.mark(pin('hand', (-0.2, -0.2, 0.004)))
        assert list(cloth.pin_state(cloth.step())) == ['hand']
        assert cloth.go('deactivate')
        assert cloth.state == 'inactive'
        assert cloth.go('activate')
        cloth.statuses.clear()
        cloth.status()
        assert cloth.step() == frame + 2, 'goes on where it stopped'
        assert list(cloth.pin_state(frame + 2)) == ['hand'], 'and holds what it held'
        assert cloth.go('deactivate', 'cleanup')
        assert cloth.state == 'unconfigured'
        cloth.peer.until(lambda: cloth.topics() == (set(), set()), 'topics to go', cloth.topics)
        cloth.clouds.clear()
        cloth.pins.clear()


@pytest.mark.parametrize('number', [Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_CLEANUP,
                                    Transition.TRANSITION_DEACTIVATE, 77])
def test_a_transition_that_it_does_not_have_is_refused(cloth, number):
    """By its number, as managers of lifecycles ask; rclpy alone would end the node."""
    assert cloth.state == 'unconfigured'
    request = ChangeState.Request()
    request.transition.id = number
    assert not cloth.peer.ask(ChangeState, '/cloth/change_state', request).success
    assert cloth.state == 'unconfigured'


@pytest.mark.parametrize(('values', 'reason'), [
    ({'scene': 'towl'}, "towl: unknown scene; did you mean 'towel'?"),
    ({'scene': 'no/such.yaml'}, 'no/such.yaml: no such file'),
    ({'publish_rate': 7.0}, 'publish_rate: must divide the frame rate of 60 Hz (got 7 Hz)'),
    ({'settings': 'nothing.yaml'}, 'nothing.yaml: no such file'),
])
def test_cannot_be_configured_says_why_and_stays(cloth, values, reason):
    good = dict(zip(values, cloth.get(*values)))
    assert cloth.set(**values) == (True, '')
    assert not cloth.go('configure')
    assert cloth.state == 'unconfigured'
    cloth.node.wait_for('[ERROR]', reason)
    assert cloth.set(**good) == (True, '')
    assert cloth.go('configure', 'cleanup'), 'no harm was done'


def test_an_occupied_record_path_keeps_the_node_inactive(cloth, tmp_path):
    run = tmp_path / 'run'
    run.mkdir()
    assert cloth.set(record__path=str(run)) == (True, '')
    assert cloth.go('configure')
    assert not cloth.go('activate')
    assert cloth.state == 'inactive'
    cloth.node.wait_for('[ERROR]', f'{run}: exists already; a log goes into a folder of its own')
    assert not list(run.iterdir())
    other = tmp_path / 'other'
    assert cloth.set(record__path=str(other)) == (True, '')
    assert cloth.go('activate', 'deactivate')
    assert LogReader(other).whole
    size = (other / 'other_0.mcap').stat().st_size
    assert cloth.go('activate', 'deactivate'), 'what lies there is its own: it takes another'
    *_, fresh = (line.split(' to ')[1] for line in cloth.node.said('recording to '))
    assert Path(fresh) != other
    assert LogReader(Path(fresh)).whole
    assert (other / 'other_0.mcap').stat().st_size == size
    assert cloth.set(record__path='') == (True, '')
    assert cloth.go('cleanup')


def test_a_shutdown_finishes_the_log(cloth, tmp_path):
    assert cloth.set(record__path=str(tmp_path / 'run'), mode='realtime') == (True, '')
    assert cloth.go('configure', 'activate')
    begin = len(cloth.clouds)
    cloth.peer.until(lambda: len(cloth.clouds) > begin + 5, 'frames')
    assert cloth.go('shutdown')
    assert cloth.state == 'finalized'
    assert LogReader(tmp_path / 'run').whole
    count = len(cloth.clouds)
    cloth.peer.spin(0.3)
    assert len(cloth.clouds) <= count + 5


BAD_STARTS = {
    'yaml': (['-p', 'scene:=bad.yaml'], 'bad.yaml: line 1, column'),
    'key': (['-p', 'scene:=unknown.yaml'], 'unknown.yaml: cloths.a.effects.strech: unknown '
                                           "effect; did you mean 'stretch'?"),
    'mode': (['-p', 'mode:=slow'], "mode: must be one of realtime, lockstep, fast (got 'slow')"),
    'range': (['-p', 'marker_rate:=-1.0'], 'marker_rate'),
    'type': (['-p', 'marker_rate:=10'], 'marker_rate'),
    'live key': (['-p', 'solver.substeps:=-3'], 'solver.substeps'),
    'record': (['-p', 'scene:=good.yaml', '-p', 'record.path:=.'], 'exists already'),
    'file': (['--params-file', 'nothing.yaml'], 'nothing.yaml'),
    'argument': (['--remp', 'a:=b'], "unknown ROS arguments: ['--remp', 'a:=b']"),
}


@pytest.fixture(scope='module')
def failed(tmp_path_factory, own_domain):
    """Return nodes that cannot start, all started at once."""
    nodes = {}
    for name, (arguments, _) in BAD_STARTS.items():
        folder = tmp_path_factory.mktemp('bad')
        (folder / 'good.yaml').write_text(TOWEL)
        (folder / 'bad.yaml').write_text('cloths: [')
        (folder / 'unknown.yaml').write_text(TOWEL.replace('stretch:', 'strech:').replace(
            'towel:', 'a:'))
        nodes[name] = NodeProcess(folder, '-r', f'__node:=bad{len(nodes)}', *arguments)
    yield nodes
    for node in nodes.values():
        node.kill()


@pytest.mark.parametrize('name', BAD_STARTS)
def test_what_cannot_start_ends_with_2_and_one_clear_line(failed, name):
    node, reason = failed[name], BAD_STARTS[name][1]
    assert node.process.wait(PATIENCE) == 2, node.lines
    bad = [line for line in node.lines if not line.startswith('[INFO]')
           and '[rcl]' not in line]    # which has its say before us
    assert len(bad) == 1, node.lines
    assert reason in bad[0]


def test_unknown_parameters_are_reported(start, towel):
    node = start('-r', '__node:=strange', scene=towel, mode='lockstep', solver__subteps=99,
                 solver__substeps=9)
    said = node.wait_for('parameter solver.subteps: ')
    assert "did you mean 'solver.substeps'?" in said
    assert 'max_message_bytes, solver.substeps, gravity, solver.iterations, ' in said, 'in order'
    node.wait_for('running, mode lockstep')
    assert len(node.said('[WARN]')) == 1
    assert node.end() == 0


def test_a_signal_ends_it_before_it_is_configured(start, peer, towel):
    node = start('-r', '__node:=waiting', scene=towel, autostart='false')
    assert Cloth(peer, node, '/waiting').state == 'unconfigured'
    peer.company.clear()
    assert node.end(signal.SIGTERM) == 0
