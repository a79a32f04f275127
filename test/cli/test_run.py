"""``run``: the log that it writes, and what it refuses."""

import json
import os
from pathlib import Path
import signal
import struct
import subprocess
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores
import yaml

from support.logs import COMMANDS, recorded, SHEET
from support.meshes import disc, obj_text
from support.strict_reader import read_strictly
from xpbd_ros.cli.main import main
from xpbd_ros.cli.ros import commands_of
from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader
from xpbd_ros.ros.inputs import unpacked
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene


def program(*words, **options) -> subprocess.CompletedProcess:
    """Run ``python -m xpbd_ros`` in a process of its own."""
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    return subprocess.run([sys.executable, '-m', 'xpbd_ros', *map(str, words)], text=True,
                          capture_output=True, check=False, env=environment, **options)


@pytest.fixture(scope='module')
def scene(tmp_path_factory) -> Path:
    """Return the file of a scene."""
    file = tmp_path_factory.mktemp('scene') / 'sheet.yaml'
    file.write_text(SHEET)
    return file


@pytest.fixture(scope='module')
def done(scene, tmp_path_factory):
    """Return what ``run --json -`` printed, run as a program, and its log."""
    folder = tmp_path_factory.mktemp('run')
    done = program('run', scene, '-o', folder / 'out', '--json', '-')
    assert done.returncode == 0, done.stderr
    return done, folder / 'out'


def simulated(scene, overrides=None) -> list:
    """Return the frames that the scene has, stepped here."""
    simulation = compile_scene(load_scene(str(scene), overrides))
    return [simulation.frame(), *(simulation.step() for _ in range(15))]


def test_a_pin_that_slips_is_told(scene, tmp_path, capsys):
    assert main(['run', str(scene), '-o', str(tmp_path / 'out'), '--set',
                 'pins.left.slip=0.01']) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if 'slipped' in line]
    assert line.startswith("note     frame 1: pin 'left' slipped: the cloth pulled with 0.")
    assert line.endswith(' N, and it holds 0.01 N')
    counted = [(message.frame, unpacked(message.data, DiagnosticArray).status[0])
               for message in LogReader(tmp_path / 'out').messages({'/diagnostics'})]
    assert [(frame, status.level, {pair.key: pair.value for pair in status.values})
            for frame, status in counted] == [
                (1, DiagnosticStatus.WARN, {'pins_slipped': '1', 'stamps_moved_s': '0'})]


def test_a_log_without_guards_that_acted_tells_of_none(done):
    assert '/diagnostics' not in LogReader(done[1]).topics


def test_inputs_of_a_damaged_log_are_used_with_a_warning(done, scene, tmp_path, capsys):
    whole, = done[1].glob('*.mcap')
    damaged = tmp_path / 'damaged.mcap'
    damaged.write_bytes(whole.read_bytes()[:-5])
    words = ['run', str(scene), '-o', str(tmp_path / 'again'), '--commands', str(damaged)]
    assert main(words) == 0
    assert capsys.readouterr().err == (
        'xpbd_ros run: damaged log: the magic bytes at its end are missing or damaged; '
        'inputs may be lost\n')
    assert main([*words[:3], str(tmp_path / 'whole'), '--commands', str(whole)]) == 0
    assert capsys.readouterr().err == ''


def test_frames_whose_hash_a_damaged_log_has_lost_are_counted(scene, tmp_path, capsys,
                                                              monkeypatch):
    monkeypatch.setattr('xpbd_ros.log.mcap_file.CHUNK_SIZE', 800)
    assert main(['run', str(scene), '-o', str(tmp_path / 'out')]) == 0
    whole, = (tmp_path / 'out').glob('*.mcap')
    with open(whole, 'rb') as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    data = bytearray(whole.read_bytes())
    middle = chunks[len(chunks) // 2]
    start = middle.chunk_start_offset + middle.chunk_length - middle.compressed_size
    data[start:start + middle.compressed_size] = bytes(middle.compressed_size)
    whole.write_bytes(data)
    lost = set(range(16)) - {message.frame for message in LogReader(whole).messages(
        {'/cloth/state_hash'})}
    assert lost
    capsys.readouterr()
    file = tmp_path / 'run.json'
    assert main(['run', str(scene), '-o', str(tmp_path / 'again'), '--commands', str(whole),
                 '--json', str(file)]) == 1
    assert f'{len(lost)} of 16 frames have no state hash in the log' in capsys.readouterr().err
    assert json.loads(file.read_text())['commands']['frames_without_hash'] == len(lost)


def test_json_on_stdout_is_all_that_is_printed_there(done, scene):
    numbers = json.loads(done[0].stdout)
    assert done[0].stderr == ''
    assert {'frames', 'real_time_factor', 'step_ms', 'solver', 'run'} <= set(numbers)
    assert numbers['frames'] == 15
    assert numbers['real_time_factor'] > 0.0
    assert 0.0 < numbers['step_ms']['p50'] <= numbers['step_ms']['p95'] <= numbers['step_ms'][
        'max']
    assert numbers['solver']['method'] == 'gauss_seidel'
    assert numbers['solver']['substeps'] == 8
    assert numbers['run'] == str(done[1])


@pytest.mark.smoke
def test_the_log_holds_every_frame(done, scene):
    reader = LogReader(done[1])
    assert reader.whole
    counts = {topic: about.count for topic, about in reader.topics.items()}
    assert counts == {'/cloth/particles': 16, '/cloth/pin_states': 16, '/cloth/state_hash': 16,
                      '/cloth/mesh': 1, '/cloth/scene': 1, '/cloth/state': 1}
    stamps = [message.time_ns for message in reader.messages({'/cloth/particles'})]
    assert np.diff(stamps) == pytest.approx(1e9 / 60.0, abs=1)


def test_rosbags_reads_the_log(done, scene):
    assert read_strictly(done[1]).total() == LogReader(done[1]).count
    expected = simulated(scene)
    with AnyReader([done[1]], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
        clouds = [bag.deserialize(raw, connection.msgtype)
                  for connection, _, raw in bag.messages()
                  if connection.topic == '/cloth/particles']
    assert len(clouds) == len(expected) == 16
    for cloud, frame in zip(clouds, expected):
        assert (cloud.height, cloud.width, cloud.point_step) == (5, 7, 12)
        assert np.array_equal(np.frombuffer(cloud.data, np.float32).reshape(-1, 3),
                              frame.x.astype(np.float32))


def test_mcap_reads_the_log(done, scene):
    """With the schemas that it carries, and no ROS."""
    found = {}
    with (done[1] / 'out_0.mcap').open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.sequence, decoded))
        assert reader.get_header().profile == 'ros2'
    assert [sequence for sequence, _ in found['/cloth/pin_states']] == list(range(16))
    states = found['/cloth/pin_states'][-1][1]
    assert states.joint_names == ['left']
    assert states.transforms[0].translation.z == pytest.approx(0.1)
    # the state in float64, from which the run could go on
    (_, state), = found['/cloth/state']
    assert [field.name for field in state.fields][:6] == ['x', 'y', 'z', 'vx', 'vy', 'vz']
    assert len(found['/cloth/mesh'][0][1].triangles) == 2 * 6 * 4


def test_the_scene_in_the_log_makes_the_same_run_again(done, tmp_path):
    scene = tmp_path / 'scene.yaml'
    scene.write_text(LogReader(done[1]).scene)
    assert main(['run', str(scene), '-o', str(tmp_path / 'again'), '--json',
                 str(tmp_path / 'again.json')]) == 0
    assert hashes(tmp_path / 'again') == hashes(done[1])
    numbers = json.loads((tmp_path / 'again.json').read_text())
    assert numbers['state_hash'] == json.loads(done[0].stdout)['state_hash']


def test_a_mesh_is_mended_aloud_and_logged_unorganized(scene, tmp_path, capsys):
    vertices, triangles = disc(2)
    (tmp_path / 'disc.obj').write_text(obj_text(vertices, triangles) + 'v 0 0 0\n')
    (tmp_path / 'disc.yaml').write_text(yaml.safe_dump({
        'duration': 0.1, 'cloths': {'disc': {'mesh': {'file': 'disc.obj'}, 'density': 0.2}}}))
    assert main(['run', str(tmp_path / 'disc.yaml'), '-o', str(tmp_path / 'run'), '--json',
                 str(tmp_path / 'run.json')]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith('note')]
    note = 'cloths.disc.mesh: 1 vertex that no triangle uses; left out'
    assert said[0] == f'note     {note}'
    assert json.loads((tmp_path / 'run.json').read_text())['notes'][0] == note
    with open(tmp_path / 'run' / 'run_0.mcap', 'rb') as file:
        found = {channel.topic: message for _, channel, _, message in make_reader(
            file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(
                ['/cloth/particles', '/cloth/mesh'])}
    cloud = found['/cloth/particles']
    assert (cloud.height, cloud.width, cloud.row_step) == (1, 19, 228)
    places = np.frombuffer(bytes(cloud.data), np.float32).reshape(-1, 3)
    np.testing.assert_allclose(places[:, :2], vertices[:, :2], atol=1e-6)
    assert (places[:, 2] < -0.04).all(), 'it fell'
    assert [list(t.vertex_indices) for t in found['/cloth/mesh'].triangles] == triangles.tolist()
    assert main(['info', str(tmp_path / 'run')]) == 0
    (tmp_path / 'log').mkdir()
    (tmp_path / 'log' / 'scene.yaml').write_text(LogReader(tmp_path / 'run').scene)
    assert main(['run', str(tmp_path / 'log' / 'scene.yaml'), '-o', str(tmp_path / 'again')]) == 0
    assert hashes(tmp_path / 'again') == hashes(tmp_path / 'run')


def hashes(run) -> list[int]:
    """Return the hash of each frame of a log."""
    return [struct.unpack_from('<Q', message.data, 4)[0]
            for message in LogReader(run).messages({'/cloth/state_hash'})]


def test_keys_settings_and_duration_override_the_scene(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path('fast.yaml').write_text('solver: {substeps: 3, iterations: 2}\n')
    assert main(['run', str(scene), '--settings', 'fast.yaml', '--set', 'solver.substeps=5',
                 '--set', 'gravity=[0, 0, -1.5]', '--duration', '0.1']) == 0
    said = capsys.readouterr().out
    (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
    assert folder.name.startswith('xpbd_ros_run_'), 'a fresh folder with the time in its name'
    assert 'sheet: 6 frames, ' in said
    assert 'gauss_seidel, backward_euler, 5 × 2' in said
    assert f'log      {folder}' in said
    reader = LogReader(folder)
    assert 'gravity: [0, 0, -1.5]' in reader.scene
    assert reader.frames == 7


def repeated(log, *words, capsys) -> tuple[int, dict, list[str]]:
    """Return the exit code, the numbers and the complaints of ``run --commands``."""
    again = log.parent / f'again_{len(list(log.parent.iterdir()))}'
    code = main(['run', *map(str, words), '-o', str(again), '--commands', str(log), '--json',
                 '-'])
    out, err = capsys.readouterr()
    return code, json.loads(out)['commands'] if out else {}, err.splitlines()




@pytest.fixture(scope='module')
def log(scene, tmp_path_factory):
    """Return a log of 12 frames with inputs of several kinds."""
    return recorded(scene, tmp_path_factory.mktemp('log') / 'log', COMMANDS)


def test_a_repeated_run_is_compared_up_to_the_end_of_its_log(log, scene, capsys):
    code, found, said = repeated(log, scene, capsys=capsys)
    assert (code, said) == (0, [])
    assert found == {'log': str(log / 'log_0.mcap'), 'identical': True, 'frames': 13,
                     'frames_without_hash': 0,
                     'first_difference': None, 'first_collider': None,
                     'max_deviation_m': 0.0, 'scene': [],
                     'refused': [], 'notes': []}
    told = log.parent / 'told'
    assert main(['run', str(scene), '-o', str(told), '--commands', str(log)]) == 0
    assert hashes(told) == hashes(log)
    assert f'commands as in {log}/log_0.mcap: 13 frames, bit for bit\n' in capsys.readouterr().out


def test_other_keys_are_named_and_where_states_begin_to_differ(log, scene, capsys):
    code, found, said = repeated(log, scene, '--set', 'solver.substeps=5', capsys=capsys)
    assert code == 1
    assert found['identical'] is False
    assert found['scene'] == [{'key': 'solver.substeps', 'here': '5', 'log': '8'}]
    assert found['first_difference']['frame'] == 1
    assert 0 <= found['first_difference']['particle'] < 35
    assert 1e-5 < found['max_deviation_m'] < 0.1
    name = f'xpbd_ros run: {log}/log_0.mcap: '
    assert said[0] == f'{name}scene: solver.substeps: 5 here, 8 in the log'
    assert said[1].startswith(f'{name}differs from the log from frame 1 on, there most at ')


def test_a_key_that_changed_no_state_yet_is_told(log, scene, capsys):
    code, found, said = repeated(log, scene, '--set', 'cloths.sheet.friction=0.1', capsys=capsys)
    assert (code, found['first_difference'], found['frames']) == (1, None, 13)
    assert said == [f'xpbd_ros run: {log}/log_0.mcap: scene: cloths.sheet.friction: 0.1 here, '
                    '0.5 in the log']


def test_keys_that_no_state_depends_on_may_differ(log, scene, capsys):
    code, found, said = repeated(log, scene, '--set', 'solver.budget_ms=2', '--set',
                                 'frame_id=map', capsys=capsys)
    assert (code, found['identical'], said) == (0, True, [])


def test_another_scene_differs_from_the_start(log, scene, tmp_path, capsys):
    (tmp_path / 'other.yaml').write_text(scene.read_text().replace('[7, 5]', '[5, 5]'))
    code, found, said = repeated(log, tmp_path / 'other.yaml', '--duration', '0.1',
                                 capsys=capsys)
    assert (code, found['max_deviation_m']) == (1, None)
    assert found['first_difference'] == {'frame': 0, 'particle': None}
    assert said[0].endswith('scene: cloths.sheet.grid.resolution: [5, 5] here, [7, 5] in the log')
    assert said[1].endswith(': differs from the log from the start on')


def test_inputs_that_are_refused_are_errors(log, scene, capsys):
    code, found, said = repeated(log, scene, '--set', 'effects.pin.max_pins=1', capsys=capsys)
    assert code == 1
    assert [text.split(':')[0] for text in found['refused']] == ['frame 2', 'frame 5', 'frame 9']
    assert any('frame 2: Grasp is refused: ' in line for line in said)


def test_a_shorter_run_is_compared_as_far_as_it_goes(log, scene, capsys):
    code, found, said = repeated(log, scene, '--duration', '0.1', capsys=capsys)
    assert (code, found['frames'], said) == (0, 7, [])
    assert found['notes'] == ['1 inputs of the log act after frame 6, with which this run ends']
    code, found, said = repeated(log, scene, '--duration', '0.5', '--set', 'duration=0.5',
                                 capsys=capsys)
    assert (code, found['frames'], said) == (0, 13, [])
    assert found['notes'] == ['the log ends with frame 12, and this run with 30']


def test_a_log_that_began_in_the_midst_of_a_run_is_not_repeated(scene, tmp_path, capsys):
    log = recorded(scene, tmp_path / 'late', COMMANDS, begin=4)
    why = (f'{log}/late_0.mcap: begins in the middle of a run, with frame 4, so its inputs do not '
           'fit a run from the start; xpbd_ros resim repeats it from there')
    assert repeated(log, scene, capsys=capsys) == (1, {}, [f'xpbd_ros run: {why}'])
    assert main(['cost', str(scene), '--commands', str(log)]) == 2
    assert capsys.readouterr().err == f'xpbd_ros cost: {why}\n'
    with pytest.raises(InputError, match='begins in the middle'):
        commands_of('accuracy', str(log), load_scene(str(scene)), 10)
    assert [path.name for path in tmp_path.iterdir()] == ['late']


def test_a_study_lists_its_differences_from_the_log(log, scene, capsys):
    other = load_scene(str(scene), {'gravity': [0, 0, -5.0], 'solver.substeps': 3})
    assert sorted(commands_of('cost', str(log), other, 6)) == [2, 5, 9]
    name = f'xpbd_ros cost: {log}/log_0.mcap: '
    assert capsys.readouterr().err.splitlines() == [
        f'{name}scene: gravity: [0.0, 0.0, -5.0] here, [0.0, 0.0, -9.80665] in the log',
        f'{name}1 inputs of the log act after frame 6, with which this run ends']


BAD = {
    'no such scene': (['run', 'swinng'], "swinng: unknown scene; did you mean 'swing'?"),
    'no such file': (['run', 'none.yaml'], 'none.yaml: no such file'),
    'a folder': (['run', 'full'], 'full: is a folder'),
    'bad YAML': (['run', 'bad.yaml'], 'bad.yaml: line 3, column 1: '),
    'not UTF-8': (['run', 'latin.yaml'], 'latin.yaml: not UTF-8 text'),
    'unknown key': (['run', 'SCENE', '--set', 'cloths.sheet.densty=1'],
                    "cloths.sheet.densty: unknown key; did you mean 'density'?"),
    'a new pin': (['run', 'SCENE', '--set', 'pins.lefft={cloth: sheet, at: corner_01}'],
                  "sheet.yaml: pins.lefft: unknown pin; did you mean 'left'? (known: left)"),
    'a new collider': (['run', 'SCENE', '--set', 'colliders.bal.sphere.radius=0.1'],
                       'sheet.yaml: colliders.bal: the scene has none'),
    'negative density': (['run', 'SCENE', '--set', 'cloths.sheet.density=-0.2'],
                         'sheet.yaml: cloths.sheet.density: must be > 0 kg/m² (got -0.2)'),
    'set nothing': (['run', 'SCENE', '--set', 'gravity'],
                    '--set gravity: must be KEY=VALUE, such as solver.substeps=32'),
    'set no key': (['run', 'SCENE', '--set', '=3'], '--set =3: must be KEY=VALUE'),
    'set bad YAML': (['run', 'SCENE', '--set', 'gravity=[1, 2'], '--set gravity: line 1, column '),
    'set into a value': (['run', 'SCENE', '--set', 'duration.x=3'],
                         "'duration' holds a value, so it has no key 'x'"),
    'duration 0': (['run', 'SCENE', '--duration', '0'], 'duration: must be > 0 s (got 0.0)'),
    'duration < 0': (['run', 'SCENE', '--duration', '-1'], 'duration: must be > 0 s (got -1.0)'),
    'duration nan': (['run', 'SCENE', '--duration', 'nan'],
                     'duration: must be finite s (got nan)'),
    'duration inf': (['run', 'SCENE', '--duration', 'inf'],
                     'duration: must be finite s (got inf)'),
    'duration tiny': (['run', 'SCENE', '--duration', '0.001'],
                      'sheet.yaml: duration: must be from a frame (0.0167 s) to 1e+06 s '
                      '(got 0.001 s)'),
    'duration huge': (['run', 'SCENE', '--duration', '1e300'], 'to 1e+06 s (got 1e+300 s)'),
    'no settings': (['run', 'SCENE', '--settings', 'none.yaml'], 'none.yaml: no such file'),
    'not settings': (['run', 'SCENE', '--settings', 'SCENE'],
                     "sheet.yaml: must hold one section, 'solver:'"),
    'commands nowhere': (['run', 'SCENE', '--commands', 'none'], 'none: no such file or folder'),
    'commands no log': (['run', 'SCENE', '--commands', 'bad.yaml'], 'bad.yaml: is not '),
    'commands of another': (['run', 'SCENE', '--commands', 'other.mcap'],
                            'other.mcap: is not a log of xpbd_ros: it holds no scene'),
    'commands no bag': (['run', 'SCENE', '--commands', 'full'], 'full: holds no .mcap file'),
    'output exists': (['run', 'SCENE', '-o', 'full'], 'full: exists already'),
    'output a file': (['run', 'SCENE', '-o', 'bad.yaml'], 'bad.yaml: exists already'),
    'output nowhere': (['run', 'SCENE', '-o', '/dev/null/run'],
                       '/dev/null/run: cannot be written: Not a directory'),
    'json exists': (['run', 'SCENE', '-o', 'run', '--json', 'bad.yaml'],
                    'bad.yaml: exists already'),
    'json nowhere': (['run', 'SCENE', '--json', 'none/a.json'],
                     'none/a.json: there is no folder '),
    'picture JPEG': (['run', 'SCENE', '--picture', 'a.jpg'],
                     '--picture a.jpg: is written as PNG; end its name in .png'),
    'picture nowhere': (['run', 'SCENE', '--picture', 'none/a.png'],
                        'none/a.png: there is no folder '),
    'long name': (['run', 'a' * 300], 'File name too long'),
    'long settings': (['run', 'SCENE', '--settings', 'a' * 300], 'File name too long'),
}


@pytest.mark.parametrize('name', BAD)
def test_a_mistake_ends_with_2_and_one_line_and_writes_nothing(name, scene, tmp_path, monkeypatch,
                                                               capsys):
    monkeypatch.chdir(tmp_path)
    Path('bad.yaml').write_text('cloths:\n  a: [1, 2\n')
    Path('latin.yaml').write_bytes('gewölbt: 1'.encode('latin-1'))
    Path('full').mkdir()
    Path('full/mine').write_text('keep')
    with open('other.mcap', 'wb') as file:
        other = Writer(file)
        other.start('ros2')
        other.finish()
    words, reason = BAD[name]
    assert main([str(scene) if word == 'SCENE' else word for word in words]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.startswith('xpbd_ros run: ')
    assert err.count('\n') == 1, err
    assert reason in err
    assert sorted(map(str, Path().rglob('*'))) == ['bad.yaml', 'full', 'full/mine', 'latin.yaml',
                                                    'other.mcap']
    assert Path('full/mine').read_text() == 'keep'


def test_a_mistake_has_no_traceback_in_a_process_of_its_own(tmp_path):
    done = program('run', 'swinng', cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ''
    assert done.stderr.count('\n') == 1
    assert done.stderr.startswith("xpbd_ros run: swinng: unknown scene; did you mean 'swing'?")


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_leaves_a_log_that_is_whole(number, scene, tmp_path):
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(
        [sys.executable, '-m', 'xpbd_ros', 'run', scene, '-o', tmp_path / 'out', '--duration',
         '1e5'], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    log = tmp_path / 'out' / 'out_0.mcap'
    deadline = time.monotonic() + 240.0
    while not log.exists() or log.stat().st_size < 100_000:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(number)
    said, error = process.communicate()
    assert (said, process.returncode) == ('', 130)
    reader = LogReader(tmp_path / 'out')
    last = reader.topics['/cloth/particles'].count - 1
    assert error == (f'xpbd_ros run: interrupted after frame {last}; its log is '
                     f'{tmp_path / "out"}\n')
    assert reader.whole, reader.damage
    assert reader.topics['/cloth/particles'].count > 100


def test_a_picture_without_pyvista_is_refused_before_the_run(scene, tmp_path, capsys,
                                                              monkeypatch):
    monkeypatch.setattr('xpbd_ros.study.picture.offscreen.find_spec', lambda name: None)
    assert main(['run', str(scene), '--picture', str(tmp_path / 'run.png'), '-o',
                 str(tmp_path / 'out')]) == 2
    assert capsys.readouterr() == (
        '', "xpbd_ros run: --picture needs PyVista: pip install 'xpbd_ros[view]'\n")
    assert not (tmp_path / 'out').exists()


def test_a_picture_of_a_run_is_drawn_and_never_over_another(scene, tmp_path, capsys, pyvista):
    picture = tmp_path / 'run.png'
    words = ['run', str(scene), '--picture', str(picture), '-o']
    assert main([*words, str(tmp_path / 'one')]) == 0
    assert f'picture  {picture}' in capsys.readouterr().out
    assert 5_000 < picture.stat().st_size < 60_000
    assert main([*words, str(tmp_path / 'two')]) == 2
    assert str(picture) in capsys.readouterr().err
