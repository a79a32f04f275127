"""``recover`` as it is called: what it prints, what it writes, and its exit codes."""

import json
from pathlib import Path
import shutil

from support.strict_reader import read_strictly
from xpbd_ros.cli.main import main


def cut(run: Path, length: int) -> Path:
    """Cut a log short, or leave off some bytes of its end."""
    file = run / 'run_0.mcap'
    file.write_bytes(file.read_bytes()[:length])
    return file


def test_what_info_names_makes_a_killed_log_whole(write_log, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = write_log()
    cut(run, -500)
    assert main(['info', str(run)]) == 1
    assert f"\n'xpbd_ros recover {run}' writes a whole log of the readable part\n" in (
        capsys.readouterr().out)
    assert main(['recover', str(run)]) == 0
    (folder,) = (path for path in tmp_path.iterdir() if path.name.startswith('xpbd_ros_recover_'))
    assert f'{folder}: whole, ' in capsys.readouterr().out
    assert main(['info', str(folder)]) == 0
    assert 'recover ' not in capsys.readouterr().out
    assert read_strictly(folder)['/cloth/count'] > 0


def test_a_program_gets_the_same_as_json(write_log, tmp_path, capsys):
    run = write_log()
    cut(run, -5)
    assert main(['recover', str(run), '-o', str(tmp_path / 'whole'), '--json', '-']) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found['run'], found['from']) == (str(tmp_path / 'whole'), str(run))
    assert found['whole'] is True
    assert found['damage'] == ['the magic bytes at its end are missing or damaged']
    assert (found['messages'], found['frames']) == (121, 60)
    assert found['topics']['/cloth/count'] == {'type': 'std_msgs/msg/UInt64', 'count': 60}
    assert found['start_ns'] == 1_700_000_000_000_000_000
    assert found['end_ns'] == found['start_ns'] + 59 * 16_666_667
    assert found['scene'] == 'gravity: [0.0, 0.0, -9.8]\n'


def test_lost_messages_are_told_by_the_exit_code(write_log, tmp_path, capsys):
    run = write_log(filling=5000)
    file = run / 'run_0.mcap'
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0x01    # of a text, which is ASCII
    file.write_bytes(data)
    assert main(['recover', str(run), '-o', str(tmp_path / 'whole')]) == 1
    out = capsys.readouterr().out
    assert out.startswith(f'{file}: damaged\n')
    assert ' of 121 messages are lost\n' in out
    assert read_strictly(tmp_path / 'whole').total() < 121
    assert main(['recover', str(run), '--unchecked', '-o', str(tmp_path / 'all')]) == 1
    assert ' messages in it taken unchecked\n' in capsys.readouterr().out
    assert read_strictly(tmp_path / 'all').total() == 121


def test_a_missing_file_of_a_split_log_is_told_by_the_exit_code(write_log, tmp_path, capsys):
    run = write_log()
    shutil.copy(run / 'run_0.mcap', run / 'run_2.mcap')
    assert main(['recover', str(run), '-o', str(tmp_path / 'whole')]) == 1
    assert 'run_1.mcap: the file is missing\n' in capsys.readouterr().out


def test_mistakes_are_one_line_and_write_nothing(write_log, tmp_path, capsys):
    run = write_log()
    (tmp_path / 'mine').mkdir()
    for words, said in ((['none'], 'none: no such file or folder'),
                        ([str(run), '-o', str(tmp_path / 'mine')], 'mine: exists already')):
        assert main(['recover', *words]) == 2
        out, err = capsys.readouterr()
        assert out == ''
        assert err.startswith('xpbd_ros recover: ')
        assert said in err
        assert err.count('\n') == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ['mine', 'run']
