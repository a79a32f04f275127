"""Where a verb writes its numbers."""

import json
import math
from pathlib import Path
import resource

import numpy as np
import pytest

from xpbd_ros.cli.main import main
from xpbd_ros.cli.output import check_outputs, new_folder, write_json, write_text
from xpbd_ros.errors import InputError
from xpbd_ros.log.folder import folder_of, fresh_folder


def test_numpy_values_paths_and_non_finite_numbers_are_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_json('out.json', {'path': tmp_path / 'a', 'none': math.nan, 'big': [math.inf, 1.5],
                            'array': np.arange(3), 'count': np.int64(4), 'pair': (1, True)})
    assert json.loads((tmp_path / 'out.json').read_text()) == {
        'path': str(tmp_path / 'a'), 'none': None, 'big': [None, 1.5], 'array': [0, 1, 2],
        'count': 4, 'pair': [1, True]}


def test_nothing_is_written_where_nothing_was_asked_for(capsys):
    write_json(None, {})
    assert capsys.readouterr().out == ''


def test_a_new_folder_is_removed_if_the_work_fails(tmp_path):
    with new_folder(None) as folder:
        assert folder is None
    with new_folder(str(tmp_path / 'a' / 'b')) as folder:
        assert folder == tmp_path / 'a' / 'b'
        assert folder.is_dir()
    with pytest.raises(InputError, match='b: exists already'), new_folder(folder):
        pass
    with pytest.raises(InputError, match='unknown'), new_folder(tmp_path / 'c'):
        raise InputError('unknown')
    assert not (tmp_path / 'c').exists()
    (tmp_path / 'file').touch()
    with pytest.raises(InputError, match=r'd: cannot be created \(Not a directory\)'), new_folder(
            tmp_path / 'file' / 'd'):
        pass


def test_a_full_disk_is_told_with_the_file(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(InputError) as error:
            write_text(tmp_path / 'page.html', 'x' * 2000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert str(error.value) == f"{tmp_path / 'page.html'}: cannot be written: File too large"


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r'none/out.json: cannot be written: No such file'):
        write_json(str(tmp_path / 'none' / 'out.json'), {})


@pytest.mark.parametrize(('files', 'folder', 'clash'), [
    (('x', None), './x', 'x'), (('a', 'sub/../a'), None, 'sub/../a'), (('x',), 'x/log', 'x')])
def test_outputs_of_one_name_are_refused_before_the_work(files, folder, clash, tmp_path,
                                                         monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'sub').mkdir()
    with pytest.raises(InputError, match=f'^{clash}: is the name of two outputs; name another'):
        check_outputs(*files, folder=folder)
    check_outputs('-', '-', None, 'b', folder='x')
    with pytest.raises(InputError, match=r"an output needs a name \(got ''\)"):
        check_outputs('')


def test_run_finds_that_its_outputs_clash_before_it_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(['run', 'swing', '-o', 'x', '--json', 'x']) == 2
    assert capsys.readouterr().err == (
        'xpbd_ros run: x: is the name of two outputs; name another for one\n')
    assert not list(tmp_path.iterdir())


def test_a_fresh_folder_is_not_there_yet(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = fresh_folder('run')
    assert one.parent == tmp_path
    assert one.name.startswith('xpbd_ros_run_2')
    one.mkdir()
    assert fresh_folder('run') != one


def test_a_folder_may_be_in_the_home_folder(monkeypatch):
    """A shell expands no ~ in ``-p record.path:=~/run``; a folder named ~ invites ``rm -r ~``."""
    monkeypatch.setenv('HOME', '/home/hand')
    assert folder_of('~/run') == Path('/home/hand/run')
    assert folder_of('run') == Path('run')
    assert folder_of('') is None
