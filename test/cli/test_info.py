"""``info`` says what a log holds and whether it is whole, to people and to programs."""

import json
import subprocess
import sys

import pytest

from xpbd_ros.cli.main import main
from xpbd_ros.log.writer import LogWriter


def test_a_whole_log_is_listed(write_log, capsys):
    run = write_log()
    assert main(['info', str(run)]) == 0
    out, err = capsys.readouterr()
    lines = [' '.join(line.split()) for line in out.splitlines()]
    assert lines[0] == f'{run}/run_0.mcap: whole'
    for line in ('duration 0.983 s', 'start 2023-11-14 22:13:20.000000 UTC (1700000000000000000 '
                 'ns)', 'frames 60', 'messages 121', 'seed 7',
                 '/cloth/count std_msgs/msg/UInt64 60', 'gravity 0.0, 0.0, -9.8'):
        assert line in lines
    assert err == ''


def test_a_program_gets_the_same_as_json(write_log, capsys):
    run = write_log()
    assert main(['info', str(run), '--json', '-']) == 0
    found = json.loads(capsys.readouterr().out)    # and nothing else
    assert found['run'] == str(run)
    assert found['whole'] is True
    assert found['damage'] == []
    assert found['messages'] == 121
    assert found['topics']['/cloth/count'] == {'type': 'std_msgs/msg/UInt64', 'count': 60}
    assert found['start_ns'] == 1_700_000_000_000_000_000
    assert found['end_ns'] == found['start_ns'] + 59 * 16_666_667
    assert found['frames'] == 60
    assert found['scene'] == 'gravity: [0.0, 0.0, -9.8]\n'


def test_a_relative_path_becomes_absolute(write_log, monkeypatch, tmp_path):
    write_log()
    monkeypatch.chdir(tmp_path)
    assert main(['info', 'run', '--json', 'info.json']) == 0
    assert json.loads((tmp_path / 'info.json').read_text())['run'] == str(tmp_path / 'run')


def test_a_named_output_that_exists_is_refused(write_log, tmp_path, capsys):
    (tmp_path / 'info.json').write_text('mine')
    assert main(['info', str(write_log()), '--json', str(tmp_path / 'info.json')]) == 2
    assert 'info.json: exists already' in capsys.readouterr().err
    assert (tmp_path / 'info.json').read_text() == 'mine'


def test_a_damaged_log_is_listed_and_fails(write_log, capsys):
    run = write_log()
    file = run / 'run_0.mcap'
    file.write_bytes(file.read_bytes()[:-5])
    assert main(['info', str(run)]) == 1
    out = capsys.readouterr().out
    assert out.startswith(
        f'{file}: damaged\n  the magic bytes at its end are missing or damaged\n')
    assert main(['info', str(run), '--json', '-']) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found['whole'], found['messages']) == (False, 121)
    assert found['damage'] == ['the magic bytes at its end are missing or damaged']


def test_a_log_of_nothing_is_listed(write_log, capsys):
    run = write_log()
    file = run / 'run_0.mcap'
    file.write_bytes(file.read_bytes()[:30])
    assert main(['info', str(run), '--json', '-']) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found['messages'], found['start_ns'], found['scene']) == (0, None, None)
    assert main(['info', str(run)]) == 1


def test_a_scene_is_told_in_short(tmp_path, capsys):
    scene = ('cloths: {towel: {density: 1}, rag: {}}\nsolver: {method: line, substeps: 4}\n'
             'effects: {contact: {}}\npins: {}\nframe_rate: 60.0\n')
    with LogWriter(tmp_path / 'run', scene=scene, settings={}):
        pass
    assert main(['info', str(tmp_path / 'run')]) == 0
    lines = [' '.join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[lines.index('scene') + 1:] == [
        'cloths towel, rag', 'solver method line, substeps 4', 'effects contact',
        'pins none', 'frame_rate 60.0']


@pytest.mark.parametrize(('scene', 'said'), [
    ('[', 'cannot be read'), ('words', 'cannot be read not a mapping')])
def test_a_scene_that_cannot_be_read_does_no_harm(tmp_path, capsys, scene, said):
    with LogWriter(tmp_path / 'run', scene=scene, settings={}):
        pass
    assert main(['info', str(tmp_path / 'run')]) == 0
    assert said in ' '.join(capsys.readouterr().out.split())


def test_bad_input_is_one_line(tmp_path, capsys):
    assert main(['info', str(tmp_path / 'none')]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ('', f'xpbd_ros info: {tmp_path}/none: no such file or folder\n')


def test_it_needs_no_ros(write_log):
    code = ('import sys; sys.modules.update(rclpy=None, std_msgs=None, ament_index_python=None);'
            'from xpbd_ros.cli.main import main; sys.exit(main(sys.argv[1:]))')
    done = subprocess.run([sys.executable, '-c', code, 'info', write_log()],
                          capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, '')
    assert 'whole' in done.stdout
