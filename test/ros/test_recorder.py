"""The thread that writes a log: same hashes, bounded waiting, and errors that arrive."""

import errno
from functools import partial
from pathlib import Path
import threading
import time
from types import SimpleNamespace

import pytest

from support.logs import COMMANDS, SHEET, state_hashes
from support.waiting import PATIENCE, until
from xpbd_ros.cli.main import main
from xpbd_ros.errors import InputError
from xpbd_ros.log.background import Background, MOST_WAITING
from xpbd_ros.log.reader import LogReader
from xpbd_ros.ros.diagnostics import Status
from xpbd_ros.ros.guards import Tally, texts
from xpbd_ros.ros.outputs import Outputs
from xpbd_ros.ros.recorder import Recorder
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_text
from xpbd_ros.scene.save import scene_text


def begun(folder: Path, **keys):
    """Return a simulation of the sheet, and its recorder."""
    scene = scene_from_text(SHEET, where='sheet.yaml', name='sheet', overrides=keys)
    simulation = compile_scene(scene)
    return simulation, Recorder(folder, Outputs(simulation, 'world', scene_text(
        scene, simulation.solver)), epoch_ns=10**18)


@pytest.mark.parametrize('keys', [
    {}, {'solver.integrator': 'bdf2'}, {'solver.precision': 'float32'}])
def test_recorded_hashes_are_those_of_their_frames(tmp_path, keys):
    """The thread writes them while later frames are stepped."""
    simulation, recorder = begun(tmp_path / 'run', **keys)
    expected = {0: simulation.hash()}
    for _ in range(20):
        frame = simulation.step()
        recorder.frame(frame)
        expected[frame.index] = simulation.hash()
    assert len(set(expected.values())) == 21
    recorder.close()
    assert state_hashes(tmp_path / 'run') == expected


def test_inputs_have_the_time_at_which_they_act(tmp_path):
    """The time of the previous frame, so that a replay publishes them before the next one."""
    simulation, recorder = begun(tmp_path / 'run')
    for index in range(1, 9):
        recorder.frame(simulation.step(COMMANDS.get(index, ())))
    recorder.close()
    times = {(message.topic.rsplit('/', 1)[-1], message.frame): message.time_ns
             for message in LogReader(tmp_path / 'run').messages()}
    for topic, frame, acts in (('pins', 2, 1), ('pin_targets', 5, 4), ('state_hash', 5, 5)):
        assert times[topic, frame] == 10**18 + simulation.time_ns(acts)


def test_frames_wait_for_a_slow_disk_so_that_memory_is_bounded(tmp_path, monkeypatch):
    simulation, recorder = begun(tmp_path / 'run')
    held, write = threading.Event(), recorder.log.write
    monkeypatch.setattr(recorder.log, 'write', lambda *words, **names: (
        held.wait(PATIENCE), write(*words, **names)))
    given = []

    def give() -> None:
        for _ in range(3 * MOST_WAITING):
            recorder.frame(simulation.step())
            given.append(simulation.index)
    thread = threading.Thread(target=give)
    thread.start()
    until(lambda: len(given) >= MOST_WAITING - 1)
    time.sleep(0.2)
    assert len(given) <= MOST_WAITING + 1
    held.set()
    thread.join(PATIENCE)
    recorder.close()
    assert len(state_hashes(tmp_path / 'run')) == 3 * MOST_WAITING + 1


@pytest.mark.parametrize('last', [False, True])
def test_a_full_disk_is_told_by_a_later_call_and_the_log_stays_readable(tmp_path, monkeypatch,
                                                                        last):
    simulation, recorder = begun(tmp_path / 'run')
    recorder.frame(simulation.step())

    def full(*_):
        raise OSError(errno.ENOSPC, 'No space left on device')
    until(lambda: recorder._background.idle)
    recorder.log.flush()
    monkeypatch.setattr(recorder.log._file, 'write', full)
    recorder.frame(simulation.step())
    until(lambda: recorder._background.idle)
    with pytest.raises(InputError, match='cannot be written any further: No space left'):
        recorder.close() if last else recorder.frame(simulation.step())
    if not last:
        recorder.close()
    assert {message.frame for message in LogReader(tmp_path / 'run').messages()} == {0, 1}


def test_what_waits_is_written_before_the_end():
    done, background = [], Background()
    for k in range(3):
        background.run([partial(time.sleep, 0.05), partial(done.append, k),
                        partial(done.append, k)])
    background.close()
    assert done == [0, 0, 1, 1, 2, 2]
    assert background.idle


def test_guards_of_a_frame_are_counted_and_told_worst_first():
    tally = Tally()
    for count in (0, 3, 7, 2):
        tally.look({'pins_at_max_speed': 1, 'self_without_room': count, 'contacts': 5})
    assert tally.numbers({'frames_taken_back': 2}) == {'frames_taken_back': 2, 'guards': {
        'pins_at_max_speed': {'frames': 4, 'largest': 1},
        'self_without_room': {'frames': 3, 'largest': 7}}}
    assert texts(tally.found) == [
        'self_without_room: pairs of cloth were left out for lack of room, and may cross; raise '
        'effects.self_collision.room (in 3 frames, at most 7 in one)',
        'pins_at_max_speed: pins lagged behind their targets, held by max_speed (in 4 frames, at '
        'most 1 in one)']


def test_run_tells_that_a_pin_lags_behind_its_target(tmp_path, capsys):
    (tmp_path / 'sheet.yaml').write_text(SHEET.replace(
        'motion: [[0.0, 0.0, 0.0, 0.0], [0.2, 0.0, 0.0, 0.1]]',
        'target: [9.0, 0.0, 0.0], max_speed: 0.1'))
    assert main(['run', str(tmp_path / 'sheet.yaml'), '-o', str(tmp_path / 'run')]) == 0
    assert ('note     pins_at_max_speed: pins lagged behind their targets, held by max_speed (in '
            '15 frames, at most 1 in one)\n') in capsys.readouterr().out


def status_of_a_node(said: list) -> Status:
    """Return the status of a node without other findings; its log goes to ``said``."""
    log = SimpleNamespace(warning=lambda text, **names: said.append(text), error=said.append)
    return Status(SimpleNamespace(
        get_logger=lambda: log, waits=False, get_name=lambda: 'cloth', get_namespace=lambda: '/',
        get_node_names_and_namespaces=lambda: [('cloth', '/'), ('cloth', '/other')],
        following=SimpleNamespace(finding=''),
        error_monitor=SimpleNamespace(warning=''), stepper=None))


def test_what_happened_is_told_once():
    """Only in the second in which its counter increases."""
    said = []
    status = status_of_a_node(said)
    counts = {'frames_taken_back': 2, 'frames_on_one_thread': 5}
    for dropped, more, told in ((3, 0, '2 frames rolled back, not finite|3 frames dropped|'
                                 '5 frames of'),
                                (3, 0, ''), (10, 0, '7 frames dropped'), (10, 0, ''),
                                (10, 1, '1 frame rolled back, not finite|1 frame of')):
        found = {name: count + more for name, count in counts.items()}
        level, summary = status._findings(dropped, found)
        assert all(text in summary for text in told.split('|')), summary
        assert level == ('OK' if not told else 'ERROR' if 'finite' in told else 'WARN')
        assert summary == ('; '.join(said) or 'waiting')
        said.clear()
    status.jumped(-10**9)
    assert 'the clock jumped by -1.000 s' in status._findings(10, found)[1]
    assert status._findings(10, found) == ('OK', 'waiting')


def test_the_node_warns_of_contacts_without_room():
    said = []
    level, summary = status_of_a_node(said)._findings(0, {
        'frames_taken_back': 0, 'self_without_room': 12, 'contacts_without_room': 0})
    assert (level, [summary]) == ('WARN', said)
    assert summary == ('12 pairs of cloth were left out for lack of room, and may cross; raise '
                       'effects.self_collision.room')
