"""``verify``: the table, the keys, the exit code."""

import json

import pytest

from xpbd_ros.cli.main import main
from xpbd_ros.study.verify import case


def test_one_case_as_a_table_and_as_json(capsys, tmp_path):
    assert main(['verify', '--case', 'V13', '--json', str(tmp_path / 'v.json')]) == 0
    said = capsys.readouterr().out
    numbers = json.loads((tmp_path / 'v.json').read_text())
    assert [row['id'] for row in numbers['cases']] == ['V13'] * 20
    assert {'name', 'expected', 'got', 'unit', 'error', 'tolerance', 'order_expected', 'order',
            'pass'} <= set(numbers['cases'][0])
    assert numbers['cases'][0]['order'] is None
    assert (numbers['passed'], numbers['failed']) == (20, 0)
    assert '20 passed, 0 failed' in said
    for row in numbers['cases']:
        assert row['name'] in said


def test_orders_and_pictures(capsys, tmp_path):
    assert main(['verify', '--case', 'V1', '--json', '-', '-o', str(tmp_path / 'p')]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert [round(row['order'], 1) for row in numbers['cases'] if row['order']] == [1.0, 2.0, 2.0]
    assert numbers['pictures'] == [str(tmp_path / 'p' / 'verify_motion.png')]
    assert (tmp_path / 'p' / 'verify_motion.png').stat().st_size > 5000
    assert main(['verify', '--case', 'V1', '-o', str(tmp_path / 'p')]) == 2
    row = (tmp_path / 'p' / 'verify.md').read_text().splitlines()[2]
    assert row.startswith('| V1 | free fall | 4 | ')
    assert row.endswith(' | 1.00, 2.00, 2.00 | 1, 2 |')


def test_controls_are_listed_with_their_case(capsys):
    assert main(['verify', '--case', 'V13', '--json', '-']) == 0
    assert json.loads(capsys.readouterr().out)['controls'] == []
    assert main(['verify', '--case', 'V6', '--json', '-']) == 0
    found = json.loads(capsys.readouterr().out)['controls']
    assert found
    assert all(one['fails'] and one['id'] == 'V6' for one in found)


def test_a_case_that_fails_is_said_and_fails(capsys):
    wrong = case.Case('V99', 'a wrong answer', 'motion', lambda: iter(
        [case.value('one', 1.0, 2.0, 'm', 0.1)]))
    case.CASES.append(wrong)
    try:
        assert main(['verify', '--case', 'V99']) == 1
    finally:
        case.CASES.remove(wrong)
    assert 'FAIL' in capsys.readouterr().out


@pytest.mark.parametrize('case, hint', [('x', ''), ('6', "; did you mean 'V6'?")])
def test_an_unknown_case_is_refused(case, hint, capsys):
    assert main(['verify', '--case', case]) == 2
    assert f'--case {case}: unknown case{hint} (known: V1, V2, ' in capsys.readouterr().err
