"""The program as a whole: its verbs, help, exit codes, and what it says where ROS is missing."""

import importlib
import os
from pathlib import Path
import re
import subprocess
import sys

import numpy as np
import pytest

from support.logs import recorded, SHEET
import xpbd_ros
from xpbd_ros.cli.main import main, VERBS
from xpbd_ros.errors import InputError

HIDE = """
import sys
from importlib.machinery import PathFinder

found = PathFinder.find_spec

def find_spec(name, path=None, target=None):
    return None if name.split('.')[0] in {'rclpy', 'sensor_msgs'} else found(name, path, target)

PathFinder.find_spec = staticmethod(find_spec)
"""
"""for sitecustomize: the interpreter looks like one without ROS"""


def program(*words, path=(), **options) -> subprocess.CompletedProcess:
    """Run ``python -m xpbd_ros`` in a process of its own."""
    environment = {**os.environ,
                   'PYTHONPATH': os.pathsep.join(map(str, [*path, *filter(None, sys.path)]))}
    return subprocess.run([sys.executable, '-m', 'xpbd_ros', *map(str, words)], text=True,
                          capture_output=True, check=False, env=environment, **options)


def test_without_a_verb_it_shows_what_there_is(tmp_path):
    done = program(cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ''
    assert 'xpbd_ros: error: the following arguments are required: VERB' in done.stderr
    assert 'Traceback' not in done.stderr
    done = program('--help', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    for verb, what in VERBS.items():
        assert f'  {verb:<9} {what}' in done.stdout


def test_a_terminal_without_special_characters_gets_question_marks(monkeypatch, tmp_path):
    monkeypatch.setenv('PYTHONIOENCODING', 'ascii')
    (tmp_path / 'dot.yaml').write_text('cloths: {dot: {grid: {size: [1, 1], resolution: [1, 1]}, '
                                       'density: 1}}\n')
    done = program('check', tmp_path / 'dot.yaml', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, '')    # it falls for ever
    assert ' 4 ? 1 (auto: ' in done.stdout


def test_it_knows_its_version(capsys):
    with pytest.raises(SystemExit) as end:
        main(['--version'])
    assert end.value.code == 0
    assert capsys.readouterr().out == f'xpbd_ros {xpbd_ros.__version__}\n'


def test_linear_algebra_waits_for_no_second_core_unless_asked():
    """What it reads is set before it is there; 'check drape' takes 20 times as long else."""
    code = ('import os, sys\nimport xpbd_ros.cli.main as program\n'
            "assert 'numpy' not in sys.modules\n"
            'try:\n    program.main(sys.argv[1:])\n'
            "finally:\n    print(os.environ['OPENBLAS_NUM_THREADS'])")
    path = os.pathsep.join(filter(None, sys.path))
    for threads, given in (('1', {}), ('3', {'OPENBLAS_NUM_THREADS': '3'})):
        environment = {**os.environ, 'PYTHONPATH': path}
        environment.pop('OPENBLAS_NUM_THREADS', None)
        done = subprocess.run(
            [sys.executable, '-c', code, 'check', '-h'], capture_output=True, text=True,
            check=False, env={**environment, **given})
        assert (done.returncode, done.stderr) == (0, '')
        assert done.stdout.splitlines()[-1] == threads


def test_an_unknown_verb_is_refused(capsys):
    for word, said in (('rnu', "rnu: unknown verb; did you mean 'run'? (known: demo, node, "),
                       ('simulate', 'simulate: unknown verb (known: demo, node, ')):
        with pytest.raises(SystemExit) as end:
            main([word])
        assert end.value.code == 2
        assert f'xpbd_ros: error: {said}' in capsys.readouterr().err


@pytest.mark.parametrize('verb', VERBS)
def test_every_verb_explains_itself_with_an_example(verb, capsys):
    with pytest.raises(SystemExit) as end:
        main([verb, '--help'])
    assert end.value.code == 0
    said = capsys.readouterr().out
    module = importlib.import_module(f'xpbd_ros.cli.{verb}')
    assert said.startswith(f'usage: xpbd_ros {verb} ')
    assert f'example:\n  {module.EXAMPLE}' in said
    assert module.EXAMPLE.startswith(f'xpbd_ros {verb} ')
    assert module.__doc__.strip().splitlines()[0] in said
    options = re.findall(r'^  (--(?:set|vary|beside)) (.*(?:\n {10}.*)*)', said, re.M)
    for option, about in options:    # those that gather
        assert 'may be given several times' in ' '.join(about.split()), option


def test_a_mistake_of_the_user_is_one_line(monkeypatch, capsys):
    module = importlib.import_module('xpbd_ros.cli.run')

    def run(arguments):
        raise InputError('here: what is wrong')
    monkeypatch.setattr(module, 'run', run)
    assert main(['run', 'towel']) == 2
    assert capsys.readouterr() == ('', 'xpbd_ros run: here: what is wrong\n')


def test_too_little_memory_is_one_line(monkeypatch, capsys):
    module = importlib.import_module('xpbd_ros.cli.run')

    def run(arguments):
        np.empty((1 << 48,))
    monkeypatch.setattr(module, 'run', run)
    assert main(['run', 'towel']) == 2
    out, err = capsys.readouterr()
    assert (out, err.count('\n')) == ('', 1)
    assert err.startswith('xpbd_ros run: not enough memory (Unable to allocate 2.00 PiB')
    assert err.endswith('use fewer particles\n')


@pytest.mark.parametrize('error, said', [
    (OSError(28, 'No space left on device'), 'No space left on device'),
    (OSError(28, 'No space left on device', '/a\nb'), '/a\\nb: No space left on device'),
    (TimeoutError('too late'), 'too late')])
def test_an_error_of_the_system_is_one_line(error, said, monkeypatch, capsys):
    """The OSError of a failed write has no file name; the message has none either."""
    module = importlib.import_module('xpbd_ros.cli.run')

    def run(arguments):
        raise error
    monkeypatch.setattr(module, 'run', run)
    assert main(['run', 'towel']) == 2
    assert capsys.readouterr() == ('', f'xpbd_ros run: {said}\n')


def test_an_interrupt_is_one_line(monkeypatch, capsys):
    module = importlib.import_module('xpbd_ros.cli.run')

    def run(arguments):
        raise KeyboardInterrupt
    monkeypatch.setattr(module, 'run', run)
    assert main(['run', 'towel']) == 130
    assert capsys.readouterr() == ('', 'xpbd_ros run: interrupted\n')


def test_an_interrupt_is_one_line_from_the_start(monkeypatch, capsys):
    """The modules of a verb load for some 0.3 s."""
    def load(name):
        raise KeyboardInterrupt
    monkeypatch.setattr(importlib, 'import_module', load)
    assert main(['run', 'towel']) == 130
    assert capsys.readouterr() == ('', 'xpbd_ros run: interrupted\n')


def test_the_node_takes_ros_arguments_only(capsys):
    for words in (['drape'], ['--scene', 'drape'], ['--ros-args', '-p', 'a:=1', '--', 'drape']):
        with pytest.raises(SystemExit) as end:
            main(['node', *words])
        assert end.value.code == 2
        said = capsys.readouterr().err
        assert 'unrecognized arguments: ' in said
        assert 'parameters follow --ros-args: xpbd_ros node --ros-args -p scene:=' in said


def test_one_of_a_thing_is_told_in_the_singular(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path('scene.yaml').write_text(SHEET.replace('substeps: 8', 'substeps: 1'))
    recorded('scene.yaml', Path('log'), {}, frames=1)
    for words, said in (
            (['run', 'scene.yaml', '--duration', '0.016'], 'scene: 1 frame, '),
            (['check', 'scene.yaml'], '1 substep as given'),
            (['check', 'scene.yaml'], 'sheet: 7x5 at 1 substep behaves like '),
            (['export', 'log', '--format', 'npz', '--every', '9'], ': 1 frame of 35 particles'),
            (['sweep', 'scene.yaml', '--vary', 'cloths.sheet.density=0.1:0.2', '--runs', '1',
              '--duration', '0.016'], '1 run, 0 without an outcome, in ')):
        main(words)
        assert said in capsys.readouterr().out, words


@pytest.fixture(scope='module')
def without_ros(tmp_path_factory) -> Path:
    """Return a folder that hides ROS from an interpreter that has it on its path."""
    folder = tmp_path_factory.mktemp('hide')
    (folder / 'sitecustomize.py').write_text(HIDE)
    return folder


@pytest.mark.parametrize('words', [['run', 'swing'], ['node'], ['demo']], ids=lambda w: w[0])
def test_without_ros_a_verb_says_how_to_get_it(words, without_ros, tmp_path):
    done = program(*words, path=[without_ros], cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ''
    assert done.stderr == (
        f"xpbd_ros {words[0]}: '{words[0]}' needs ROS 2, and rclpy is not installed; source "
        "/opt/ros/jazzy/setup.bash, or pip install 'xpbd_ros[ros]'\n")
    assert list(tmp_path.iterdir()) == []


def test_help_needs_no_ros(without_ros, tmp_path):
    assert program('node', '--help', path=[without_ros], cwd=tmp_path).returncode == 0
