"""``view``: a real browser looks at a running scene, and takes it in the hand."""

import importlib.util
import json
import re
import signal
import socket
import threading
import time

import numpy as np
import pytest

from support.browser import address, Browser, CHROMIUM, MISSING, start_view, viewed
from support.page import blue, CENTRE, drag, is_blue, pins, pixel, red, SHEET
from xpbd_ros.cli.main import main
from xpbd_ros.cli.ros import new_log
from xpbd_ros.log.reader import LogReader
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.sim.commands import Grasp, MovePin, Pose, SetKey
from xpbd_ros.view.controls import error_text
from xpbd_ros.view.live import LiveView
from xpbd_ros.view.server import close_server, open_server, url_of

pytestmark = pytest.mark.skipif(importlib.util.find_spec('viser') is None,
                                reason="viser is not installed: pip install 'xpbd_ros[view]'")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)


BUFFERS = 24 * 2**20
"""more than the buffers of a connection hold [bytes]"""
TABLE = """
cloths:
  sheet:
    grid: {size: [0.6, 0.6], resolution: [7, 7]}
    pose: {position: [0.0, -0.3, 1.302]}
    density: 0.2
    effects: {stretch: {warp: 300.0, weft: 300.0}}
colliders:
  table: {box: {size: [0.4, 0.8, 0.1]}, position: [0.1, 0.0, 1.25]}
effects: {contact: {thickness: 0.002}}
solver: {method: gauss_seidel, integrator: backward_euler, substeps: 8}
"""
"""a sheet half of which lies on a box; its middle is near that of ``support.page.SHEET``"""
ON_TABLE, BESIDE = (0.1, 0.0, 1.302), (0.5, 0.0, 1.302)
"""a point of either half [m]"""


@pytest.fixture(scope='module')
def scene(tmp_path_factory):
    """Return the file of a sheet that hangs from its upper corners."""
    file = tmp_path_factory.mktemp('scene') / 'sheet.yaml'
    file.write_text(SHEET)
    return file


@pytest.fixture
def page(browser):
    """Return the page, playing from the scene's start."""
    if 'Play' in browser.text().split('\n'):
        browser.press('Play')
    browser.press('Reset')
    browser.until(lambda: {name: place for name, (_, place) in pins(browser).items()} == {
        'left': (0.0, 0.0, 1.6), 'right': (0.6, 0.0, 1.6)}, 'the start')
    return browser


@pytest.fixture(scope='module')
def browser(scene):
    """Return a browser with the page of the running scene."""
    with viewed(scene) as browser:
        yield browser


def seconds(page) -> float:
    """Return the simulated time that the page shows [s]."""
    return next(float(line.split()[0]) for line in page.text().splitlines()
                if line.endswith(' particles') and ' s, ' in line)


def still(page) -> float:
    """Wait until the time that the page shows stands still, and return it [s]."""
    seen = [seconds(page)]

    def stands() -> bool:
        time.sleep(0.6)    # longer than the figures' period
        seen.append(seconds(page))
        return seen[-1] == seen[-2]
    page.until(stands, 'the pause')
    return seen[-1]


@needs_browser
def test_the_cloth_is_seen_and_nothing_else_is_blue(page):
    picture = page.picture()[:, :800]    # beside the panel
    x, y = map(int, pixel(page, CENTRE))
    assert 300 < x < 500
    assert is_blue(picture[y, x])
    assert 0.02 < blue(picture) < 0.6
    for corner in ((-20, 20), (-20, -20), (20, -20)):
        assert not is_blue(picture[corner])
    assert page.errors == []


@needs_browser
def test_the_buttons_pause_step_and_reset(page):
    page.press('Pause')
    before = still(page)
    page.press('Step')
    page.until(lambda: seconds(page) > before, 'a step')
    assert still(page) == pytest.approx(before + 1.0 / 60.0, abs=0.011)
    page.press('Play')
    page.until(lambda: seconds(page) > before + 0.5, 'play')
    assert page.errors == []


@needs_browser
def test_a_dragged_pin_takes_the_cloth_along(page):
    x, y = pixel(page, (0.03, 0.0, 1.53))
    below = int(y), int(x)
    page.until(lambda: is_blue(page.picture()[below]), 'the corner')
    drag(page, (0.0, 0.0, 1.63), (0.0, 0.0, 1.33))
    page.until(lambda: abs(pins(page)['left'][1][2] - 1.3) < 0.05, 'the pin')
    assert pins(page)['left'][1][:2] == (0.0, 0.0)
    assert pins(page)['right'][1] == (0.6, 0.0, 1.6)
    page.until(lambda: not is_blue(page.picture()[below]), 'the cloth')
    assert page.errors == []


@needs_browser
def test_a_click_grasps_the_cloth_and_another_releases_it(page):
    page.click(*pixel(page, (0.3, 0.0, 1.3)))
    page.until(lambda: len(pins(page)) == 3, 'the grasp')
    page.press('Release all')
    page.until(lambda: not pins(page), 'the release')
    assert page.errors == []


@needs_browser
def test_the_surface_is_coloured_by_strain_and_by_tension(page):
    def sheet() -> np.ndarray:
        return page.picture()[200:460, 500:710]
    page.until(lambda: seconds(page) > 0.5, 'strained edges')
    page.press('Pause')
    still(page)
    plain, gizmos = blue(sheet()), red(sheet())
    assert page.options('Colour') == ['none', 'strain', 'tension'], 'no contact'
    page.choose('Colour', 'strain')
    page.until(lambda: blue(sheet()) < 0.5 * plain, 'strains')
    page.choose('Colour', 'tension')
    page.until(lambda: red(sheet()) > gizmos + 0.005, 'red below the pins')
    page.choose('Colour', 'none')
    page.until(lambda: blue(sheet()) > 0.98 * plain, 'one colour')
    assert red(sheet()) == pytest.approx(gizmos, abs=0.0005)
    assert page.errors == []


@needs_browser
def test_the_error_of_a_frame_is_told_with_its_time(page):
    def error() -> str:
        return next(line for line in page.text().splitlines() if line.startswith('error of'))
    page.until(lambda: '(RMS)' in error(), 'an estimate')
    page.press('Pause')
    still(page)
    found = re.fullmatch(r'error of a frame: (\S+) m \(RMS\) at (\S+) s', error())
    assert float(found[1]) > 0.0
    assert 0.0 < float(found[2]) <= seconds(page)


def test_an_error_is_not_told_as_0_m():
    assert error_text(0.0, resolved=True, time_s=0.5) == 'none at 0.50 s, where nothing moved'
    assert error_text(3e-5, resolved=True, time_s=0.5) == '3e-05 m (RMS) at 0.50 s'
    assert error_text(3e-5, resolved=False, time_s=0.5) == 'under-resolved at 0.50 s'


@needs_browser
def test_contact_forces_colour_the_part_that_bears_them(tmp_path):
    """At first, half of the sheet lies on a table, and half beside it falls."""
    file = tmp_path / 'table.yaml'
    file.write_text(TABLE)
    compile_scene(load_scene(str(file))).compile()
    with viewed(file) as page:
        page.press('Pause')
        before = still(page)
        page.press('Reset')
        page.until(lambda: seconds(page) > before, 'its first frame')

        def halves() -> tuple[float, float]:
            """Return how much of the sheet is red on the table and beside it."""
            picture = page.picture()
            return tuple(red(picture[y - 6:y + 6, x - 6:x + 6]) for x, y in (
                map(int, pixel(page, place)) for place in (ON_TABLE, BESIDE)))
        page.until(lambda: blue(page.picture()) > 0.005, 'the sheet')
        assert halves() == (0.0, 0.0)
        page.choose('Colour', 'contact force')
        page.until(lambda: halves() == (1.0, 0.0), 'red on the table alone')
        assert page.errors == []


@needs_browser
def test_torques_are_arrows(tmp_path):
    """A pin holds three particles, and not at the middle of the sheet's weight."""
    file = tmp_path / 'torque.yaml'
    file.write_text(SHEET.replace('corner_10', '[42, 43, 47]').replace('density: 0.2',
                                                                      'density: 1.0').replace(
        '  right: {cloth: sheet, at: corner_11}\n', ''))
    with viewed(file) as page:
        x, y = map(int, pixel(page, (0.2, 0.25, 1.6)))    # 0.34 N m about +y at (0.2, 0, 1.6)

        def arrow() -> bool:
            """Return whether there is the colour of torques."""
            around = page.picture()[y - 5:y + 6, x - 5:x + 6]
            return bool((around[..., [0, 2]].min(axis=-1) > around[..., 1] + 0.15).any())
        page.until(arrow, 'an arrow of the torque')
        page.press('Release all')
        page.until(lambda: not arrow(), 'no arrow')
        assert page.errors == []


def test_a_viewed_run_has_the_bits_of_any_other(scene):
    process = start_view(scene, '--duration', '3', '--json', '-')
    out, err = process.communicate()
    assert process.returncode == 0, err
    found = json.loads(out)
    assert found['frames'] > 20
    assert hash_after(scene, found['frames']) == found['state_hash']


@pytest.mark.parametrize('duration', ['0', '-1', 'nan', 'inf'])
def test_a_duration_that_ends_before_it_begins_is_refused(duration, capsys):
    assert main(['view', 'towel', '--duration', duration, '--no-browser', '--port', '0']) == 2
    assert capsys.readouterr().err == (
        'xpbd_ros view: --duration: must be > 0 and at most 1e+06 s (got '
        f'{float(duration):g} s); leave it out to end on Ctrl-C\n')


def test_a_view_that_ends_before_its_first_frame_has_the_state_of_the_start(
        scene, monkeypatch, capsys):
    monkeypatch.setattr('xpbd_ros.cli.view.serve', lambda arguments, url, run: run(lambda: True))
    assert main(['view', str(scene), '--no-browser', '--port', '0', '--json', '-']) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found['frames'], found['state_hash']) == (0, hash_after(scene, 0))


@needs_browser
def test_a_browser_that_comes_and_goes_changes_no_bit(scene, tmp_path):
    process = start_view(scene, '--json', tmp_path / 'view.json')
    url = address(process)
    browser = Browser()
    try:
        browser.open(url)
        browser.until(lambda: 'real time' in browser.text(), 'the figures')
        browser.until(lambda: seconds(browser) > 1.0, 'a second')
    finally:
        browser.close()
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    process.communicate()
    found = json.loads((tmp_path / 'view.json').read_text())
    assert found['drawn'] > 0
    assert found['state_hash'] == hash_after(scene, found['frames'])


def hash_after(scene, frames: int) -> str:
    """Return the hash of the state after some frames without a page."""
    simulation = compile_scene(load_scene(str(scene)))
    for _ in range(frames):
        simulation.step()
    return f'{simulation.hash():016x}'


@needs_browser
def test_a_browser_that_reads_nothing_delays_no_frame(scene, monkeypatch):
    """A frozen browser's pictures would fill every buffer; they are dropped, and it runs on."""
    monkeypatch.setattr('xpbd_ros.view.live.DRAWN_PER_SECOND', 1000.0)
    ended, fine = threading.Event(), {'cloths.sheet.grid.resolution': [61, 61],
                                      'solver.substeps': 1, 'frame_rate': 240.0}
    server = open_server('127.0.0.1', 0)
    view = LiveView(server, str(scene), fine, [str(scene)], None)
    thread = threading.Thread(target=view.run, args=(ended.is_set,))
    thread.start()
    browser = Browser()
    try:
        browser.open(url_of(server))
        browser.until(lambda: view.drawn > 10, 'pictures')
        browser.freeze()
        goal = view.drawn + BUFFERS // (3 * 4 * 61 * 61)
        deadline = time.monotonic() + 120.0
        while view.drawn < goal:
            assert thread.is_alive()
            assert time.monotonic() < deadline, view.drawn
            time.sleep(0.05)
    finally:
        ended.set()
        thread.join()
        browser.close()
        close_server(server)
    simulation = compile_scene(load_scene(str(scene), fine))
    for _ in range(view.frames):
        simulation.step()
    assert simulation.hash() == view.simulation.hash()


def test_a_recorded_session_is_solved_again_bit_for_bit(scene, tmp_path, capsys):
    """All that a page does becomes commands: a drag, a grasp, a live key, a reset, a release."""
    ended = threading.Event()
    server = open_server('127.0.0.1', 0)
    view = LiveView(server, str(scene), {}, [str(scene)], lambda scene, simulation: new_log(
        tmp_path / 'run', scene, simulation, program='view'))
    thread = threading.Thread(target=view.run, args=(ended.is_set,))
    thread.start()
    deadline = time.monotonic() + 120.0

    def wait(frames):
        until = view.frames + frames
        while view.frames < until:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    try:
        wait(3)
        view.record(True)
        for act in (lambda: view.put(MovePin('left', Pose((0.1, 0.0, 1.5)))),
                    lambda: view.put(Grasp('click_0', Pose((0.3, 0.0, 1.3)), 0.15)),
                    lambda: view.put(SetKey('gravity', (0.0, 1.0, -9.0))),
                    view.reset, view.release_all):
            act()
            wait(4)
        hashed = view.simulation
    finally:
        ended.set()
        thread.join()
        close_server(server)
    assert hashed.index > 20
    assert main(['resim', str(tmp_path / 'run'), '--json', '-']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['identical']
    assert found['first_frame'] > 0
    kinds = {topic.rsplit('/', 1)[-1] for topic in LogReader(tmp_path / 'run').topics}
    assert {'pins', 'pin_targets', 'parameter_events', 'resets'} <= kinds


def test_mistakes_are_one_line(scene, capsys):
    with socket.socket() as taken:
        taken.bind(('127.0.0.1', 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(['view', str(scene), '--port', str(port), '--no-browser']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert f'--port {port} on 127.0.0.1: cannot be used' in said
    for words, text in ((['--port', '99999'], '--port: must be from 0 (any) to 65535 (got 99999)'),
                        (['--host', '192.0.2.1', '--port', '0'],
                         '--host 192.0.2.1: is no address of this machine')):
        assert main(['view', str(scene), *words, '--no-browser']) == 2
        said = capsys.readouterr().err
        assert said.count('\n') == 1
        assert text in said
    assert main(['view', 'no_such_scene', '--no-browser']) == 2
    assert 'no_such_scene: unknown scene (known: ' in capsys.readouterr().err


def test_a_scene_that_fails_is_one_line(tmp_path, capsys):
    scene = tmp_path / 'bad.yaml'
    scene.write_text(SHEET.replace('warp: 300.0', 'warp: -1.0'))
    assert main(['view', str(scene), '--no-browser']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert 'cloths.sheet.effects.stretch.warp: must be ' in said
