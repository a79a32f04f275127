"""
Check a scene, and predict its behaviour without running it.

It predicts the stiffness that the solver setting really gives beside the one asked for
(unconverged XPBD is softer), the numerical damping of the integrator, the substeps needed for a
given error of the stretch, and the time per frame.

Exit code: 0, 1 if there are warnings, 2 if the scene is refused.
"""

from pathlib import Path

from xpbd_ros.cli.output import add_json_argument, check_output, write_json
from xpbd_ros.cli.overrides import add_set_argument, overrides_of
from xpbd_ros.errors import counted

EXAMPLE = 'xpbd_ros check towel --set solver.substeps=8'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('scene', help='a scene file, or the name of a shipped scene')
    parser.add_argument('--settings', metavar='FILE',
                        help="a file with a 'solver:' block, which overrides the scene's keys")
    add_set_argument(parser)
    add_json_argument(parser)


def run(arguments) -> int:
    """Predict and print the report."""
    from xpbd_ros.scene.load import load_scene
    from xpbd_ros.study.prediction import check
    overrides = overrides_of(arguments.keys, settings=arguments.settings)
    check_output(arguments.json)
    scene = load_scene(arguments.scene, overrides)
    found = check(scene)
    write_json(arguments.json, {
        'ok': found.ok, 'warnings': found.warnings, 'scene': str(Path(scene.where).absolute()),
        'stiffness': [{**vars(row), 'error': row.error} for row in found.stiffness],
        'numerical_damping': [vars(row) for row in found.decay],
        'solver': vars(found.solver), 'substeps_for': found.substeps_for,
        'frame_ms': found.frame_ms, 'particles': found.particles,
        'constraints': found.constraints, 'notes': found.notes,
    })
    if arguments.json != '-':
        print('\n'.join(lines(scene.name, found)))
    return 0 if found.ok else 1


def lines(name: str, found) -> list[str]:
    """Return the printed report."""
    solver = found.solver
    text = [f'{name}: {counted(found.particles, "particle")}, '
            f'{counted(found.constraints, "constraint")}',
            f'solver      {solver.method}, {solver.integrator}, {solver.substeps} × '
            f'{solver.iterations} ({solver.reason})',
            f'a frame     about {found.frame_ms:.2g} ms of {found.frame_dt_ms:.3g} on one core of '
            f'{found.cpu}']
    if found.stiffness:
        text += ['', f'  {"cloth":<10} {"effect":<13} {"asked":>12} {"effective":>12} '
                 f'{"least":>10} {"largest":>10}']
    for row in found.stiffness:
        effect = f'{row.effect} {row.direction}' if row.direction else row.effect
        asked, mean, least, largest = (
            'rigid' if value == float('inf') else f'{value:.4g}'
            for value in (row.asked, row.effective, row.effective_min, row.effective_max))
        text.append(f'  {row.cloth:<10} {effect:<13} {asked:>12} {mean:>12} {least:>10} '
                    f'{largest:>10} {row.unit}')
    for row in found.decay:
        text.append(f'  {row.cloth:<10} numerical damping takes {100 * row.lost_per_second:.3g} % '
                    f'per second from the amplitude of a {row.mode} of {row.frequency_hz:.2g} Hz')
    counts = ', '.join(f'{100 * float(error):g} %: {count or "out of reach"}'
                       for error, count in found.substeps_for.items())
    if counts:
        text += ['', f'substeps for an error of the stretch of  {counts}']
    return text + [*(f'note: {note}' for note in found.notes),
                   *(f'warning: {warning}' for warning in found.warnings)]
