"""``export``: the numbers of a log in each format, as other libraries read them."""

import json
from pathlib import Path
import resource
import tracemalloc

import meshio
import numpy as np
import pytest

from support.logs import recorded, SHEET
from xpbd_ros.cli.export import FORMATS
from xpbd_ros.cli.main import main
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.writer import LogWriter
from xpbd_ros.ros.logged_commands import Recording
from xpbd_ros.sim.commands import Grasp, Pose, Release

TWO = SHEET.replace('pins:', """
  ribbon:
    grid: {size: [0.3, 0.1], resolution: [4, 3]}
    density: 0.2
    effects: {stretch: {warp: 300.0, weft: 300.0}}
pins:""")
COMMANDS = {3: [Grasp('hand', Pose((0.6, 0.2, 0.0)), 0.05)], 6: [Release('hand')]}


@pytest.fixture(scope='module')
def log(tmp_path_factory) -> Path:
    """Return a log of 12 frames of one cloth, with a grasp and a release."""
    folder = tmp_path_factory.mktemp('log')
    (folder / 'sheet.yaml').write_text(SHEET)
    return recorded(folder / 'sheet.yaml', folder / 'log', COMMANDS)


@pytest.fixture(scope='module')
def two(tmp_path_factory) -> Path:
    """Return a log of two cloths."""
    folder = tmp_path_factory.mktemp('two')
    (folder / 'two.yaml').write_text(TWO)
    return recorded(folder / 'two.yaml', folder / 'log', {}, frames=4)


def export(log, folder, *words, capsys) -> dict:
    """Return the numbers that ``export`` printed."""
    assert main(['export', str(log), '-o', str(folder), '--json', '-', *map(str, words)]) == 0
    return json.loads(capsys.readouterr().out)


def recorded_positions(log) -> np.ndarray:
    """Return all positions of a log of one cloth; shape (frames, particles, 3)."""
    return np.array([positions for _, _, positions in Recording(str(log)).clouds()])


def test_npz_holds_the_bits_of_the_log(log, tmp_path, capsys):
    found = export(log, tmp_path / 'out', '--format', 'npz', capsys=capsys)
    assert (found['frames'], found['particles']) == (13, 35)
    (file,) = found['files']
    with np.load(file) as arrays:
        assert np.array_equal(arrays['sheet_positions'], recorded_positions(log))
        assert arrays['frame'].tolist() == list(range(13))
        assert arrays['time_s'] == pytest.approx(np.arange(13) / 60.0, abs=1e-8)
        assert arrays['sheet_triangles'].shape == (48, 3)


def test_several_cloths_and_every_second_frame(two, tmp_path, capsys):
    found = export(two, tmp_path / 'out', '--format', 'npz', '--every', 2, capsys=capsys)
    assert found['cloths'] == {'sheet': 35, 'ribbon': 12}
    with np.load(found['files'][0]) as arrays:
        assert arrays['frame'].tolist() == [0, 2, 4]
        assert arrays['sheet_positions'].shape == (3, 35, 3)
        assert arrays['ribbon_positions'].shape == (3, 12, 3)
    clouds = {(frame, topic): positions
              for frame, topic, positions in Recording(str(two)).clouds()}
    assert np.array_equal(np.load(found['files'][0])['ribbon_positions'][1],
                          clouds[2, '/cloth/cloth/ribbon/particles'])


def test_parquet_has_a_row_for_each_particle_and_for_each_pin(log, tmp_path, capsys):
    parquet = pytest.importorskip('pyarrow.parquet',
                                  reason="pyarrow is missing: pip install '.[export]'")
    found = export(log, tmp_path / 'out', '--format', 'parquet', capsys=capsys)
    particles, pins = (parquet.read_table(file).to_pydict() for file in found['files'])
    assert list(particles) == ['frame', 'time_s', 'cloth', 'particle', 'x', 'y', 'z']
    assert len(particles['x']) == 13 * 35
    assert set(particles['cloth']) == {'sheet'}
    assert particles['particle'][:35] == list(range(35))
    assert np.array_equal(
        np.column_stack([particles[axis] for axis in 'xyz']).astype(np.float32),
        recorded_positions(log).reshape(-1, 3))
    held = [frame for frame, pin in zip(pins['frame'], pins['pin']) if pin == 'hand']
    assert held == [3, 4, 5]
    assert max(map(abs, pins['force_z'])) > 0.01


@pytest.mark.parametrize('suffix', ['obj', 'ply'])
def test_a_mesh_file_for_each_frame(log, tmp_path, suffix, capsys):
    found = export(log, tmp_path / 'out', '--format', suffix, '--every', 6, capsys=capsys)
    assert [Path(file).name for file in found['files']] == [
        f'sheet_{frame:04d}.{suffix}' for frame in (0, 6, 12)]
    mesh = meshio.read(found['files'][-1])
    assert mesh.points == pytest.approx(recorded_positions(log)[12], abs=1e-6)
    assert len(mesh.cells_dict['triangle']) == 48


def test_usd_has_a_time_sample_for_each_frame(log, tmp_path, capsys):
    pytest.importorskip('pxr', reason="usd-core is missing: pip install '.[export]'")
    from pxr import Usd, UsdGeom
    found = export(log, tmp_path / 'out', '--format', 'usd', capsys=capsys)
    stage = Usd.Stage.Open(found['files'][0])
    assert UsdGeom.GetStageUpAxis(stage) == 'Z'
    assert stage.GetTimeCodesPerSecond() == 60.0
    points = UsdGeom.Mesh(stage.GetPrimAtPath('/cloths/sheet')).GetPointsAttr()
    assert points.GetTimeSamples() == list(range(13))
    assert np.array_equal(np.array(points.Get(7)), recorded_positions(log)[7])


def test_memory_does_not_grow_with_the_log(tmp_path, capsys):
    (tmp_path / 'sheet.yaml').write_text(SHEET.replace('[7, 5]', '[25, 20]'))
    log = recorded(tmp_path / 'sheet.yaml', tmp_path / 'log', {}, frames=1000)
    tracemalloc.start()
    try:
        found = export(log, tmp_path / 'out', '--format', 'npz', capsys=capsys)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    size = 1001 * 500 * 12
    assert np.load(found['files'][0])['sheet_positions'].nbytes == size
    assert peak < 0.4 * size


def test_a_damaged_log_is_exported_as_far_as_it_goes(log, tmp_path, capsys):
    source, = log.glob('*.mcap')
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(source.read_bytes()[:-5])
    assert main(['export', str(cut), '--format', 'npz', '-o', str(tmp_path / 'out')]) == 0
    assert 'damaged log: the magic bytes at its end are missing' in capsys.readouterr().err
    with np.load(tmp_path / 'out' / 'states.npz') as arrays:
        assert len(arrays['frame']) == LogReader(cut).frames


@pytest.mark.parametrize(('scene', 'text'), [
    ('cloths: [1, 2', 'scene: line 1, column 14: expected'),
    ('[1, 2]', 'scene: must be a mapping'),
    ('frame_rate: fast', 'scene.frame_rate: must be a number')])
def test_a_log_with_a_broken_scene_is_refused_in_one_line(log, tmp_path, scene, text, capsys):
    broken = tmp_path / 'broken'
    with LogWriter(broken, scene=scene, settings={}) as copy:
        whole = LogReader(log)
        for name, about in whole.topics.items():
            copy.add_channel(name, about.type, about.qos)
        for message in whole.messages():
            copy.write(message.topic, message.data, time_ns=message.time_ns, frame=message.frame)
    assert main(['export', str(broken), '--format', 'npz', '-o', str(tmp_path / 'out')]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert text in said
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(('words', 'text'), [
    (['--every', '0'], '--every: must be at least 1 (got 0)'),
    (['-o', '.'], '.: exists already')])
def test_mistakes_are_one_line(log, words, text, capsys):
    assert main(['export', str(log), '--format', 'npz', *words]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert text in said


@pytest.mark.parametrize('name', FORMATS)
def test_a_full_disk_is_one_line_and_leaves_nothing(log, tmp_path, name, capsys):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        assert main(['export', str(log), '--format', name, '-o', str(tmp_path / 'out')]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert said.startswith(f'xpbd_ros export: {tmp_path}/out')
    assert 'cannot be written: ' in said
    assert 'File too large; free some space, or name another folder by -o' in said
    assert not (tmp_path / 'out').exists()


def test_a_log_without_clouds_is_refused(write_log, capsys):
    assert main(['export', str(write_log()), '--format', 'npz']) == 2
    assert 'holds no ~/particles, so it is no log of xpbd_ros' in capsys.readouterr().err
