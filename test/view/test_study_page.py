"""``view`` of a study: the reference, the recommended and the cheapest setting side by side."""

import importlib.util
import json
import signal

import numpy as np
import pytest

from support.browser import address, Browser, CHROMIUM, MISSING, start_view
from support.logs import SHEET
from support.page import blue
from xpbd_ros.cli.main import main
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.study.accuracy.motion import report_of
from xpbd_ros.view.recorded import Track

pytestmark = pytest.mark.skipif(importlib.util.find_spec('viser') is None,
                                reason="viser is not installed: pip install 'xpbd_ros[view]'")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)


def row(substeps: int, ms: float, error: float, **changes) -> dict:
    """Return a row of a study."""
    return {'method': 'gauss_seidel', 'integrator': 'backward_euler', 'substeps': substeps,
            'iterations': 1, 'precision': 'float64', 'ms_p50': ms, 'error_m': error,
            'baseline': False, **changes}


@pytest.fixture(scope='module')
def study(tmp_path_factory):
    """Return the folder of a study of a sheet."""
    folder = tmp_path_factory.mktemp('study')
    (folder / 'scene.yaml').write_text(SHEET)
    rows = [row(2, 0.1, 0.01), row(8, 0.3, 0.003), row(32, 0.9, 0.001),
            row(1, 0.01, 0.5, baseline=True), row(1, None, None), row(1, 0.05, None)]
    (folder / 'accuracy.json').write_text(json.dumps({
        'settings': rows, 'recommended': rows[1], 'frames': 12, 'commands': None}))
    return folder


def test_the_settings_are_those_of_the_report(study):
    report = report_of(study)
    assert [name.split('\n')[0] for name, _ in report.settings] == [
        'reference', 'recommended', 'cheapest']
    assert [name.split('\n')[2:] for name, _ in report.settings[1:]] == [
        ['0.3 ms, 0.003 m'], ['0.1 ms, 0.01 m']]
    substeps = [scene.top.solver.substeps for _, scene in report.settings]
    assert substeps[1:] == [8, 2]
    assert substeps[0] > 32
    assert report.frames == 12
    assert report_of(study / 'accuracy.json') == report
    assert report_of(study / 'scene.yaml') is None
    assert report_of(study.parent) is None


def test_a_mix_is_shown_with_its_rough_frames(study, tmp_path):
    (tmp_path / 'scene.yaml').write_text(SHEET)
    numbers = json.loads((study / 'accuracy.json').read_text())
    mix = row(40, 0.2, 0.0005, method='explicit', integrator='leapfrog', rough_frames=30,
              rough_integrator='bdf2', rough_substeps=6)
    numbers['settings'].append(mix)
    (tmp_path / 'accuracy.json').write_text(json.dumps({**numbers, 'recommended': mix}))
    name, scene = report_of(tmp_path).settings[1]
    assert name.split('\n')[1] == 'explicit leapfrog 40×1 and line bdf2 6×1'
    solver = compile_scene(scene).solver
    assert (solver.rough_frames, solver.rough_integrator, solver.rough_substeps) == (30, 'bdf2', 6)


def test_a_setting_runs_as_in_the_study(study):
    """The distance from the reference falls from the cheapest to the recommended setting."""
    tracks = [Track.stepped(name, compile_scene(scene), {}, range(1, 13))
              for name, scene in report_of(study).settings]
    assert all(track.times == pytest.approx(np.arange(13) / 60.0, abs=1e-8) for track in tracks)
    reference, recommended, cheapest = (track.positions['sheet'] for track in tracks)
    far, near = (np.linalg.norm(x - reference, axis=2).max() for x in (cheapest, recommended))
    assert 0.0 < near < 0.7 * far
    assert tracks[0].pins[5][0].name == 'left'


@needs_browser
def test_three_settings_move_side_by_side(study):
    process = start_view(study)
    browser = Browser()
    try:
        browser.open(address(process))
        browser.until(lambda: ' of 12' in browser.text(), 'a frame')
        browser.until(lambda: ' mm at most: cheapest' in browser.text(), 'the distances')
        assert ' mm at most: recommended' in browser.text()
        assert 'distance to the reference [mm]' in browser.text()
        browser.press('Pause')
        browser.until(lambda: blue(browser.picture()) > 0.001, 'the reference')
        picture = browser.picture()[200:, :860]    # below a warning of the page, beside the panel
        grey = (np.ptp(picture, axis=2) < 0.06) & (picture.min(axis=2) > 0.6) & (
            picture.max(axis=2) < 0.9)
        columns = np.flatnonzero(grey.sum(axis=0) > 8)
        reference = np.flatnonzero((picture[..., 2] > picture[..., 0] + 0.15).sum(axis=0) > 8)
        assert (np.diff(columns) > 5).sum() >= 1, 'two cloths, apart'
        assert reference.max() < np.median(columns), 'right of the reference'
        assert browser.errors == []
    finally:
        browser.close()
        process.send_signal(signal.SIGINT)
        process.communicate()


def test_a_study_is_exported(study, tmp_path, capsys):
    page = tmp_path / 'study.html'
    assert main(['view', str(study), '--export', str(page), '--json', '-']) == 0
    assert json.loads(capsys.readouterr().out) == {
        'url': page.as_uri(), 'pictures': [], 'frames': 13}
    assert page.stat().st_size > 100_000


@pytest.mark.parametrize(('numbers', 'text'), [
    ('{', 'is no complete report of xpbd_ros accuracy'),
    ('{"settings": []}', "KeyError: 'recommended'"),
    ('{"settings": [], "recommended": null, "frames": 3, "commands": null}',
     'no setting has both an error and a time')])
def test_a_broken_report_is_one_line(numbers, text, tmp_path, capsys):
    (tmp_path / 'accuracy.json').write_text(numbers)
    assert main(['view', str(tmp_path), '--no-browser']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert text in said


def test_a_study_is_neither_drawn_nor_compared(study, capsys):
    assert main(['view', str(study), '--beside', 'log', '--no-browser']) == 2
    assert f'--beside: needs a scene or a log, and {study} is a study' in capsys.readouterr().err


def test_keys_of_a_study_are_not_changed(study, capsys):
    assert main(['view', str(study), '--set', 'nonsense.key=3', '--no-browser']) == 2
    assert f'--set: needs a scene, and {study} is a study\n' in capsys.readouterr().err
