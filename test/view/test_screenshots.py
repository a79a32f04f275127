"""``view --screenshot``: a picture of a scene or a log at a time, without a browser."""

import json

from matplotlib.image import imread
import numpy as np
import pytest

from support.logs import recorded, SHEET
from support.page import blue
from xpbd_ros.cli.main import main


@pytest.fixture(scope='module')
def scene(tmp_path_factory):
    """Return the file of a sheet one of whose corners is lifted."""
    file = tmp_path_factory.mktemp('scene') / 'sheet.yaml'
    file.write_text(SHEET)
    return file


def test_scene_and_log_have_the_same_picture(pyvista, scene, tmp_path, capsys):
    log, pictures = recorded(scene, tmp_path / 'log', {}, frames=12), []
    for name, shown in (('scene', scene), ('log', log)):
        file = tmp_path / f'{name}.png'
        assert main(['view', str(shown), '--screenshot', str(file), '--at', '0.1', '--json',
                     '-']) == 0
        found = json.loads(capsys.readouterr().out)
        assert found['pictures'] == [str(file)]
        assert found['frames'] == 6
        pictures.append(imread(file)[..., :3])
    assert 0.02 < blue(pictures[0]) < 0.8
    assert np.abs(pictures[0] - pictures[1]).max() < 0.1
    assert main(['view', str(log), '--screenshot', str(tmp_path / 'end.png')]) == 0
    end = imread(tmp_path / 'end.png')[..., :3]
    assert end.shape != pictures[0].shape or np.abs(end - pictures[0]).max() > 0.3


@pytest.mark.parametrize(('words', 'text'), [
    (['--at', '1'], '--at: is the time of a --screenshot'),
    (['--screenshot', 'nowhere/a.png'], 'there is no folder'),
    (['--screenshot', 'a.png', '--at', '-1'], '--at: must be from 0 to 1e+06 s (got -1 s)')])
def test_mistakes_are_one_line(pyvista, scene, words, text, capsys):
    assert main(['view', str(scene), *words]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert text in said


def test_a_time_beyond_the_log_is_one_line(pyvista, scene, tmp_path, capsys):
    log = recorded(scene, tmp_path / 'log', {}, frames=6)
    assert main(['view', str(log), '--screenshot', str(tmp_path / 'a.png'), '--at', '3']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert 'lasts from 0 to 0.1 s (got 3 s)' in said
    assert not (tmp_path / 'a.png').exists()
