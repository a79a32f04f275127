"""``stress``: the table, the keys, the exit code."""

import json

from xpbd_ros.cli.main import main


def test_one_case_as_a_table_and_as_json(capsys, tmp_path):
    assert main(['stress', '--case', 'H3', '--json', str(tmp_path / 's.json'),
                 '-o', str(tmp_path / 'p')]) == 0
    said = capsys.readouterr().out
    numbers = json.loads((tmp_path / 's.json').read_text())
    assert {row['id'] for row in numbers['cases']} == {'H3'}
    assert {'setting', 'finite', 'strain_max', 'recovered', 'reported', 'textbook_pass',
            'pass'} <= set(numbers['cases'][0])
    assert numbers['cases'][0]['finite'] is None
    assert numbers['failed'] == numbers['skipped'] == 0
    assert numbers['passed'] == len(numbers['cases'])
    assert f"{numbers['passed']} passed, 0 failed, 0 skipped" in said
    assert (tmp_path / 'p' / 'stress.png').stat().st_size > 5000


def test_without_ros_node_cases_are_skipped_and_the_verb_fails(capsys, monkeypatch):
    monkeypatch.setattr('importlib.util.find_spec', lambda name: None)
    assert main(['stress', '--case', 'H21', '--json', '-']) == 1
    numbers = json.loads(capsys.readouterr().out)
    assert (numbers['passed'], numbers['failed'], numbers['skipped']) == (0, 0, 1)
    assert 'needs ROS 2' in numbers['cases'][0]['why']


def test_an_unknown_case_is_refused(capsys):
    assert main(['stress', '--case', '6']) == 2
    said = capsys.readouterr().err
    assert "--case 6: unknown case; did you mean 'H6'? (known: H1, H2, " in said
