"""The demo from end to end: three processes, DDS between them, a log, checks and a picture."""

import json
import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

from xpbd_ros.cli.main import main
from xpbd_ros.demo import report
from xpbd_ros.demo.domain import DOMAINS, free_domain, private_environment
from xpbd_ros.demo.robot import PHASES, Robot, smooth
from xpbd_ros.log.reader import LogReader


@pytest.fixture(scope='module')
def demo(tmp_path_factory, own_domain):
    """Return what ``demo`` printed as JSON, and its folder."""
    folder = tmp_path_factory.mktemp('demo') / 'out'
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, '-m', 'xpbd_ros', 'demo', '--duration', '6', '--output', folder,
         '--json', '-'], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), folder, done.stderr


def test_every_check_passes(demo):
    numbers = demo[0]
    assert [check['name'] for check in numbers['checks'] if not check['pass']] == []
    assert len(numbers['checks']) >= 9
    for check in numbers['checks']:
        assert set(check) == {'name', 'pass', 'value', 'expected'}


def test_it_says_what_it_promises_to(demo):
    numbers, folder, said = demo
    assert {'frames', 'real_time_factor', 'step_ms', 'pins', 'checks', 'run', 'pictures'} <= set(
        numbers)
    assert numbers['frames'] > 5 * 60
    assert 0.0 < numbers['step_ms']['p50'] <= numbers['step_ms']['p95'] <= numbers['step_ms'][
        'max']
    assert set(numbers['pins']) == {'left', 'right'}
    for pin in numbers['pins'].values():
        assert pin['force_n'] == pytest.approx(pin['expected_n'], rel=0.1)
    assert numbers['run'] == str(folder / 'run')
    for phase in (*PHASES, 'end'):
        assert f'  robot: {phase}\n' in said
    assert f"log      {folder / 'run'}\n" in said


def test_it_leaves_a_picture(demo, pyvista):
    numbers, folder, _ = demo
    (picture,) = map(Path, numbers['pictures'])
    assert picture.parent == folder
    assert picture.read_bytes().startswith(b'\x89PNG')
    assert picture.stat().st_size > 50_000
    assert numbers['notes'] == []


def test_without_pyvista_it_checks_and_says_how_to_get_a_picture(demo, monkeypatch):
    monkeypatch.setattr('xpbd_ros.study.picture.offscreen.find_spec', lambda name: None)
    numbers = report.make(demo[1], 'demo')
    assert all(check['pass'] for check in numbers['checks'])
    assert numbers['pictures'] == []
    assert report.table(numbers).splitlines()[-1] == (
        "note     the picture needs PyVista: pip install 'xpbd_ros[view]'")


def test_it_leaves_a_log(demo):
    numbers, folder, _ = demo
    reader = LogReader(folder / 'run')
    assert reader.whole, reader.damage
    assert {'/cloth/pins', '/cloth/pin_targets', '/cloth/collider_states',
            '/cloth/particles'} <= set(reader.topics), "the robot's commands are in it"
    assert reader.topics['/cloth/particles'].count >= numbers['frames']
    assert 'Traceback' not in (folder / 'node.log').read_text()


def test_an_output_that_exists_is_refused(tmp_path, capsys):
    assert main(['demo', '--output', str(tmp_path)]) == 2
    assert capsys.readouterr() == (
        '', f'xpbd_ros demo: {tmp_path}: exists already; name another, or move it away\n')
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('duration', ['0', '-1', '4.9', '1e9', 'nan', 'inf'])
def test_a_duration_that_makes_no_story_is_refused(duration, tmp_path, capsys):
    assert main(['demo', '--output', str(tmp_path / 'new'), '--duration', duration]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.startswith('xpbd_ros demo: --duration: must be from 5 to 600 s (got ')
    assert list(tmp_path.iterdir()) == []


def test_it_speaks_among_its_own_only(monkeypatch):
    """On loopback and a free domain, whatever the robots around use."""
    monkeypatch.setenv('ROS_DOMAIN_ID', '0')
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    monkeypatch.setenv('ROS_STATIC_PEERS', '10.0.0.1')
    monkeypatch.setenv('ROS_NAMESPACE', '/robot')
    environment = private_environment()
    assert int(environment['ROS_DOMAIN_ID']) in DOMAINS
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SYSTEM_DEFAULT'    # see loopback.xml
    assert Path(environment['FASTRTPS_DEFAULT_PROFILES_FILE']).is_file()
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_cyclonedds_cpp')
    assert private_environment()['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert not {'ROS_STATIC_PEERS', 'ROS_NAMESPACE'} & set(environment)
    assert free_domain() in DOMAINS


def test_the_story_has_all_its_phases_in_order():
    assert sum(PHASES.values()) == pytest.approx(1.0)
    seen = [Robot.where(share)[0] for share in np.linspace(0.0, 1.01, 500)]
    assert list(dict.fromkeys(seen)) == [*PHASES, 'end']
    phase, passed = None, []
    while phase != 'end':
        phase = Robot.after(phase)
        passed.append(phase)
    assert passed == [*PHASES, 'end'], 'none is left out, however few clouds come through'
    steps = [smooth(s) for s in np.linspace(-0.5, 1.5, 100)]
    assert (steps[0], steps[-1]) == (0.0, 1.0)
    assert np.diff(steps).min() >= 0.0
