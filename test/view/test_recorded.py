"""``view`` of a log: its frames, a second log beside it, a page that plays without a server."""

import importlib.util
import json
import signal
import time

from matplotlib.colors import to_rgb
import numpy as np
import pytest

from support.browser import address, Browser, CHROMIUM, MISSING, start_view
from support.logs import recorded, SHEET
from support.page import blue
from xpbd_ros.cli.main import main
from xpbd_ros.export.states import States
from xpbd_ros.view.recorded import LINES, Track

pytestmark = pytest.mark.skipif(importlib.util.find_spec('viser') is None,
                                reason="viser is not installed: pip install 'xpbd_ros[view]'")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)

CANVASES = '[...document.querySelectorAll(".uplot canvas")]'
"""plots of the page, in JavaScript"""
PIXELS = """(canvas, colour) => {
    const {width, height} = canvas;
    const bytes = canvas.getContext("2d").getImageData(0, 0, width, height).data;
    let count = 0;
    for (let i = 0; i < bytes.length; i += 4) {
        count += colour.every((part, k) => bytes[i + k] === Math.round(255 * part));
    }
    return count;
}"""
"""JavaScript function: how many pixels of a plot have a colour"""


@pytest.fixture(scope='module')
def logs(tmp_path_factory):
    """Return two logs of the same cloth, with different substeps."""
    folder, found = tmp_path_factory.mktemp('logs'), []
    for substeps in (8, 4):
        scene = folder / f'{substeps}.yaml'
        scene.write_text(SHEET.replace('substeps: 8', f'substeps: {substeps}'))
        found.append(recorded(scene, folder / f'log_{substeps}', {}, frames=20))
    return found


def test_a_track_holds_the_frames_of_the_log(logs):
    states = States(str(logs[0]), every=5)
    track = Track.read(states, states)
    assert track.times == pytest.approx(np.arange(0, 21, 5) / 60.0, abs=1e-8)
    for k, state in enumerate(states):
        assert np.array_equal(track.frame(k)[0], state.positions['sheet'])
    assert [body.name for body in track.pins[2]] == ['left']
    sheet, = track.sheets()
    assert len(sheet.edges) == 6 * 5 + 7 * 4
    assert sheet.rest_length.min() == pytest.approx(0.05, rel=1e-6)


@needs_browser
def test_two_logs_beside_each_other(logs):
    process = start_view(logs[0], '--beside', logs[1])
    browser = Browser()
    try:
        browser.open(address(process))
        browser.until(lambda: 'distance to the first [mm]' in browser.text(), 'the panel')
        browser.until(lambda: ' of 20' in browser.text(), 'a frame')

        def more(one: int, other: int) -> float:
            """Return the share of the picture that is more of one colour than of another."""
            picture = browser.picture()[200:, :800]    # below a warning of the page
            return (picture[..., one] > picture[..., other] + 0.15).mean()
        browser.until(lambda: more(2, 0) > 0.001, 'the first log, which is blue')
        browser.until(lambda: more(0, 2) > 0.0002, 'the second one, red where it is far away')
        assert any(line.startswith('distance ') and line.endswith(' mm at most: run 2')
                   for line in browser.text().split('\n'))
        browser.press('Pause')
        browser.until(lambda: 'Play' in browser.text().split('\n'), 'the pause')
        assert browser.errors == []
    finally:
        browser.close()
        process.send_signal(signal.SIGINT)
        process.communicate()


@needs_browser
def test_forces_energy_strain_and_error_are_plotted(logs, tmp_path):
    scene = tmp_path / 'scene.yaml'
    scene.write_text(SHEET)
    assert main(['run', str(scene), '-o', str(tmp_path / 'log'), '--duration', '0.8', '--json',
                 str(tmp_path / 'run.json')]) == 0
    process = start_view(tmp_path / 'log')
    browser = Browser()
    try:
        browser.open(address(process))
        for title in ('force of the cloth', 'energy: kinetic + potential + elastic, change',
                      'largest strain [%]', 'estimated error of a frame, RMS [mm]'):
            browser.until(lambda title=title: title in browser.text(), title)
        browser.until(lambda: browser.value(f'{CANVASES}.length') == 4, 'four plots')
        def lines(k: int) -> int:
            """Return how many lines a plot has."""
            return sum(browser.value(f'({PIXELS})({CANVASES}[{k}], {list(to_rgb(colour))})') > 10
                       for colour in LINES)
        for k, count in enumerate((1, 4, 1, 1)):
            browser.until(lambda k=k, count=count: lines(k) == count, f'the lines of plot {k}')
        assert browser.errors == []
    finally:
        browser.close()
        process.send_signal(signal.SIGINT)
        process.communicate()


@needs_browser
def test_an_exported_page_plays_without_a_server(logs, tmp_path, capsys):
    page = tmp_path / 'page.html'
    assert main(['view', str(logs[0]), '--export', str(page), '--json', '-']) == 0
    assert json.loads(capsys.readouterr().out)['url'] == page.as_uri()
    browser = Browser()
    try:
        browser.open(page.as_uri())

        browser.until(lambda: blue(browser.picture()) > 0.005, 'the cloth')
        seen, end = 0, time.monotonic() + 60.0
        while seen < 5:    # all the while, the whole cloth is in the middle of the page
            assert time.monotonic() < end
            picture = browser.picture()
            seen += blue(picture) > 0.005    # it fades where the player begins again
            for border in (picture[:60], picture[-100:-60], picture[:-60, :150],
                           picture[:-60, -150:]):    # above the player's bar
                assert blue(border) == 0.0
        assert browser.errors == []
    finally:
        browser.close()


@pytest.mark.parametrize(('words', 'text'), [
    (['--every', '0'], '--every: must be at least 1 (got 0)'),
    (['--set', 'nonsense.key=3'], '--set: needs a scene, and '),
    (['--beside', 'nowhere'], 'nowhere: no such file or folder')])
def test_mistakes_are_one_line(logs, words, text, capsys):
    assert main(['view', str(logs[0]), '--no-browser', *words]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert text in said


def test_a_scene_is_neither_exported_nor_compared(capsys):
    assert main(['view', 'towel', '--export', 'page.html']) == 2
    assert '--export: needs a log, and towel is a scene' in capsys.readouterr().err


def test_a_cut_log_is_shown_as_far_as_it_goes(logs, tmp_path, capsys):
    file, = logs[0].glob('*.mcap')
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(file.read_bytes()[:-2000])
    page = tmp_path / 'page.html'
    assert main(['view', str(cut), '--export', str(page), '--json', '-']) == 0
    out, said = capsys.readouterr()
    assert 1 < json.loads(out)['frames'] <= 21
    lines = said.splitlines()
    assert lines
    assert all(line.startswith('xpbd_ros view: damaged log: ') for line in lines)
    cut.write_bytes(file.read_bytes()[:200])
    assert main(['view', str(cut), '--no-browser']) == 2
    *damage, reason = capsys.readouterr().err.splitlines()
    assert damage
    assert all(line.startswith('xpbd_ros view: damaged log: ') for line in damage)
    assert reason.startswith(f'xpbd_ros view: {cut}: holds no ~/particles in its readable part')
    cut.write_bytes(b'no log')
    assert main(['view', str(cut), '--no-browser']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert str(cut) in said
