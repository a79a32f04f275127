"""Energies and error estimates of a log, which ``view`` plots."""

import json

import numpy as np
import pytest

from support.logs import COMMANDS, recorded, SHEET
from xpbd_ros.cli.main import main
from xpbd_ros.export.states import States
from xpbd_ros.ros.logged_commands import Recording
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.sim.commands import ReleaseAll, Reset
from xpbd_ros.view.energy import energy_now
from xpbd_ros.view.recorded import changes, Track

FRAMES = 14
RESET = 12
"""a frame"""


@pytest.fixture(scope='module')
def scene(tmp_path_factory):
    """Return the file of a sheet one of whose corners is lifted."""
    file = tmp_path_factory.mktemp('scene') / 'sheet.yaml'
    file.write_text(SHEET)
    return file


def test_the_energy_of_a_log_is_that_of_its_run(scene, tmp_path):
    """With live keys that change on the way, and a reset."""
    commands = {**COMMANDS, RESET: [Reset()]}
    log = recorded(scene, tmp_path / 'log', commands, frames=FRAMES)
    simulation = compile_scene(load_scene(str(scene)))
    known = [energy_now(simulation)]
    for index in range(1, FRAMES + 1):
        simulation.step(commands.get(index, ()))
        known.append(energy_now(simulation))
    states, recording = States(str(log)), Recording(str(log))
    track = Track.read(states, states).with_energy(recording.scene, recording.commands,
                                                   range(FRAMES + 1))
    for part, accuracy in (('potential', 1e-6), ('elastic', 1e-2)):
        expected = np.array([each[part] for each in known])
        assert np.ptp(expected) > 0.0
        assert track.energy[part] == pytest.approx(expected, rel=accuracy, abs=1e-6), part
    assert np.isfinite(track.energy['kinetic']).all()
    assert track.energy['kinetic'].max() < 2.0 * max(each['kinetic'] for each in known), (
        'a reset is no motion')
    assert track.total_energy() == pytest.approx(sum(track.energy.values()))


def test_energy_is_constant_in_free_fall(scene, tmp_path):
    """Central differences of a parabola are its velocities at all frames but the ends."""
    log = recorded(scene, tmp_path / 'log', {1: [ReleaseAll()]}, frames=FRAMES)
    states, recording = States(str(log)), Recording(str(log))
    track = Track.read(states, states).with_energy(recording.scene, recording.commands,
                                                   range(FRAMES + 1))
    total, fallen = track.total_energy()[1:-1], -np.diff(track.energy['potential']).sum()
    assert fallen > 0.005
    assert total == pytest.approx(np.full(FRAMES - 1, total.mean()), abs=1e-4 * fallen)


def test_a_frame_between_two_resets_has_no_known_velocity(scene, tmp_path):
    log = recorded(scene, tmp_path / 'log', {3: [Reset()], 4: [Reset()]}, frames=6)
    states, recording = States(str(log)), Recording(str(log))
    track = Track.read(states, states).with_energy(recording.scene, recording.commands, range(7))
    assert np.flatnonzero(np.isnan(track.energy['kinetic'])).tolist() == [3]
    assert changes(np.array([np.nan, 2.0, 3.0]))[1:].tolist() == [0.0, 1.0]


def test_a_log_has_the_error_estimates_of_its_run(scene, tmp_path, capsys):
    log = tmp_path / 'log'
    assert main(['run', str(scene), '-o', str(log), '--duration', '0.8', '--json', '-']) == 0
    told = json.loads(capsys.readouterr().out)['error']
    states = States(str(log))
    errors = states.errors()
    assert list(errors) == [10]
    assert told['estimates'] == 1
    assert errors[10] == told['frame_rms_m'] > 0.0
    shown = Track.read(states, states).latest_errors()
    assert np.isnan(shown[:10]).all()
    assert (shown[10:] == errors[10]).all()
