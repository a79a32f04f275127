"""``sweep``: the table is that of single runs, whatever the workers, and survives their deaths."""

from importlib.util import find_spec
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from support.logs import SHEET
from xpbd_ros import load
from xpbd_ros.cli.main import main
from xpbd_ros.log.reader import LogReader
from xpbd_ros.sim.measure import kinetic_energy, largest_strain
from xpbd_ros.study import parallel
from xpbd_ros.sweep import outcome
from xpbd_ros.sweep.parameters import draw, Range

pytestmark = pytest.mark.skipif(find_spec('pyarrow') is None,
                                reason="pyarrow is missing: pip install '.[cluster]'")
WARP = 'cloths.sheet.effects.stretch.warp'
VARY = ['--vary', f'{WARP}=100:1000:log', '--vary', 'solver.substeps=4:9', '--seed', '3']


@pytest.fixture
def scene(tmp_path) -> Path:
    file = tmp_path / 'sheet.yaml'
    file.write_text(SHEET)
    return file


def sweep(scene, folder, *words, code=0, capsys) -> dict:
    """Return the numbers of a sweep in this process."""
    assert main(['sweep', str(scene), '-o', str(folder), '--json', '-', '--workers', '1',
                 *map(str, words)]) == code
    return json.loads(capsys.readouterr().out)


def refused(capsys, *words) -> str:
    """Return the one line that refuses a sweep."""
    assert main(['sweep', *map(str, words)]) == 2
    said = capsys.readouterr()
    assert said.out == ''
    (line,) = said.err.splitlines()
    return line


def table(folder, *, wall: bool = False):
    """Return the table of a sweep, without the column that no two sweeps share."""
    from pyarrow import parquet
    found = parquet.read_table(Path(folder) / 'sweep.parquet')
    return found if wall else found.drop_columns(['wall_s'])


@pytest.mark.smoke
def test_a_row_is_the_outcome_of_a_run_with_its_values(scene, tmp_path, capsys):
    """Also for an empty cell, which leaves the value of the scene."""
    (tmp_path / 'values.csv').write_text(
        f'{WARP},gravity\n100,"[0, 0, -5]"\n,"[0, 0, -5]"\n200,\n')
    found = sweep(scene, tmp_path / 'out', '--table', tmp_path / 'values.csv', capsys=capsys)
    assert (found['runs'], found['failed'], found['workers']) == (3, 0, 1)
    assert found['table'] == str(tmp_path / 'out' / 'sweep.parquet')
    rows = table(tmp_path / 'out').to_pylist()
    for row, keys in zip(rows, ({WARP: 100.0, 'gravity': [0, 0, -5]}, {'gravity': [0, 0, -5]},
                                {WARP: 200.0})):
        simulation = load(scene, **keys)
        frames = [simulation.step() for _ in range(15)]
        x = frames[-1].x
        assert row['state_hash'] == f'{simulation.hash():016x}'
        assert row[WARP] == keys.get(WARP)
        assert row['height_mean_m'] == x[:, 2].mean()
        assert [row[f'{axis}_{side}_m'] for axis in 'xyz' for side in ('min', 'max')] == [
            extreme(x[:, k]) for k in range(3) for extreme in (np.min, np.max)]
        assert row['kinetic_j'] == kinetic_energy(simulation.state)
        assert row['strain'] == largest_strain(simulation) <= row['strain_peak']
        forces = [np.linalg.norm(frame.pins['left'].force) for frame in frames]
        assert row['pins.left.force_n'] == forces[-1]
        assert row['pins.left.force_peak_n'] == max(forces)
        assert (row['run'], row['error'], row['frames']) == (rows.index(row), None, 15)
    assert not (tmp_path / 'out' / 'rows').exists()


def test_a_refused_value_is_told_in_its_row_and_the_sweep_goes_on(scene, tmp_path, capsys):
    (tmp_path / 'values.csv').write_text(f'{WARP},duration\n100,0.1\n-1,0.1\n200,1e9\n300,0.1\n')
    found = sweep(scene, tmp_path / 'out', '--table', tmp_path / 'values.csv', code=1,
                  capsys=capsys)
    assert (found['runs'], found['failed']) == (4, 2)
    rows = table(tmp_path / 'out').to_pylist()
    assert [row['frames'] for row in rows] == [6, None, None, 6]
    assert rows[1]['error'].endswith(f'{WARP}: must be > 0 N/m (got -1)')
    assert 'duration: must be from a frame' in rows[2]['error']


@pytest.mark.parametrize('text, words', [
    ('cloths.sheet.effects.strech.warp\n100\n200\n', "unknown effect; did you mean 'stretch'?"),
    ('cloths.shet.density\n0.2\n', "unknown cloth; did you mean 'sheet'?"),
    (f'{WARP},{WARP}\n1,2\n', f"column 2: '{WARP}' is given twice"),
    (f'{WARP}\n', 'must hold a row of keys, and a row of values'),
    (f'{WARP},duration\n1,1\n2\n', 'line 3: 1 value for 2 keys'),
])
def test_a_table_of_other_keys_is_refused(text, words, scene, tmp_path, capsys):
    (tmp_path / 'values.csv').write_text(text)
    assert words in refused(capsys, scene, '--table', tmp_path / 'values.csv', '-o',
                            tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('words, said', [
    ((), 'xpbd_ros sweep: needs either --table or --vary, and not both'),
    (('--vary', f'{WARP}=1:2'), '--vary needs --runs'),
    (('--vary', f'{WARP}=1', '--runs', '2'), 'must be KEY=LOW:HIGH or KEY=LOW:HIGH:log'),
    (('--vary', f'{WARP}=2:1', '--runs', '2'), 'LOW must be less than HIGH'),
    (('--vary', f'{WARP}=0:1:log', '--runs', '2'), 'with log, LOW must be > 0'),
    (('--vary', 'solver.substps=1:9', '--runs', '2'), "did you mean 'substeps'?"),
    (('--vary', f'{WARP}=1:9', '--runs', '2', '--workers', '0'), '--workers: must be >= 1'),
])
def test_bad_ranges_are_refused_in_one_line(words, said, scene, tmp_path, capsys):
    assert said in refused(capsys, scene, '-o', tmp_path / 'out', *words)


def test_values_are_drawn_within_ranges_and_more_runs_only_add_some():
    ranges = [Range.parse('a=1e-3:1e3:log'), Range.parse('b=-1:1')]
    found = draw(ranges, 400, 5)
    a, b = (np.array([each[key] for each in found]) for key in 'ab')
    assert ((a >= 1e-3) & (a <= 1e3) & (abs(b) <= 1.0)).all()
    assert np.median(np.log10(a)) == pytest.approx(0.0, abs=0.3)
    assert b.mean() == pytest.approx(0.0, abs=0.1)
    assert abs(np.corrcoef(np.log(a), b)[0, 1]) < 0.15
    assert draw(ranges, 7, 5) == found[:7]
    assert draw(ranges, 7, 6) != found[:7]


def test_a_sweep_continues_and_grows_without_computing_a_row_again(scene, tmp_path, capsys):
    sweep(scene, tmp_path / 'all', *VARY, '--runs', 5, capsys=capsys)
    sweep(scene, tmp_path / 'out', *VARY, '--runs', 3, capsys=capsys)
    before = table(tmp_path / 'out', wall=True)
    assert all(isinstance(value, int) for value in before['solver.substeps'].to_pylist())
    rows = tmp_path / 'out' / 'rows'
    rows.mkdir()    # as after an interrupt: a row whose run was finished, and half of another
    row = {**table(tmp_path / 'all', wall=True).to_pylist()[3], 'wall_s': 77.0}
    (rows / '000003.json').write_text(json.dumps(row))
    (rows / '000004.part').write_text('{"ru')
    found = sweep(scene, tmp_path / 'out', *VARY, '--runs', 5, capsys=capsys)
    assert (found['runs'], found['resumed']) == (5, 4)
    after = table(tmp_path / 'out', wall=True)
    assert after.slice(0, 3).equals(before)
    assert after['wall_s'].to_pylist()[3] == 77.0
    assert table(tmp_path / 'out').equals(table(tmp_path / 'all'))
    assert 'out: holds a sweep that differs in its values; name another folder' in refused(
        capsys, scene, '-o', tmp_path / 'out', *VARY[:2], '--runs', 5)
    assert '--runs: must be at least 5, the runs that ' in refused(
        capsys, scene, '-o', tmp_path / 'out', *VARY, '--runs', 2)
    assert not rows.exists()
    assert 'holds no sweep' in refused(capsys, scene, '-o', tmp_path, *VARY, '--runs', 5)


def test_logs_are_those_of_the_runs(scene, tmp_path, capsys):
    pytest.importorskip('rclpy', reason="rclpy is missing: source a ROS, or pip install '.[ros]'")
    sweep(scene, tmp_path / 'out', *VARY, '--runs', 2, '--logs', capsys=capsys)
    logs = sorted((tmp_path / 'out' / 'logs').iterdir())
    assert len(logs) == 2
    for log, row in zip(logs, table(tmp_path / 'out').to_pylist()):
        reader = LogReader(log)
        assert reader.whole
        *_, last = reader.messages(['/cloth/state_hash'])
        assert last.frame == row['frames'] == 15
        assert f'{int.from_bytes(last.data[4:12], "little"):016x}' == row['state_hash']


def test_a_run_that_is_too_large_is_told_in_its_row(scene, tmp_path, monkeypatch, capsys):
    def compiled(scene, run=outcome.compile_scene):
        if scene.top.solver.substeps == 5:
            raise MemoryError('8 TiB')
        return run(scene)

    monkeypatch.setattr(outcome, 'compile_scene', compiled)
    (tmp_path / 'values.csv').write_text('solver.substeps\n4\n5\n6\n')
    found = sweep(scene, tmp_path / 'out', '--table', tmp_path / 'values.csv', code=1,
                  capsys=capsys)
    assert found['failed'] == 1
    assert [row['error'] for row in table(tmp_path / 'out').to_pylist()] == [
        None, 'not enough memory (8 TiB); use fewer particles', None]


def test_without_dask_several_workers_are_refused_with_the_remedy(
        scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    assert "pip install 'xpbd_ros[cluster]', or take --workers 1" in refused(
        capsys, scene, *VARY, '--runs', '2', '--workers', '2', '-o', tmp_path / 'out')


def test_a_library_that_does_not_load_is_told_with_its_reason(scene, tmp_path, monkeypatch,
                                                              capsys):
    """As a pyarrow for another NumPy, which is installed nevertheless."""
    (tmp_path / 'pyarrow.py').write_text("raise ImportError('it requires NumPy 2.0')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, 'pyarrow')
    said = refused(capsys, scene, *VARY, '--runs', '2', '-o', tmp_path / 'out')
    assert "needs pyarrow (it requires NumPy 2.0); pip install 'xpbd_ros[cluster]'" in said


@pytest.mark.parametrize('address', ['tcp://127.0.0.1:9', 'foo'])
def test_a_scheduler_that_is_not_there_is_told_in_one_line(address, scene, tmp_path, monkeypatch,
                                                           capsys):
    """Without a client for an address that has no port: that one would wait for itself."""
    distributed = pytest.importorskip('distributed',
                                      reason="Dask is missing: pip install '.[cluster]'")
    monkeypatch.setattr(parallel, 'PATIENCE', '1s')
    if address == 'foo':
        monkeypatch.setattr(distributed, 'Client', None)
    assert f'--scheduler {address}: no Dask scheduler answers there' in refused(
        capsys, scene, *VARY, '--runs', '2', '--scheduler', address, '-o', tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


@pytest.mark.slow
def test_a_killed_worker_loses_no_row_and_the_table_is_that_of_one_process(
        scene, tmp_path, capsys):
    pytest.importorskip('distributed', reason="Dask is missing: pip install '.[cluster]'")
    import psutil
    words = [*VARY, '--runs', '14', '--duration', '8']
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(
        [sys.executable, '-m', 'xpbd_ros', 'sweep', scene, *words, '--workers', '2', '-o',
         tmp_path / 'two'], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=environment)
    rows, killed = tmp_path / 'two' / 'rows', False
    while process.poll() is None and not killed:
        time.sleep(0.01)
        if len([*rows.glob('*.json')]) >= 3:
            workers = [child for child in psutil.Process(process.pid).children()
                       if 'spawn_main' in ' '.join(child.cmdline())]
            assert len(workers) == 2
            os.kill(workers[0].pid, signal.SIGKILL)
            killed = True
    said, error = process.communicate(timeout=300)
    assert killed
    assert (process.returncode, error) == (0, ''), said
    sweep(scene, tmp_path / 'one', *words, capsys=capsys)
    assert table(tmp_path / 'two').equals(table(tmp_path / 'one'))
