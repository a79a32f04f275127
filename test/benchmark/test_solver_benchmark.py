"""The benchmark runs, on sizes too small to say anything, and writes the keys that it promises."""

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

from support.tiers import slow

CHECKOUT = Path(__file__).parents[2]
ROW = {'what', 'method', 'precision', 'n', 'threads', 'ns_per_projection', 'ratio_to_textbook',
       'ratio_to_limit'}


@pytest.fixture(scope='module', params=[slow('small')])
def report(tmp_path_factory) -> dict:
    if not any(map(shutil.which, ('g++', 'clang++', 'c++'))):
        pytest.skip('no C++ compiler for the baselines: install g++ or clang++')
    return run(tmp_path_factory.mktemp('benchmark') / 'figures.json',
               '--quick', '--sizes', '9', '17', '--rounds', '1', '--seconds', '0.001')


def run(file: Path, *arguments: str) -> dict:
    done = subprocess.run(
        [sys.executable, 'benchmark/solver.py', *arguments, '--json', str(file)], cwd=CHECKOUT,
        env={**os.environ, 'PYTHONPATH': str(CHECKOUT)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(file.read_text())


def test_has_a_row_of_every_table(report):
    assert {row['what'] for row in report['rows']} == {'grid', 'irregular', 'line', 'bend'}
    for row in report['rows']:
        assert row.keys() >= ROW
        assert row['ns_per_projection'] > 0


def test_every_kernel_is_right(report):
    assert report['wrong'] == []


def test_names_the_cpu(report):
    assert len(report['cpu']) > 5


def test_the_textbook_is_its_own_measure(report):
    for row in report['rows']:
        if row['method'] == 'textbook':
            assert row['ratio_to_textbook'] == 1.0


def test_swing_gets_better_with_substeps(report):
    swing = [row for row in report['swing'] if row['method'] == 'textbook' and row['n'] == 17
             and row['stiffness'] == 5000]
    assert swing[0].keys() >= {'n', 'stiffness', 'method', 'integrator', 'substeps', 'ms',
                               'rms_error_m'}
    errors = [row['rms_error_m'] for row in sorted(swing, key=lambda row: row['substeps'])]
    assert errors == sorted(errors, reverse=True) and errors[-1] <= 1e-2


def test_leapfrog_and_reference_agree(report):
    for row in report['swing']:
        if row['method'] == 'textbook_leapfrog':
            assert row['rms_error_m'] < 1e-4


def test_scaling(report):
    assert {(row['method'], row['n']) for row in report['scaling']} >= {
        ('textbook', 9), ('textbook', 17)}
    assert all(row['ms'] > 0 for row in report['scaling'])


def test_without_a_compiler_it_says_so_and_measures_the_rest(tmp_path, monkeypatch):
    monkeypatch.setenv('CXX', 'no-such-compiler')
    report = run(tmp_path / 'figures.json', '--quick', '--what', 'grid', '--sizes', '9',
                 '--rounds', '1', '--seconds', '0.001')
    assert 'no C++ compiler' in report['not_available'][0]['why']
    assert {row['method'] for row in report['rows']} == {'gauss_seidel'}
