"""
Run hard cases that break solvers, with every setting that applies.

Each row is one case with one setting: the largest strain, the time until the cloth recovered,
whether a textbook XPBD solver passes the same case, and the message that the user gets. Some cases
start a node as a process; without ROS they are listed as skipped.

Exit code: 0, or 1 if a row fails or is skipped.
"""

import json
import subprocess
import sys

from xpbd_ros.cli.output import add_json_argument, check_outputs, new_folder, write_json
from xpbd_ros.cli.progress import add_scheduler_argument, progress
from xpbd_ros.cli.ros import need_ros
from xpbd_ros.errors import InputError

EXAMPLE = 'xpbd_ros stress --case H13'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('--case', metavar='ID', help='run only this case, such as H13')
    parser.add_argument('--quick', action='store_true',
                        help='run only the default setting, and no case that needs a node')
    parser.add_argument('-o', '--output', metavar='DIR',
                        help='write a table and draw a map of cases and settings to this new '
                             'folder')
    add_scheduler_argument(parser)
    add_json_argument(parser)


def run(arguments) -> int:
    """Run the cases and print their results."""
    from xpbd_ros.study.stress.run import draw, known_ids, stress, table
    check_outputs(arguments.json, folder=arguments.output)
    with new_folder(arguments.output) as folder:
        results = live = live_cases(arguments.case) if not arguments.quick else []
        if arguments.case in (None, *known_ids()) or not live:
            results = live + stress(arguments.case, quick=arguments.quick,
                                    scheduler=arguments.scheduler, progress=progress)
    results = sorted(results, key=lambda one: int(one.id[1:]))
    rows = [(result, each) for result in results for each in result.outcomes]
    failed = sum(not each.good and not each.skipped for _, each in rows)
    missing = sum(each.skipped for _, each in rows)
    numbers = {
        'cases': [{'id': result.id, 'family': result.family, 'title': result.title,
                   **numbers_of(each)} for result, each in rows],
        'seconds': {result.id: result.seconds for result in results},
        'passed': len(rows) - failed - missing, 'failed': failed, 'skipped': missing,
    }
    if folder:
        numbers['pictures'] = [draw(results, folder / 'stress.png')]
        (folder / 'stress.md').write_text(table(results) + '\n', encoding='utf-8')
    write_json(arguments.json, numbers)
    if arguments.json != '-':
        print('\n'.join(lines(results)))
        print(f"{numbers['passed']} passed, {failed} failed, {missing} skipped")
    return 1 if failed or missing else 0


def live_cases(chosen: str | None) -> list:
    """Return the results of the cases that need a node; without ROS they are skipped."""
    from xpbd_ros.study.stress.run import NODE_CASES, Result, skipped
    ids = [one for one in NODE_CASES if chosen in (None, one)]
    if not ids:
        return []
    try:
        need_ros('stress')
    except InputError as error:
        return [skipped(one, NODE_CASES[one], str(error)) for one in ids]
    from xpbd_ros.demo.domain import private_environment
    from xpbd_ros.study.stress.case import Outcome
    done = subprocess.run([sys.executable, '-m', 'xpbd_ros.node_stress', *ids],
                          stdout=subprocess.PIPE, env=private_environment(), text=True,
                          check=False)
    try:
        found = json.loads(done.stdout)
    except ValueError:
        return [skipped(one, NODE_CASES[one], 'its process failed') for one in ids]
    return [Result(one, NODE_CASES[one], 'node',
                   tuple(Outcome(**row) for row in found[one]['rows']), found[one]['seconds'])
            for one in ids]


def numbers_of(outcome) -> dict:
    """Return the JSON keys of a row."""
    return {'setting': outcome.setting, 'finite': outcome.finite,
            'strain_max': outcome.strain_max, 'energy_rise': outcome.energy_rise,
            'recovered': outcome.recovered, 'recovery_s': outcome.recovery_s,
            'reported': outcome.reported, 'textbook_pass': outcome.textbook,
            'textbook_why': outcome.textbook_why, 'skipped': outcome.skipped,
            'why': outcome.why, 'pass': outcome.good}


def lines(results) -> list[str]:
    """Return the printed table."""
    text = [f'{"":<8}{"setting":<56}{"strain":>9} {"recovery":>9}  textbook  reported']
    for result in results:
        text.append(f'{result.id} {result.title} ({result.seconds:.1f} s)')
        for each in result.outcomes:
            strain = '' if each.strain_max is None else f'{each.strain_max:.3g}'
            back = ('' if each.recovered is None else 'never' if not each.recovered else
                    'yes' if each.recovery_s is None else f'{each.recovery_s:.2f} s')
            book = {None: '-', True: 'pass', False: 'fails'}[each.textbook]
            mark = 'skip' if each.skipped else 'pass' if each.good else 'FAIL'
            said = each.reported[:72] + f'  [{each.why}]' * bool(each.why)
            text.append(f'  {mark}  {each.setting:<56}{strain:>9} {back:>9}  {book:<8}  {said}')
    return text
