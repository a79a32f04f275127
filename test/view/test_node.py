"""``view --node``: a page in one process, the node in another, and only DDS between them."""

from collections.abc import Iterator
import importlib.util
import json
import time

from matplotlib.image import imread
import numpy as np
import pytest
from rclpy.node import Node

from support.browser import Browser, CHROMIUM, MISSING, viewed
from support.node import Cloth, NodeProcess, Peer
from support.page import blue, drag, pins, SHEET
from xpbd_ros.cli.main import main
from xpbd_ros.ros import cloth_client

pytestmark = pytest.mark.skipif(importlib.util.find_spec('viser') is None,
                                reason="viser is not installed: pip install 'xpbd_ros[view]'")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)


@pytest.fixture(scope='module')
def cloth(tmp_path_factory, context) -> Iterator[Cloth]:
    """Return a node that steps the sheet in real time."""
    folder = tmp_path_factory.mktemp('node')
    scene = folder / 'sheet.yaml'
    scene.write_text(SHEET)
    peer, node = Peer(context), NodeProcess(folder, parameters={'scene': scene})
    cloth = Cloth(peer, node)
    node.wait_for('running, mode realtime')
    yield cloth
    peer.close()
    assert node.end() == 0


@pytest.fixture(scope='module')
def page(cloth) -> Iterator[Browser]:
    """Return a browser with the page of the node."""
    with viewed('--node', '/cloth') as browser:
        yield browser


def cloud_with(cloth, particle: int, place) -> np.ndarray:
    """Wait for a cloud that has a particle at a place [m]; return it, shape (particles, 3)."""
    def found() -> bool:
        del cloth.clouds[:-1]
        return bool(cloth.clouds) and np.abs(points(cloth)[particle] - place).max() < 0.01
    cloth.peer.until(found, f'particle {particle} at {place}')
    return points(cloth)


def points(cloth) -> np.ndarray:
    """Return the positions in the latest cloud [m], shape (particles, 3)."""
    return np.frombuffer(cloth.clouds[-1].data, np.float32).reshape(-1, 3)


@needs_browser
def test_a_drag_in_the_browser_moves_the_cloth_of_the_node(cloth, page):
    page.until(lambda: set(pins(page)) == {'left', 'right'}, 'the pins')
    left, right = 42, 48    # the corners of the last row
    before = cloud_with(cloth, left, (0.0, 0.0, 1.6))
    drag(page, (0.0, 0.0, 1.63), (0.0, 0.0, 1.33))
    page.until(lambda: abs(pins(page)['left'][1][2] - 1.3) < 0.05, 'the pin')
    time.sleep(0.5)    # the figures are a quarter of a second old
    after = cloud_with(cloth, left, pins(page)['left'][1])
    assert after[right] == pytest.approx([0.6, 0.0, 1.6], abs=1e-6)
    free = np.setdiff1d(np.arange(49), (left, right))
    assert (after[free, 2] - before[free, 2]).min() < -0.1
    assert page.errors == []


@needs_browser
def test_the_buttons_are_services_of_the_node(cloth, page):
    page.press('Pause')
    page.until(lambda: 'Play' in page.text().split('\n'), 'the pause')
    frame = int(cloth.status(lambda status: status['message'] == 'waiting')['frame'])
    page.press('Step')
    cloth.status(lambda status: int(status['frame']) == frame + 1)
    page.press('Play')
    cloth.status(lambda status: int(status['frame']) > frame + 10)
    page.press('Reset')
    page.until(lambda: pins(page).get('left', (0, None))[1] == (0.0, 0.0, 1.6), 'the start')
    page.press('Release all')
    page.until(lambda: not pins(page), 'the release')
    page.press('Reset')
    page.until(lambda: set(pins(page)) == {'left', 'right'}, 'the pins')
    assert page.errors == []


@needs_browser
def test_live_keys_are_parameters_of_the_node(cloth, page):
    page.unfold('Live keys')
    page.until(lambda: page.value(box('solver.substeps')) == '8', 'the present value')
    assert cloth.set(solver__substeps=12) == (True, '')
    page.until(lambda: page.value(box('solver.substeps')) == '12', 'the new value')
    page.type_into('solver.substeps', '10')
    page.until(lambda: cloth.get('solver.substeps') == [10], 'the parameter')
    assert page.errors == []


def test_a_screenshot_of_a_node_is_its_present_state(pyvista, cloth, tmp_path, capsys):
    def shot(name: str) -> np.ndarray:
        file = tmp_path / name
        assert main(['view', '--node', '/cloth', '--screenshot', str(file), '--json', '-']) == 0
        assert json.loads(capsys.readouterr().out)['pictures'] == [str(file)]
        return imread(file)[..., :3]
    cloth.trigger('reset')
    cloth.trigger('play')
    hanging = shot('hanging.png')
    assert 0.02 < blue(hanging) < 0.8
    cloth.trigger('release_all')
    cloth.peer.until(lambda: bool(cloth.clouds) and points(cloth)[:, 2].max() < 0.5, 'the fall')
    cloth.trigger('pause')
    assert main(['view', '--node', '/cloth', '--screenshot', str(tmp_path / 'none.png')]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert '--node /cloth: publishes no frame; if it is paused' in said
    assert not (tmp_path / 'none.png').exists()
    cloth.trigger('reset')
    cloth.trigger('play')


def box(label: str) -> str:
    """Return a JavaScript expression for the value of the input box with a label."""
    return f'({Browser.box(label)} || {{}}).value'


def test_a_node_that_is_not_there_is_one_line(cloth, context, capsys, monkeypatch):
    monkeypatch.setattr(cloth_client, 'PATIENCE', 3.0)
    assert main(['view', '--node', '/nowhere', '--no-browser']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert '--node /nowhere: no such node in ROS domain ' in said
    assert '/cloth' in said
    assert 'start it with xpbd_ros node' in said
    stranger = Node('stranger', context=context)
    try:
        assert main(['view', '--node', 'stranger', '--no-browser']) == 2
    finally:
        stranger.destroy_node()
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert ('--node /stranger: is there, and publishes no scene; a cloth_node does once it has '
            'compiled it, ') in said


@pytest.mark.parametrize(('words', 'text'), [
    (['--node', 'a b'], '--node a b: is no name of a node'),
    (['towel', '--node', '/cloth'], 'name one of a scene, a log, a study or --node'),
    ([], 'name one of a scene, a log, a study or --node'),
    (['--node', '/cloth', '--export', 'page.html'], '--export: needs a log, and --node'),
    (['--node', '/cloth', '--every', '2'], '--every: needs a log, and --node'),
    (['towel', '--every', '2'], '--every: needs a log, and towel is a scene'),
    (['--node', '/cloth', '--screenshot', 'a.png', '--at', '1'], '--at: needs a scene or a log'),
    (['--node', '/cloth', '--set', 'gravity=0'], '--set: needs a scene or a log, and --node')])
def test_mistakes_are_one_line(words, text, capsys):
    assert main(['view', *words, '--no-browser']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert text in said
