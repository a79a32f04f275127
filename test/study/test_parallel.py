"""Tasks run in this process, in others or on Dask: the same results; losses are told."""

import csv
from functools import partial
import json

import pytest

from support.scenes import SMALL_SHEET
from support.tasks import die_at_one, power
from xpbd_ros.cli.main import main
from xpbd_ros.errors import InputError
from xpbd_ros.study import parallel
from xpbd_ros.study.parallel import run_tasks

SETTING = ('method', 'integrator', 'substeps', 'iterations', 'precision')


def no_progress(items, what):
    return items


@pytest.fixture(scope='module')
def scheduler():
    """Return the address of a Dask scheduler with two workers."""
    distributed = pytest.importorskip('distributed',
                                      reason="Dask is missing: pip install '.[cluster]'")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, host='127.0.0.1',
                                  dashboard_address='127.0.0.1:0', silence_logs=50) as cluster:
        yield cluster.scheduler_address


@pytest.mark.parametrize('options', [{'processes': 1}, {'processes': 2},
                                     {'processes': 2, 'dask': True}])
def test_results_are_the_same_wherever_tasks_run(options):
    if options.get('dask'):
        pytest.importorskip('distributed', reason="Dask is missing: pip install '.[cluster]'")
    tasks = [(k,) for k in range(9)]
    shown = []

    def progress(items, what):
        for item in items:
            shown.append(what)
            yield item

    found = dict(run_tasks(partial(power, 3), tasks, what='powers', progress=progress, **options))
    assert found == {k: 3**k for k in range(9)}
    assert shown == 9 * ['powers']
    assert list(run_tasks(power, [], what='powers', progress=no_progress, **options)) == []


def test_a_process_that_was_killed_is_told():
    with pytest.raises(InputError, match='numbers: a worker process was killed; it may have run'):
        list(run_tasks(die_at_one, [(0,), (1,), (2,)], processes=2, what='numbers',
                       progress=no_progress))


@pytest.mark.slow
def test_a_task_that_kills_every_worker_leaves_the_others_their_results(scheduler):
    found = dict(run_tasks(die_at_one, [(k,) for k in range(12)], processes=1,
                           scheduler=scheduler, what='numbers', progress=no_progress,
                           lost=lambda k: f'lost {k}'))
    assert found == {k: 'lost 1' if k == 1 else k for k in range(12)}


def test_a_scheduler_without_workers_is_refused(monkeypatch):
    monkeypatch.setattr(parallel, 'PATIENCE', '3s')
    distributed = pytest.importorskip('distributed',
                                      reason="Dask is missing: pip install '.[cluster]'")
    with distributed.LocalCluster(n_workers=0, host='127.0.0.1', dashboard_address='127.0.0.1:0',
                                  silence_logs=50) as cluster, \
            pytest.raises(InputError, match='has no workers; start some with'):
        list(run_tasks(power, [(1, 2)], processes=1, scheduler=cluster.scheduler_address,
                       what='powers', progress=no_progress))


def test_workers_of_another_version_are_refused(scheduler, monkeypatch):
    """Their runs would have other bits."""
    monkeypatch.setattr(parallel, '__version__', '0.0.9')
    with pytest.raises(InputError, match=r'a worker has another version of xpbd_ros: .* instead '
                                         'of 0.0.9'):
        list(run_tasks(power, [(1, 2)], processes=1, scheduler=scheduler, what='powers',
                       progress=no_progress))


def numbers_of(tmp_path, name, *words) -> dict:
    """Return the numbers of a verb, without times."""
    file = tmp_path / f'{name}.json'
    assert main([*map(str, words), '--json', str(file)]) == 0
    return {key: value for key, value in json.loads(file.read_text()).items() if key != 'seconds'}


@pytest.mark.parametrize('words', [
    ('verify', '--case', 'V3'),
    pytest.param(('stress', '--case', 'H5', '--quick'), marks=pytest.mark.slow)])
def test_cases_have_the_same_numbers_on_a_scheduler(words, scheduler, tmp_path):
    here = numbers_of(tmp_path, 'here', *words)
    assert here['cases']
    assert numbers_of(tmp_path, 'there', *words, '--scheduler', scheduler) == here


@pytest.mark.slow
def test_a_study_has_the_same_errors_on_a_scheduler(scheduler, tmp_path):
    (tmp_path / 'sheet.yaml').write_text(SMALL_SHEET)
    found = []
    for name, words in (('here', ['--jobs', '1']), ('there', ['--scheduler', scheduler])):
        numbers_of(tmp_path, name, 'accuracy', tmp_path / 'sheet.yaml', '--methods', 'line', '-o',
                   tmp_path / f'{name}_out', *words)
        with (tmp_path / f'{name}_out' / 'accuracy.csv').open() as file:
            found.append({tuple(row[key] for key in SETTING): {
                key: value for key, value in row.items() if 'error' in key or 'energy' in key}
                for row in csv.DictReader(file)})
    assert found[0] == found[1]
    assert len(found[0]) > 10
