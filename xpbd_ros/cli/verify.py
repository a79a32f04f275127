"""
Compare the simulation with known solutions.

The cases have closed forms or independent numerical solutions. Each row has an error in a named
norm with its tolerance and, where one is expected, the measured order of convergence. As negative
controls, schemes that are known to be wrong solve some of the same cases: each of them must fail.

Exit code: 0, or 1 if a case fails or a control passes.
"""

from dataclasses import replace
from typing import Any

from xpbd_ros.cli.output import add_json_argument, check_outputs, new_folder, write_json
from xpbd_ros.cli.progress import add_scheduler_argument, progress

EXAMPLE = 'xpbd_ros verify --case V6'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('--case', metavar='ID', help='run only this case, such as V6')
    parser.add_argument('--quick', action='store_true', help='leave out cases that take minutes')
    parser.add_argument('-o', '--output', metavar='DIR',
                        help='draw a picture per family of cases and write the table as Markdown '
                             'to this new folder')
    add_scheduler_argument(parser)
    add_json_argument(parser)


def run(arguments) -> int:
    """Run the cases and print their results."""
    from xpbd_ros.study.verify.controls import controls
    from xpbd_ros.study.verify.run import draw, verify
    check_outputs(arguments.json, folder=arguments.output)
    with new_folder(arguments.output) as folder:
        answers = verify(arguments.case, slow=not arguments.quick,
                         scheduler=arguments.scheduler, progress=progress)
    wrong = [one for one in controls() if arguments.case in (None, one.id)]
    rows = [row for answer in answers for row in answer.rows]
    failed = sum(not row.good for row in rows) + sum(not one.fails for one in wrong)
    numbers = {
        'cases': [{'id': answer.id, 'family': answer.family, 'title': answer.title,
                   **numbers_of(row)} for answer in answers for row in answer.rows],
        'seconds': {answer.id: answer.seconds for answer in answers},
        'controls': [{'id': one.id, 'scheme': one.scheme, 'error': one.error,
                      'tolerance': one.tolerance, 'fails': one.fails} for one in wrong],
        'passed': len(rows) + len(wrong) - failed, 'failed': failed,
    }
    if folder:
        numbers['pictures'] = draw(answers, folder)
        (folder / 'verify.md').write_text('\n'.join([*table(answers, wrong), '']),
                                          encoding='utf-8')
    write_json(arguments.json, numbers)
    if arguments.json != '-':
        print('\n'.join(lines(answers, wrong)))
        print(f"{numbers['passed']} passed, {failed} failed")
    return 1 if failed else 0


def numbers_of(row) -> dict:
    """Return the JSON keys of a row."""
    return {'name': row.name, 'expected': row.expected, 'got': row.got, 'unit': row.unit,
            'error': row.error, 'norm': row.norm, 'tolerance': row.tolerance,
            'order_expected': row.order_expected, 'order': row.order, 'ladder': row.ladder,
            'step': row.step, 'pass': row.good}


def table(answers, wrong) -> list[str]:
    """Return a Markdown table with, for each case, the row closest to its tolerance and orders."""
    text = ['| Case | | Numbers | Largest error | Tolerance | Orders | Expected |',
            '|---|---|---|---|---|---|---|']
    for answer in merged(answers):
        worst = max(answer.rows,
                    key=lambda row: (not row.good, row.error / (row.tolerance or 1.0)))
        orders = [row for row in answer.rows if row.order is not None]
        text.append(f'| {answer.id} | {answer.title} | {len(answer.rows)} | '
                    f'{worst.error:.1e} {worst.norm} | {worst.tolerance:.0e} | '
                    f'{", ".join(f"{row.order:.2f}" for row in orders)} | '
                    f'{", ".join(dict.fromkeys(f"{row.order_expected:g}" for row in orders))} |')
    text += ['', '| Scheme known to be wrong | Case | Error | Tolerance |', '|---|---|---|---|']
    for one in wrong:
        text.append(f'| {one.scheme} | {one.id} | {one.error:.1e} | {one.tolerance:.0e} |')
    return text


def merged(answers) -> list:
    """Return one answer per case, with the rows of all its answers."""
    found: dict[str, Any] = {}
    for answer in answers:
        known = found.get(answer.id)
        found[answer.id] = answer if known is None else replace(
            known, rows=known.rows + answer.rows)
    return list(found.values())


def lines(answers, wrong) -> list[str]:
    """Return the printed table."""
    text = []
    for answer in answers:
        text.append(f'{answer.id} {answer.title} ({answer.seconds:.1f} s)')
        for row in answer.rows:
            order = ('' if row.order is None
                     else f', order {row.order:.2f} ({row.order_expected:g})')
            text.append(f'  {"pass" if row.good else "FAIL"}  {row.name:<46} '
                        f'{row.got:>12.6g} {row.unit:<4} ({row.expected:.6g}), '
                        f'error {row.error:.1e} {row.norm} of {row.tolerance:.0e}{order}')
    if wrong:
        text.append('controls: schemes known to be wrong, each of which must fail')
    for one in wrong:
        text.append(f'  {"pass" if one.fails else "FAIL"}  {one.id} {one.scheme}: error '
                    f'{one.error:.1e} of {one.tolerance:.0e}')
    return text
