"""``resim``: the same states from a log alone, forks of it, and the deviation it reports."""

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys
import warnings

from mcap.reader import make_reader
from mcap.writer import Writer
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import MultiDOFJointState
from std_msgs.msg import Float64

from support.logs import COMMANDS, recorded, SHEET, state_hashes
from support.meshes import disc, obj_text
from support.node import TOWEL
from support.strict_reader import read_strictly
from xpbd_ros.cli.main import main
from xpbd_ros.cli.resim import take_recorded_vectors
from xpbd_ros.log.reader import LogReader
from xpbd_ros.ros.inputs import unpacked
from xpbd_ros.ros.repeat import Deviation
from xpbd_ros.sim.backend.simd import BITS
from xpbd_ros.sim.commands import MoveCollider, Pose
from xpbd_ros.study.deviation_picture import draw


@pytest.fixture(scope='module')
def scene(tmp_path_factory) -> Path:
    """Return the file of a scene."""
    file = tmp_path_factory.mktemp('scene') / 'sheet.yaml'
    file.write_text(SHEET)
    return file


@pytest.fixture(scope='module')
def log(scene, tmp_path_factory) -> Path:
    """Return a log of 12 frames with inputs of several kinds."""
    return recorded(scene, tmp_path_factory.mktemp('log') / 'log', COMMANDS)


@pytest.fixture(scope='module')
def late(scene, tmp_path_factory) -> Path:
    """Return a log of frames 4 to 12 of the same run."""
    return recorded(scene, tmp_path_factory.mktemp('late') / 'late', COMMANDS, begin=4)


def resim(log, *words, capsys) -> tuple[int, dict, str]:
    """Return the exit code, the numbers and the complaints."""
    code = main(['resim', str(log), *map(str, words), '--json', '-'])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else {}, err


def test_a_run_is_solved_again_from_its_log_alone(log, capsys):
    code, found, said = resim(log, capsys=capsys)
    assert (code, said) == (0, '')
    assert (found['identical'], found['frames'], found['first_frame']) == (True, 13, 0)
    assert (found['first_difference'], found['max_deviation_m']) == (None, 0.0)
    assert found['forked'] is None
    assert found['environment'] == []


def test_threads_change_no_state(log, capsys):
    assert resim(log, '--threads', 2, capsys=capsys)[:1] == (0,)


def test_a_log_from_the_middle_of_a_run_continues_from_its_checkpoint(late, log, capsys):
    assert {frame: state for frame, state in state_hashes(log).items() if frame >= 4} == (
        state_hashes(late))
    code, found, said = resim(late, capsys=capsys)
    assert (code, said) == (0, '')
    assert (found['identical'], found['frames'], found['first_frame']) == (True, 9, 4)
    code, _, said = resim(late, '--threads', 2, capsys=capsys)
    assert code == 2
    assert 'continues with its own threads (1)' in said


def test_keys_fork_a_run_from_its_start(log, tmp_path, capsys):
    new, picture = tmp_path / 'new', tmp_path / 'fork.png'
    code, found, said = resim(log, '--set', 'solver.substeps=5', '-o', new, '--picture', picture,
                              capsys=capsys)
    assert (code, said) == (0, '')
    assert found['first_difference']['frame'] == 1
    assert found['forked'] == {'frame': 0, 'keys': {'solver.substeps': 5}}
    assert 1e-5 < found['rms_deviation_m'] < found['max_deviation_m'] < 0.1
    assert picture.read_bytes()[:4] == b'\x89PNG'
    assert resim(new, capsys=capsys)[0] == 0
    logged = {message.frame: unpacked(message.data, Float64).data
              for message in LogReader(new).messages({'/cloth/deviation/largest'})}
    assert sorted(logged) == [*range(1, 13)]
    assert max(logged.values()) == found['max_deviation_m'] == pytest.approx(
        apart(log, new).max(), rel=1e-6)
    assert read_strictly(new)['/cloth/deviation/rms'] == 12


def apart(one: Path, other: Path) -> np.ndarray:
    """Return the distances of all particles of all frames of two logs."""
    def places(run):
        return np.array([np.frombuffer(message.data, np.float32, 3 * 35, len(message.data) - 421)
                         for message in LogReader(run).messages({'/cloth/particles'})])
    return np.linalg.norm((places(one).astype(float) - places(other)).reshape(-1, 35, 3), axis=2)


@pytest.mark.parametrize('run', ['log', 'late'])
def test_live_keys_fork_a_run_from_a_time(run, request, capsys):
    code, found, said = resim(request.getfixturevalue(run), '--set', 'gravity=[0, 0, -1]',
                              '--from', 0.1, capsys=capsys)
    assert (code, said) == (0, '')
    assert found['first_difference']['frame'] == 7
    assert found['forked'] == {'frame': 6, 'keys': {'gravity': [0, 0, -1]}}


@pytest.mark.parametrize('gravity', ['[0, 0, -1]', '[0, 0, -1.62]'])
def test_a_fork_from_a_time_can_be_solved_again(log, tmp_path, capsys, gravity):
    """ROS has no parameter for a list of integers and floats."""
    new = tmp_path / 'new'
    assert resim(log, '--set', f'gravity={gravity}', '--from', 0.1, '-o', new,
                 capsys=capsys)[0] == 0
    assert state_hashes(new)[12] != state_hashes(log)[12]
    code, found, _ = resim(new, capsys=capsys)
    assert (code, found['identical']) == (0, True)


@pytest.mark.parametrize('frame', [5])
def test_one_bit_of_one_input_is_found_at_its_frame(log, tmp_path, frame, capsys):
    def changed(data: bytes) -> bytes:
        message = deserialize_message(data, MultiDOFJointState)
        place = message.transforms[0].translation
        place.z = float(np.nextafter(place.z, 1.0))
        return serialize_message(message)
    code, found, said = resim(rewritten(log, tmp_path / 'other', '/cloth/pin_targets', changed),
                              capsys=capsys)
    assert code == 1
    assert found['first_difference']['frame'] == frame
    assert f'differs from the log from frame {frame} on' in said


@pytest.mark.parametrize(('part', 'axis', 'value'), [
    ('translation', 'y', float(np.nextafter(1.0, 2.0))), ('rotation', 'z', 1e-9)])
def test_one_bit_of_a_collider_that_touches_nothing_is_found(tmp_path, capsys, part, axis, value):
    """No state depends on it, but its recorded pose does."""
    scene = tmp_path / 'towel.yaml'
    scene.write_text(TOWEL)
    log = recorded(scene, tmp_path / 'log', {4: [MoveCollider('ball', Pose((0.0, 1.0, 0.16)))]})
    assert resim(log, capsys=capsys)[0] == 0

    def changed(data: bytes) -> bytes:
        message = deserialize_message(data, MultiDOFJointState)
        setattr(getattr(message.transforms[0], part), axis, value)
        return serialize_message(message)
    other = rewritten(log, tmp_path / 'other', '/cloth/collider_states', changed)
    code, found, said = resim(other, capsys=capsys)
    assert (code, found['identical'], found['first_difference']) == (1, False, None)
    assert found['first_collider'] == {'frame': 4, 'name': 'ball'}
    assert "collider 'ball': its pose differs from the log from frame 4 on" in said


def rewritten(log: Path, folder: Path, topic: str, change) -> Path:
    """Copy a log with its messages on a topic changed, or left out where that returns None."""
    folder.mkdir()
    source, = log.glob('*.mcap')
    with open(source, 'rb') as old, open(folder / 'other_0.mcap', 'wb') as new:
        reader, writer = make_reader(old), Writer(new)
        writer.start('ros2')
        schemas, channels = {}, {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding,
                                                            schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id],
                    channel.metadata)
            data = change(message.data) if channel.topic == topic else message.data
            if data is not None:
                writer.add_message(channels[channel.id], message.log_time, data,
                                   message.publish_time, message.sequence)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for each in reader.iter_attachments():
            writer.add_attachment(each.create_time, each.log_time, each.name, each.media_type,
                                  each.data)
        writer.finish()
    return folder


def test_a_log_whose_hashes_were_filtered_out_is_refused_for_that(log, tmp_path, capsys):
    code, _, said = resim(rewritten(log, tmp_path / 'other', '/cloth/state_hash',
                                    lambda data: None), capsys=capsys)
    assert code == 2
    assert said.endswith('.mcap: holds no ~/state_hash, with which a repeated run is compared; '
                         'take the log as it was recorded\n')


def test_a_log_is_complete_without_the_files_of_its_scene(tmp_path, capsys):
    mesh = tmp_path / 'disc.obj'
    mesh.write_text(obj_text(*disc(4)))
    scene = tmp_path / 'scene.yaml'
    scene.write_text(SHEET.replace('grid: {size: [0.6, 0.2], resolution: [7, 5]}',
                                   'mesh: {file: disc.obj}').replace('at: corner_00', 'at: [0]'))
    log = recorded(scene, tmp_path / 'log', {})
    assert LogReader(log).attachments['cloths.sheet.mesh.obj'] == mesh.read_bytes()
    mesh.unlink()
    code, found, said = resim(log, capsys=capsys)
    assert (code, found.get('frames'), said) == (0, 13, '')


def test_other_versions_are_named(log, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr('xpbd_ros.cli.resim.__version__', '9.9.9')
    assert main(['resim', str(log)]) == 0
    assert 'note      version: 9.9.9 here, 0.1.0 in the log\n' in capsys.readouterr().out


@pytest.mark.parametrize('size', [0.0, 1e-9, 1e-3])
def test_a_chart_of_one_level_is_drawn_without_a_warning(size, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        draw(tmp_path / 'a.png', [Deviation(k, size, size) for k in range(3)], 1 / 60, 'same')
    assert (tmp_path / 'a.png').stat().st_size > 5_000


def test_mistakes_are_one_line(log, late, tmp_path, capsys):
    for words, text in (
            (['--from', '1.0', '--set', 'gravity=[0, 0, 0]'],
             '--from: must be within the log, from 0.000 s to before 0.200 s (got 1 s)'),
            (['--from', '0.1'], '--from: has no effect without --set'),
            (['--from', '0.1', '--set', 'solver.method=jacobi'],
             'solver.method: cannot change while running'),
            (['--set', 'frame_rate=30'], '--set frame_rate: inputs and states of a log belong to '
             'frames, of which it has 60 Hz (got 30 Hz)'),
            (['--threads', '0'], '--threads: must be from 1 to 64 (got 0)'),
            (['--set', 'solver.substps=3'], "did you mean 'substeps'?"),
            (['-o', str(tmp_path)], f'{tmp_path}: exists already')):
        code, found, said = resim(log, *words, capsys=capsys)
        assert (code, found, said.count('\n')) == (2, {}, 1), words
        assert text in said, words


def test_a_damaged_checkpoint_is_refused(late, tmp_path, capsys):
    copy = tmp_path / 'late'
    shutil.copytree(late, copy)
    monkey = LogReader(copy).attachments['checkpoint']
    file, = copy.glob('*.mcap')
    data = file.read_bytes()
    at = data.index(monkey)
    file.write_bytes(data[:at] + bytes(len(monkey)) + data[at + len(monkey):])
    code, _, said = resim(copy, capsys=capsys)
    assert code == 2
    assert said.splitlines()[-1].endswith('and holds no checkpoint of it; record again')


@pytest.mark.parametrize(('name', 'set_to', 'expected'), [
    ('late', None, '256'), ('late', '128', '128'), ('log', None, None)])
def test_a_checkpoint_is_continued_with_its_own_vector_width(request, monkeypatch, name, set_to,
                                                             expected):
    """Unless the variable is set; then ``restore`` names the width that is needed."""
    log = LogReader(request.getfixturevalue(name))
    assert log.settings['vector_bits'] == str(BITS)
    log.settings['vector_bits'] = '256'
    monkeypatch.setenv('XPBD_ROS_VECTOR_BITS', set_to or '')    # is undone whatever follows
    if not set_to:
        monkeypatch.delenv('XPBD_ROS_VECTOR_BITS')
    take_recorded_vectors(log)
    assert 'XPBD_ROS_VECTOR_BITS' not in os.environ or set_to, 'it is imported already'
    monkeypatch.setattr('xpbd_ros.cli.resim.SIMD', 'not imported')
    take_recorded_vectors(log)
    assert os.environ.get('XPBD_ROS_VECTOR_BITS') == expected


@pytest.mark.slow
@pytest.mark.parametrize('bits', ['128', '256'])
def test_a_log_from_the_middle_of_a_run_continues_as_on_another_processor(tmp_path, scene, bits):
    code = ('import sys; from support.logs import COMMANDS, recorded;'
            'recorded(sys.argv[1], sys.argv[2], COMMANDS, begin=4)')
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    environment.pop('XPBD_ROS_VECTOR_BITS', None)
    log = tmp_path / 'log'
    subprocess.run([sys.executable, '-c', code, scene, log], check=True,
                   env={**environment, 'XPBD_ROS_VECTOR_BITS': bits})
    done = subprocess.run([sys.executable, '-m', 'xpbd_ros', 'resim', log, '--json', '-'],
                          env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)['identical']
    if bits != str(BITS):
        done = subprocess.run([sys.executable, '-m', 'xpbd_ros', 'resim', log],
                              env={**environment, 'XPBD_ROS_VECTOR_BITS': str(BITS)},
                              capture_output=True, text=True)
        assert done.returncode == 2
        assert f'set the environment variable XPBD_ROS_VECTOR_BITS={bits}' in done.stderr
