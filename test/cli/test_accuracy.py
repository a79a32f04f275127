"""``accuracy``: what it prints and writes, and that its settings are taken elsewhere."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from support.scenes import SMALL_SHEET
from xpbd_ros.cli.main import main
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.study.accuracy.motion import report_of


@pytest.fixture(scope='module')
def scene(tmp_path_factory):
    file = tmp_path_factory.mktemp('scene') / 'sheet.yaml'
    file.write_text(SMALL_SHEET)
    return file


@pytest.fixture(scope='module')
def done(scene, tmp_path_factory):
    """Return what the program printed, and its folder."""
    folder = tmp_path_factory.mktemp('accuracy') / 'out'
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', 'accuracy', scene, '-o', folder, '--methods', 'line',
         '--jobs', '1'], capture_output=True, text=True, check=False, env=environment)
    assert (done.returncode, done.stderr) == (0, '')
    return done.stdout, folder


def test_view_finds_the_settings_of_the_report(done):
    said, folder = done
    assert f'in motion  xpbd_ros view {folder}' in said
    numbers = json.loads((folder / 'accuracy.json').read_text())
    report = report_of(folder)
    names = [name.split('\n')[0] for name, _ in report.settings]
    assert names in (['reference', 'recommended', 'cheapest'], ['reference', 'recommended'])
    solver = report.settings[1].scene.top.solver
    for key in ('method', 'integrator', 'substeps', 'iterations', 'precision'):
        assert getattr(solver, key) == numbers['recommended'][key]
    assert (report.frames, report.commands) == (15, None)
    assert len(compile_scene(report.settings[0].scene).slot) == 18


def test_json_holds_what_is_promised(done):
    said, folder = done
    numbers = json.loads((folder / 'accuracy.json').read_text())
    assert {'settings', 'reference', 'recommended', 'pictures'} <= set(numbers)
    for row in numbers['settings']:
        assert {'method', 'integrator', 'substeps', 'iterations', 'precision', 'ms_p50', 'ms_p95',
                'rms_error_m', 'max_error_m', 'strain_error', 'energy_drift',
                'pareto'} <= set(row)
    assert any(row['pareto'] for row in numbers['settings'])
    assert numbers['reference']['kind'] == 'independent'
    chosen = numbers['recommended']
    assert chosen['ms_p95'] <= numbers['budget_ms'] == pytest.approx(1000.0 / 120.0)
    assert chosen['rerun']['error_m'] == pytest.approx(chosen['error_m'], rel=1e-9)
    for one in numbers['defaults']:
        assert one['ratio'] == pytest.approx(one['error_m'] / one['best']['error_m'], rel=1e-6)
        assert one['best']['ms_p95'] <= one['ms_p95']
        assert one['ratio'] >= 1.0
    for file in (*numbers['pictures'], numbers['report'], numbers['csv'], chosen['file']):
        assert os.path.isabs(file)
        assert os.path.getsize(file) > 100
    assert numbers['machine']['name'] in said
    assert f"line {chosen['integrator']} {chosen['substeps']}×" in said
    assert 'the scene' in said


def test_the_settings_file_gives_that_solver(done, scene, tmp_path):
    pytest.importorskip('rclpy', reason="rclpy is missing: source a ROS, or pip install '.[ros]'")
    _, folder = done
    chosen = json.loads((folder / 'accuracy.json').read_text())['recommended']
    assert main(['run', str(scene), '--settings', str(folder / 'settings.yaml'), '-o',
                 str(tmp_path / 'run'), '--json', str(tmp_path / 'run.json')]) == 0
    solver = json.loads((tmp_path / 'run.json').read_text())['solver']
    for key in ('method', 'integrator', 'substeps', 'iterations', 'precision'):
        assert solver[key] == chosen[key]


def test_a_finished_study_answers_other_questions(done, scene, capsys):
    _, folder = done
    words = ['accuracy', str(scene), '-o', str(folder), '--methods', 'line', '--jobs', '1']
    assert main([*words, '--max-error', '0.01', '--json', '-']) == 0
    numbers = json.loads(capsys.readouterr().out)
    chosen = numbers['recommended']
    good = [row for row in numbers['settings'] if row['error_m'] <= 0.01]
    assert chosen['ms_p50'] == min(row['ms_p50'] for row in good)
    assert main([*words, '--max-error', '1e-12']) == 1
    assert 'found      no setting meets this' in capsys.readouterr().out
    assert not (folder / 'settings.yaml').exists()
    assert main(words) == 0
    assert (folder / 'settings.yaml').exists()


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_keeps_what_is_done_and_leaves_no_process(number, scene, tmp_path):
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(
        [sys.executable, '-m', 'xpbd_ros', 'accuracy', scene, '-o', 'out', '--jobs', '2',
         '--duration', '20', '--methods', 'line'], cwd=tmp_path, env=environment,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    results = tmp_path / 'out' / 'results.jsonl'
    end = time.monotonic() + 300.0
    while not results.exists() or results.read_text().count('\n') < 3:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.05)
    process.send_signal(number)
    said, error = process.communicate(timeout=20)    # its processes hold stderr too
    assert (process.returncode, said) == (130, '')
    assert error == ('xpbd_ros accuracy: interrupted; continue with the same command and -o out\n')
    assert results.read_text().count('\n') >= 3
